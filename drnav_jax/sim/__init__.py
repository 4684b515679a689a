"""A simulator over `worlds`: sensors, contact and motion of one robot; the caller vmaps."""

from drnav_jax.sim.camera import CameraParams, depth, render
from drnav_jax.sim.contact import clearance
from drnav_jax.sim.kinematic import FaultParams, odometry, step
from drnav_jax.sim.lidar import LidarParams, LidarSpec, cast, scan

__all__ = [
    "CameraParams",
    "FaultParams",
    "LidarParams",
    "LidarSpec",
    "cast",
    "clearance",
    "depth",
    "odometry",
    "render",
    "scan",
    "step",
]
