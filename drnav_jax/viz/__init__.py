"""Pictures and films of what was driven and what was believed; numpy in, files out."""

from drnav_jax.viz.animation import Frame, belief
from drnav_jax.viz.look import MissingExtra
from drnav_jax.viz.pictures import trajectories

__all__ = ["Frame", "MissingExtra", "belief", "trajectories"]
