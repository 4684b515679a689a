"""Pictures and films of what was driven and what was believed; numpy in, files out."""

from drnav_jax.viz.animation import Frame, belief
from drnav_jax.viz.curves import Curve, growth
from drnav_jax.viz.look import MissingExtra
from drnav_jax.viz.pictures import trajectories
from drnav_jax.viz.recordings import Predicted, predictions
from drnav_jax.viz.worldview import TopView, Truth, gallery, samples, world

__all__ = [
    "Curve", "Frame", "MissingExtra", "Predicted", "TopView", "Truth", "belief", "gallery", "growth", "predictions",
    "samples", "trajectories", "world",
]  # fmt: skip
