"""Training the fusion network: `drnav train`."""

from drnav_jax.train.augment import AugmentParams
from drnav_jax.train.job import Result, train
from drnav_jax.train.spec import TrainSpec, read
from drnav_jax.train.validate import figures, predict

__all__ = ["AugmentParams", "Result", "TrainSpec", "figures", "predict", "read", "train"]
