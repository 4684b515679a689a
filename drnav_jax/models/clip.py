"""CLIP as judge of single frames, zero-shot: a row of the paper's Table I (Radford et al. 2021; host code).

With z the feature of the image of the camera that looks along a way (`views`, eq. 1), t_o and t_b those of the prompts that
say the way is open or blocked, all of length 1, and s the model's scale

    (1)  p(open) = e^a / (e^a + e^b)        a = s mean_o z . t_o,  b = s mean_b z . t_b
                 = sigma(z . w),            w = s (mean_o t_o - mean_b t_b)
    (2)  p(dead end) = min over the ways of 1 - p(open)

Eq. 2 says dead end exactly where all three are BLOCKED, and is no product, since the ways of a place are far from
independent; with a way that no camera shows it is unknown.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8
from scipy import special

from drnav_jax.models import views
from drnav_jax.models.views import Judgement
from drnav_jax.types import CameraRig

_WHERE = ("ahead", "to the left", "to the right")  # `views.WAYS` in a prompt
_HUB_NAMES = ("open_clip_model.safetensors", "open_clip_pytorch_model.bin")  # where a tag names none


@dataclasses.dataclass(frozen=True)
class ClipSpec:
    """A model of open_clip, and the prompts.

    Attributes:
        model: Its name in open_clip. One with "-quickgelu" where a file's weights were trained so; tags take care of it.
        weights: A file (.safetensors, .pt, .bin), or a tag of open_clip whose file is in its cache already.
        device: Torch's name of where it runs.
        batch: Images that are encoded at a time.
        open: Prompts that say a way is open; "{}" becomes "ahead", "to the left" or "to the right".
        blocked: Prompts that say it is blocked.
    """

    model: str = "ViT-B-32"
    weights: str = "openai"
    device: str = "cpu"
    batch: int = 64
    open: tuple[str, ...] = (
        "a photo of a clear path {}",
        "a photo of an open passage that leads on {}",
        "a robot's view of free floor with a way out {}",
        "an open way {} between walls",
    )
    blocked: tuple[str, ...] = (
        "a photo of a dead end {}",
        "a photo of a wall that blocks the way {}",
        "a robot's view of an obstacle that closes the passage {}",
        "a closed way {} with no exit",
    )

    def __post_init__(self) -> None:
        """Check names, counts and prompts."""
        if not (self.model and self.weights):
            raise ValueError('model and weights must be named, e.g. "ViT-B-32" and "openai" or a file.')
        if self.batch < 1:
            raise ValueError(f"batch must be >= 1 image, got {self.batch}.")
        for name in ("open", "blocked"):
            prompts = getattr(self, name)
            if not prompts or any(p.count("{}") > 1 or not p.replace("{}", "").strip() for p in prompts):
                raise ValueError(f'{name} needs prompts, each of words and at most one "{{}}", got {prompts}.')


class Encoder(NamedTuple):
    """A pair of encoders into one space; features of any length but 0."""

    images: Callable[[np.ndarray], np.ndarray]  # [M, h, w, 3] uint8 -> [M, d]
    texts: Callable[[Sequence[str]], np.ndarray]  # M texts -> [M, d]
    scale: float  # s of eq. 1


def prompt_weights(spec: ClipSpec, encode: Encoder) -> Float[np.ndarray, "3 d"]:
    """Vectors w of eq. 1, one for each of the `views.WAYS`: encoded once, used for every frame.

    Args:
        spec: The prompts.
        encode: From `load`.
    """
    weights = []
    for where in _WHERE:
        for_open, for_blocked = (
            _unit(encode.texts([p.replace("{}", where) for p in prompts])).mean(axis=0)
            for prompts in (spec.open, spec.blocked)
        )
        weights.append(encode.scale * (for_open - for_blocked))
    return np.stack(weights)


def judge(
    encode: Encoder,
    weights: Float[np.ndarray, "3 d"],
    images: Shaped[np.ndarray, "b n h w 3"],
    rig: CameraRig,
    valid: Bool[np.ndarray, "b n"] | None = None,
) -> Judgement:
    """Eq. 1 and 2 for B frames.

    Args:
        encode: From `load`.
        weights: From `prompt_weights`.
        images: RGB, uint8.
        rig: Fields `[B, N, ...]`, or `[N, ...]` for all frames.
        valid: Which images are there; None = all.

    Returns:
        path `[B, 3]`, dead_end `[B]`; NaN where no camera shows what is asked.

    Raises:
        ValueError: If the images do not fit the rig.
    """
    cameras = views.shown(images, rig, valid)
    frame, way = np.nonzero(cameras != views.NO_CAMERA)
    path = np.full(cameras.shape, np.nan, np.float32)
    if len(frame):
        # no camera shows two ways, so none is encoded twice
        z = _unit(encode.images(images[frame, cameras[frame, way]]))
        path[frame, way] = special.expit(np.sum(z * weights[way], axis=1))
    return Judgement(path=path, dead_end=(1 - path).min(axis=1))


def load(spec: ClipSpec = ClipSpec()) -> Encoder:  # noqa: B008 (immutable)
    """A model of open_clip, from files on this machine: nothing is downloaded.

    Args:
        spec: Model, weights and device.

    Raises:
        ValueError: "weights not available: ...", if open_clip or the weights are not here or do not fit the model.
    """
    try:
        import open_clip  # pyright: ignore[reportMissingImports]
        import torch  # pyright: ignore[reportMissingImports]
        from PIL import Image
    except ImportError as error:
        raise ValueError(
            f"weights not available: CLIP needs open_clip ({error}); install the extra: pip install 'drnav_jax[vlm]'."
        ) from None
    config = open_clip.get_model_config(spec.model)
    if config is None:
        raise ValueError(f"weights not available: open_clip has no model {spec.model!r}; see open_clip.list_models().")
    if {"hf_model_name", "hf_tokenizer_name"} & set(config.get("text_cfg", {})):
        raise ValueError(
            f"weights not available: {spec.model} fetches its tokenizer when it is built; take one that uses open_clip's"
            " own, such as ViT-B-32."
        )
    trained = {}
    file = Path(spec.weights).expanduser()
    if not file.is_file():
        trained = open_clip.get_pretrained_cfg(spec.model, spec.weights)
        file = _cached(trained)
        if file is None:
            known = ", ".join(open_clip.list_pretrained_tags_by_model(spec.model)) or "none"
            raise ValueError(
                f"weights not available: {spec.weights!r} is no file, nor a tag of {spec.model} that lies in open_clip's"
                f" cache (tags: {known}). Give a file, or fetch the tag once with open_clip."
            )
    try:
        model, _, prepare = open_clip.create_model_and_transforms(
            spec.model,
            pretrained=str(file),
            device=spec.device,
            force_quick_gelu=trained.get("quick_gelu", False),
            image_mean=trained.get("mean"),
            image_std=trained.get("std"),
            image_interpolation=trained.get("interpolation"),
            image_resize_mode=trained.get("resize_mode"),
        )
    except Exception as error:  # a file can be wrong in as many ways as there are readers in open_clip and torch
        raise ValueError(f"weights not available: {file} is damaged or not of {spec.model}: {error}") from error
    model.eval()
    tokenize = open_clip.get_tokenizer(spec.model)

    def images(pixels: UInt8[np.ndarray, "m h w 3"]) -> Float[np.ndarray, "m d"]:
        found = []
        with torch.inference_mode():
            for k in range(0, len(pixels), spec.batch):
                ready = torch.stack([prepare(Image.fromarray(p)) for p in pixels[k : k + spec.batch]])
                found.append(model.encode_image(ready.to(spec.device)).float().cpu().numpy())
        return np.concatenate(found)

    def texts(prompts: Sequence[str]) -> Float[np.ndarray, "m d"]:
        with torch.inference_mode():
            return model.encode_text(tokenize(list(prompts)).to(spec.device)).float().cpu().numpy()

    return Encoder(images, texts, float(model.logit_scale.detach().exp()))


def _cached(trained: dict[str, Any]) -> Path | None:
    """Where the file of a tag lies in the caches that open_clip fills; None if it was never fetched."""
    repository, _, name = trained.get("hf_hub", "").rpartition("/")
    if repository:
        from huggingface_hub import try_to_load_from_cache  # pyright: ignore[reportMissingImports]

        names = (name, f"{name.rpartition('.')[0]}.safetensors") if name else _HUB_NAMES
        for each in names:
            found = try_to_load_from_cache(repository, each)
            if isinstance(found, str):
                return Path(found)
    address = trained.get("url", "")
    file = Path("~/.cache/clip").expanduser() / address.rpartition("/")[2]
    return file if address and file.is_file() else None


def _unit(features: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m d"]:
    """Rows of length 1."""
    return features / np.linalg.norm(features, axis=1, keepdims=True)
