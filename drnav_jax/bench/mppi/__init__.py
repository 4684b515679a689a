"""MPPI next to what a user would pick instead: `pytorch_mppi`, NumPy and Numba, each doing the same task (`task`)."""

from drnav_jax.bench.mppi.compare import side_by_side
from drnav_jax.bench.mppi.task import Task, Update, make

__all__ = ["Task", "Update", "make", "side_by_side"]
