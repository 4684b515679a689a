"""Which frames show what one sensor alone cannot judge: a drop, glass, vegetation (host code).

Metrics are told apart by these strata. One is in view if a straight line in the plane, within the cameras' angle and
`reach`, meets a solid of it before anything opaque that is as high as the cameras.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drnav_jax.worlds.materials import EXTINCTION, Material
from drnav_jax.worlds.world import HEADROOM, Scene, make_world, rasterise

STRATA: dict[str, tuple[Material, ...]] = {
    "drop": (Material.DROP,),
    "glass": (Material.GLASS,),
    "vegetation": (Material.BUSH, Material.GRASS),
}
_EYE = 0.5  # [m] height of the cameras
_FAN = math.radians(1.5)  # [rad] between lines of sight
_CHUNK = 64  # poses at a time


def in_view(
    scene: Scene,
    poses: Float[np.ndarray, "N 3"],
    *,
    reach: float = 10.0,
    half_angle: float = 0.75 * math.pi,
) -> Bool[np.ndarray, "N S"]:
    """Whether each robot has something of each of `STRATA` in view.

    Args:
        scene: Any world.
        poses: x, y, yaw in the world [m, rad].
        reach: How far it can be seen [m].
        half_angle: To either side of the heading [rad]; the default is that of the cameras front, left and right.

    Raises:
        ValueError: If `reach` or `half_angle` is not > 0.
    """
    if not (0 < reach < math.inf and 0 < half_angle <= math.pi):
        raise ValueError(f"reach must be > 0 m and half_angle in (0, pi] rad, got {reach} and {half_angle}.")
    opaque = _footprint(scene, _opaque)
    if np.asarray(scene.world.field.values).size:
        opaque |= scene.occupied & ~_footprint(scene, lambda material, _: material >= 0)  # the map's own walls
    layers = [_footprint(scene, lambda material, _, of=of: np.isin(material, of)) for of in STRATA.values()]
    found = np.zeros((len(poses), len(layers)), bool)
    if not any(layer.any() for layer in layers):
        return found
    h, w = opaque.shape
    angles = np.linspace(-half_angle, half_angle, 2 * math.ceil(half_angle / _FAN) + 1)
    along = (np.arange(math.ceil(reach / scene.resolution)) + 0.5) * scene.resolution
    along = along[along <= reach]
    for k in range(0, len(poses), _CHUNK):
        x, y, yaw = (poses[k : k + _CHUNK, c, None, None] for c in range(3))
        heading = yaw + angles[:, None]
        column = np.floor((x + np.cos(heading) * along - scene.origin[0]) / scene.resolution).astype(int)
        row = np.floor((y + np.sin(heading) * along - scene.origin[1]) / scene.resolution).astype(int)
        inside = (row >= 0) & (row < h) & (column >= 0) & (column < w)
        index = np.where(inside, row * w + column, 0)
        seen = inside & ~np.logical_or.accumulate(inside & opaque.ravel()[index], axis=2)
        for s, layer in enumerate(layers):
            found[k : k + _CHUNK, s] = (seen & layer.ravel()[index]).any(axis=(1, 2))
    return found


def _opaque(material: Int[np.ndarray, " n"], spans: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Whether solids of a material, from z_min to z_max, hide what is behind them."""
    return np.isinf(EXTINCTION[material]) & (spans[:, 0] <= _EYE) & (spans[:, 1] >= _EYE)


def _footprint(scene: Scene, chosen: Any) -> Bool[np.ndarray, "H W"]:
    """Cells, on the scene's grid, of the solids that are chosen by material and heights and begin below `HEADROOM`."""
    rows = []
    for solids, surfaces in (
        (scene.world.boxes, scene.world.box_surfaces),
        (scene.world.cylinders, scene.world.cylinder_surfaces),
    ):
        solids = np.array(solids)
        spans = solids[:, -2:]
        solids = solids[chosen(np.asarray(surfaces.material), spans) & (spans[:, 0] < HEADROOM)]
        solids[:, -2:] = 0.0, 1.0  # rasterised as walls, whatever they are
        rows.append(solids)
    return rasterise(make_world(*rows), scene.origin, scene.occupied.shape, scene.resolution)
