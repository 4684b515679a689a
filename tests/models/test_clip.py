"""CLIP's arithmetic with encoders whose answers are known; loading refuses what is not here, and downloads nothing."""

import dataclasses
import math
import sys

import numpy as np
import pytest

from drnav_jax.models import clip
from drnav_jax.models.clip import ClipSpec, Encoder
from drnav_jax.types import FRONT_LEFT_RIGHT, NO_CAMERAS, RigSpec, rig_of

SPEC = ClipSpec(open=("free {}", "a way out"), blocked=("wall {}", "dead end", "closed {}"))
SCALE, WIDTH = 7.0, 5
RIG = rig_of(RigSpec())


def text_feature(text):
    """A feature of any length, which depends on every letter."""
    return np.random.default_rng([ord(c) for c in text]).normal(size=WIDTH).astype(np.float32) * len(text)


def image_feature(image):
    return np.random.default_rng(int(image.sum())).normal(size=WIDTH).astype(np.float32) * 3


class Recorder:
    """A pair of encoders that keeps what it was given."""

    def __init__(self):
        self.prompts, self.pictures = [], []

    def encoder(self):
        def images(pixels):
            self.pictures += list(pixels)
            return np.stack([image_feature(p) for p in pixels])

        def texts(prompts):
            self.prompts += prompts
            return np.stack([text_feature(p) for p in prompts])

        return Encoder(images, texts, SCALE)


def cosine(a, b):
    return float(np.dot(a, b)) / math.sqrt(np.dot(a, a) * np.dot(b, b))


def frames(count, cameras=3, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, cameras, 4, 6, 3), dtype=np.uint8)


def test_probabilities_are_a_softmax_over_mean_similarities():
    encode = Recorder().encoder()
    images = frames(4)
    got = clip.judge(encode, clip.prompt_weights(SPEC, encode), images, RIG)
    assert got.path.shape == (4, 3) and got.path.dtype == got.dead_end.dtype == np.float32
    for b in range(4):
        for way, where in enumerate(("ahead", "to the left", "to the right")):
            z = image_feature(images[b, way])
            logits = []
            for prompts in (SPEC.open, SPEC.blocked):
                logits.append(SCALE * np.mean([cosine(z, text_feature(p.replace("{}", where))) for p in prompts]))
            want = math.exp(logits[0]) / (math.exp(logits[0]) + math.exp(logits[1]))
            assert got.path[b, way] == pytest.approx(want, abs=1e-5)  # float32, logits up to 7
        assert got.dead_end[b] == np.min(1 - got.path[b])
    assert np.ptp(got.path) > 0.3, "or the test says nothing"


def test_a_dead_end_is_where_every_way_is_blocked():
    encode = Recorder().encoder()
    got = clip.judge(encode, clip.prompt_weights(SPEC, encode), frames(64), RIG)
    blocked = np.all(got.path < 0.5, axis=1)
    assert 0 < blocked.sum() < 64
    np.testing.assert_array_equal(got.dead_end > 0.5, blocked)


def test_each_way_is_judged_by_the_camera_that_looks_there():
    encode = Recorder().encoder()
    weights, images = clip.prompt_weights(SPEC, encode), frames(3)
    want = clip.judge(encode, weights, images, RIG)
    order = [2, 0, 1]
    rig = rig_of(RigSpec(mounts=tuple(FRONT_LEFT_RIGHT[k] for k in order)))
    turned = clip.judge(encode, weights, images[:, order], rig)
    np.testing.assert_array_equal(turned.path, want.path)


def test_without_a_camera_a_way_is_unknown_and_its_image_is_not_encoded():
    kept = Recorder()
    encode = kept.encoder()
    weights, images = clip.prompt_weights(SPEC, encode), frames(2)
    valid = np.array([[True, False, True], [True, True, True]])
    got, whole = clip.judge(encode, weights, images, RIG, valid), clip.judge(encode, weights, images, RIG)
    assert np.isnan(got.path).tolist() == [[False, True, False], [False] * 3]
    assert np.isnan(got.dead_end).tolist() == [True, False]
    np.testing.assert_array_equal(got.path[~np.isnan(got.path)], whole.path[~np.isnan(got.path)])
    assert len(kept.pictures) == 5 + 6
    front = clip.judge(encode, weights, frames(2, cameras=1), rig_of(RigSpec(mounts=FRONT_LEFT_RIGHT[:1])))
    assert np.isnan(front.path).tolist() == [[False, True, True]] * 2
    blind = clip.judge(encode, weights, frames(2, cameras=0), rig_of(NO_CAMERAS))
    assert np.isnan(blind.path).all() and np.isnan(blind.dead_end).all() and blind.path.shape == (2, 3)
    none = clip.judge(encode, weights, frames(0), RIG)
    assert none.path.shape == (0, 3) and none.dead_end.shape == (0,)


def test_prompts_name_the_way_and_are_encoded_once():
    kept = Recorder()
    encode = kept.encoder()
    weights = clip.prompt_weights(SPEC, encode)
    clip.judge(encode, weights, frames(2), RIG)
    assert weights.shape == (3, WIDTH) and len(kept.prompts) == 3 * 5
    assert {"free ahead", "wall to the left", "closed to the right", "dead end"} <= set(kept.prompts)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"model": ""}, "model and weights"),
        ({"batch": 0}, "batch must be >= 1"),
        ({"open": ()}, "open needs prompts"),
        ({"blocked": ("wall", "{} {} x")}, "blocked needs prompts"),
        ({"blocked": ("{}",)}, "blocked needs prompts"),
    ],
)
def test_specs_that_make_no_sense_are_refused(fields, match):
    with pytest.raises(ValueError, match=match):
        dataclasses.replace(SPEC, **fields)


def test_without_open_clip_it_says_which_extra_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open_clip", None)  # as if it were not installed
    with pytest.raises(ValueError, match=r"^weights not available: .*drnav_jax\[vlm\]"):
        clip.load(ClipSpec())


TINY = {
    "embed_dim": 16,
    "vision_cfg": {"image_size": 32, "layers": 1, "width": 32, "head_width": 16, "patch_size": 16},
    "text_cfg": {"context_length": 77, "vocab_size": 49408, "width": 32, "heads": 2, "layers": 1},
}


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """A tiny untrained model that open_clip knows by name, its weights in a file, and an empty home."""
    open_clip = pytest.importorskip("open_clip", reason="needs the vlm extra")
    import json

    import torch

    def refuse(*args, **kwargs):
        raise AssertionError("nothing may be downloaded")

    monkeypatch.setattr("socket.socket.connect", refuse)
    monkeypatch.setattr("socket.getaddrinfo", refuse)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "tiny-clip.json").write_text(json.dumps(TINY))
    open_clip.add_model_config(tmp_path / "tiny-clip.json")
    torch.manual_seed(0)
    model = open_clip.create_model("tiny-clip")
    file = tmp_path / "tiny.pt"
    torch.save(model.state_dict(), file)
    return open_clip, model.eval(), file


def test_weights_from_a_file_give_open_clips_own_answer(tiny):
    import torch
    from PIL import Image

    open_clip, model, file = tiny
    spec = dataclasses.replace(SPEC, model="tiny-clip", weights=str(file), batch=2)
    encode = clip.load(spec)
    images = frames(2)
    got = clip.judge(encode, clip.prompt_weights(spec, encode), images, RIG)
    prepare = open_clip.image_transform(32, is_train=False)
    tokenize = open_clip.get_tokenizer("tiny-clip")
    for b in range(2):
        for way, where in enumerate(("ahead", "to the left", "to the right")):
            image = prepare(Image.fromarray(images[b, way]))[None]
            texts = tokenize([p.replace("{}", where) for p in (*SPEC.open, *SPEC.blocked)])
            with torch.no_grad():
                logits = model(image, texts)
                similar = (logits[0] @ logits[1].T * logits[2])[0]
            pair = torch.stack([similar[:2].mean(), similar[2:].mean()])
            assert got.path[b, way] == pytest.approx(float(pair.softmax(0)[0]), abs=1e-5)


def test_what_is_not_here_is_refused_and_not_fetched(tiny, tmp_path):
    _, _, file = tiny
    for fields, match in (
        ({"model": "ViT-B-32", "weights": "openai"}, "'openai' is no file, nor a tag of ViT-B-32 .*tags: openai"),
        ({"model": "ViT-B-32", "weights": str(tmp_path / "none.pt")}, "none.pt' is no file"),
        ({"model": "no-such", "weights": "openai"}, "no model 'no-such'"),
        ({"model": "roberta-ViT-B-32", "weights": str(file)}, "fetches its tokenizer"),
        ({"model": "ViT-S-32-alt", "weights": str(file)}, "damaged or not of ViT-S-32-alt"),
    ):
        with pytest.raises(ValueError, match=f"^weights not available: .*{match}"):
            clip.load(dataclasses.replace(SPEC, **fields))
    torn = tmp_path / "torn.pt"
    torn.write_bytes(file.read_bytes()[:5000])
    with pytest.raises(ValueError, match="^weights not available: .*torn.pt is damaged"):
        clip.load(dataclasses.replace(SPEC, model="tiny-clip", weights=str(torn)))


@pytest.mark.parametrize("cache", ["url", "hub", "hub, file named"])
def test_a_tag_is_taken_from_the_cache_with_its_own_settings(tiny, tmp_path, monkeypatch, cache):
    """Not only the file: mean and activation belong to the tag as well."""
    open_clip, _, file = tiny
    settings = {"mean": (0.1, 0.2, 0.3), "std": (0.5, 0.6, 0.7), "quick_gelu": True}
    if cache == "url":
        folder, name = tmp_path / "home" / ".cache" / "clip", "tiny.pt"
        settings["url"] = "https://host.invalid/a/tiny.pt"
    else:
        commit, repository = "0" * 40, tmp_path / "hub" / "models--some--tiny"
        folder = repository / "snapshots" / commit
        name = "open_clip_pytorch_model.bin" if cache == "hub" else "special.bin"
        settings["hf_hub"] = "some/tiny/" if cache == "hub" else "some/tiny/special.bin"
        (repository / "refs").mkdir(parents=True)
        (repository / "refs" / "main").write_text(commit)
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(open_clip, "get_pretrained_cfg", lambda model, tag: settings if tag == "mine" else {})
    with pytest.raises(ValueError, match="^weights not available: 'mine' is no file, nor a tag"):
        clip.load(dataclasses.replace(SPEC, model="tiny-clip", weights="mine"))
    folder.mkdir(parents=True)
    (folder / name).write_bytes(file.read_bytes())
    spec = dataclasses.replace(SPEC, model="tiny-clip", weights="mine")
    pixels = frames(1)[0]
    got = clip.load(spec).images(pixels)
    import torch
    from PIL import Image

    torch.manual_seed(0)
    model = open_clip.create_model("tiny-clip", force_quick_gelu=True).eval()
    prepare = open_clip.image_transform(32, is_train=False, mean=(0.1, 0.2, 0.3), std=(0.5, 0.6, 0.7))
    with torch.no_grad():
        want = model.encode_image(torch.stack([prepare(Image.fromarray(p)) for p in pixels]))
    np.testing.assert_allclose(got, want.numpy(), atol=1e-5)
    plain = clip.load(dataclasses.replace(spec, weights=str(file))).images(pixels)
    assert np.abs(plain - got).max() > 1e-3, "the settings matter"
