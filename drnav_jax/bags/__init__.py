"""Rosbags as observations; `rosbags` is imported when a bag is opened."""

from drnav_jax.bags.camera import ImageSpec
from drnav_jax.bags.observations import BagSpec, Recorded, read
from drnav_jax.bags.scan import ScanSpec

__all__ = ["BagSpec", "ImageSpec", "Recorded", "ScanSpec", "read"]
