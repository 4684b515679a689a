"""What a training run is: its data, network, losses and schedule, as one value that a file can hold."""

import dataclasses
from pathlib import Path

import yaml

from drnav_jax.models import settings
from drnav_jax.models.losses import LossParams
from drnav_jax.models.network import NetworkSpec
from drnav_jax.train.augment import AugmentParams


@dataclasses.dataclass(frozen=True)
class TrainSpec:
    """One run.

    Attributes:
        network: What is trained.
        loss: Weights of its terms.
        augment: What is done to frames.
        steps: Batches in all.
        batch_size: Frames per step, over all devices.
        learning_rate: At its highest.
        warmup: Steps until then; from there it falls to 2 % as a cosine.
        weight_decay: Of AdamW, on matrices.
        clip: Largest norm of a gradient.
        ema: Decay of the average of the parameters, which is what is shipped.
        seed: Of parameters, order and augmentation.
        start_from: File of weights to go on from (`weights.begun`); "" = random ones.
        validate_every: Steps between two validations.
        save_every: Steps between two checkpoints.
        keep: Checkpoints kept, beside the best.
    """

    network: NetworkSpec = NetworkSpec()
    loss: LossParams = LossParams()
    augment: AugmentParams = AugmentParams()
    steps: int = 6000
    batch_size: int = 32
    learning_rate: float = 2e-3
    warmup: int = 300
    weight_decay: float = 0.02
    clip: float = 1.0
    ema: float = 0.998
    seed: int = 0
    start_from: str = ""
    validate_every: int = 1000
    save_every: int = 250
    keep: int = 2

    def __post_init__(self) -> None:
        """Check ranges."""
        low = [n for n in ("steps", "batch_size", "validate_every", "save_every", "keep") if getattr(self, n) < 1]
        if low or self.warmup < 0 or self.seed < 0:
            raise ValueError(f"{', '.join(low) or 'warmup and seed'} must be >= {1 if low else 0}.")
        if not (self.learning_rate > 0 and self.clip > 0 and self.weight_decay >= 0 and 0 <= self.ema < 1):
            raise ValueError("learning_rate and clip must be > 0, weight_decay >= 0 and ema within 0..1 (1 excluded).")


def read(file: Path | None) -> TrainSpec:
    """The Spec in a YAML (or JSON) file; defaults without one.

    Raises:
        ValueError: If the file is no mapping, or says what cannot be.
        OSError: If it cannot be read.
    """
    if file is None:
        return TrainSpec()
    try:
        values = yaml.safe_load(file.read_text()) or {}
    except yaml.YAMLError as error:
        raise ValueError(f"{file} is no YAML: {str(error).splitlines()[0]}.") from None
    if not isinstance(values, dict):
        raise ValueError(f"{file} must be a mapping of settings, such as `steps: 6000`.")
    try:
        return settings.built(TrainSpec, values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{file}: {error}") from None
