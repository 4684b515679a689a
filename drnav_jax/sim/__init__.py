"""A simulator over `worlds`: sensors, contact and motion of one robot; the caller vmaps."""

from drnav_jax.sim.camera import CameraParams, depth, render
from drnav_jax.sim.contact import clearance
from drnav_jax.sim.kinematic import FaultParams, delayed, odometry, step
from drnav_jax.sim.lidar import LidarParams, LidarSpec, cast, scan
from drnav_jax.sim.mjx import MjxParams, MjxSpec, solids_of
from drnav_jax.sim.solids import Solids

__all__ = [
    "CameraParams",
    "FaultParams",
    "LidarParams",
    "LidarSpec",
    "MjxParams",
    "MjxSpec",
    "Solids",
    "cast",
    "clearance",
    "delayed",
    "depth",
    "odometry",
    "render",
    "scan",
    "solids_of",
    "step",
]
