"""One training frame: what the robot senses at a moment, and what is true there.

Storage types are chosen for size: images and masks uint8, points and metres float16. `FrameSpec` fixes every shape.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from drnav_jax.sim.lidar import LidarSpec
from drnav_jax.types import BevSpec, RigSpec
from drnav_jax.worlds.strata import STRATA

STRATUM_BITS = {name: 1 << k for k, name in enumerate(STRATA)}  # of `Frame.strata`: what one sensor alone cannot judge


@dataclasses.dataclass(frozen=True)
class FrameSpec:
    """Sensors and grid of a dataset.

    Attributes:
        rig: The cameras.
        lidar: The beams.
        bev: The grid of maps and labels.
        lost: Share of the beams that is lost; None = drawn for each world, 0 to 5 %.
    """

    rig: RigSpec = RigSpec()
    lidar: LidarSpec = LidarSpec()
    bev: BevSpec = BevSpec()
    lost: float | None = None

    def __post_init__(self) -> None:
        """Check the share."""
        if self.lost is not None and not 0 <= self.lost <= 1:
            raise ValueError(f"lost must be a share of 0..1, got {self.lost}.")


class Frame(NamedTuple):
    """Frames as stored, `[B, ...]` in a batch; N cameras, P points, h x w cells (`BevSpec`)."""

    images: Any  # [N, rows, columns, 3] uint8
    image_valid: Any  # [N] bool
    points: Any  # [P, 3] float16, base_link [m]
    point_valid: Any  # [P] bool
    focal: Any  # [N, 2] float32, `CameraRig`
    centre: Any  # [N, 2] float32
    position: Any  # [N, 3] float32
    rotation: Any  # [N, 3, 3] float32
    local_map: Any  # [h, w] uint8: 0 unknown, 1 free, 2 occupied, as the filter knows it (`models.bev`)
    rule_p: Any  # [h, w] uint8, p of the geometric rule x 255
    rule_confidence: Any  # [h, w] uint8, its confidence x 255
    visibility: Any  # [h, w] uint8: seen now, before, never (`worlds.frames`)
    dead_end: Any  # [h, w] bool, the truth
    inside: Any  # [h, w] bool, cells that lie in the world: `traversable` counts there
    valid: Any  # [h, w] bool, of these the traversable ones: the other labels count there
    depth: Any  # [h, w] float16, beyond the mouth [m]
    traversable: Any  # [h, w] bool
    recoverability: Any  # [h, w] float16, 0..1 (`worlds.truth`)
    interior: Any  # [h, w] bool, where the twin's label differs
    path: Any  # [3] bool: front, left, right is open
    path_stable: Any  # [3] bool, unchanged by a step aside
    dead_end_flag: Any  # [] bool, no path is open
    flag_stable: Any  # [] bool, unchanged by a step aside
    pose: Any  # [3] float32 in the world
    family: Any  # [] int32, index into the manifest's families
    seed: Any  # [] int32, of the world
    closed: Any  # [] bool, the variant whose dead end is closed
    behaviour: Any  # [] int32, index into `behaviours.KINDS`
    strata: Any  # [] uint8, bits of what stands in the world
    strata_seen: Any  # [] uint8, bits of what a camera sees now


def dtypes() -> dict[str, type]:
    """Storage type of every field."""
    kinds: dict[str, type] = dict.fromkeys(Frame._fields, bool)
    eight = ("images", "local_map", "rule_p", "rule_confidence", "visibility", "strata", "strata_seen")
    kinds |= dict.fromkeys(eight, np.uint8)
    kinds |= dict.fromkeys(("points", "depth", "recoverability"), np.float16)
    kinds |= dict.fromkeys(("focal", "centre", "position", "rotation", "pose"), np.float32)
    return kinds | dict.fromkeys(("family", "seed", "behaviour"), np.int32)
