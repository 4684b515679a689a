"""Pictures of worlds as jobs: one world with its truth and what is sensed there, and all families on a sheet."""

import math
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax import geometry, viz, worlds
from drnav_jax.sim import CameraParams, LidarParams, LidarSpec, render, scan
from drnav_jax.types import RigSpec, rig_of
from drnav_jax.viz import TopView, Truth
from drnav_jax.worlds import Material, Scene, World
from drnav_jax.worlds.materials import BLOCKS
from drnav_jax.worlds.truth import TruthSpec, truth

CAMERAS = ("front", "left", "right")
PIXELS = 288  # of an image
MARGIN = 0.33  # [m] from the robot's centre to the walls on the shortest way
BEFORE = 2.5  # [m] by way before the place where twins differ: there a camera looks at it


def _outlines(scene: Scene) -> list[np.ndarray]:
    """Corners `[n, 2]` of each solid, boxes first [m]."""
    found = []
    for x, y, yaw, hx, hy, _, _ in np.asarray(scene.world.boxes, float):
        corner = np.array([[hx, hy], [-hx, hy], [-hx, -hy], [hx, -hy]])
        c, s = math.cos(yaw), math.sin(yaw)
        found.append(corner @ np.array([[c, s], [-s, c]]) + (x, y))
    turn = np.linspace(0, 2 * math.pi, 25)[:-1]
    for x, y, r, _, _ in np.asarray(scene.world.cylinders, float):
        found.append(np.stack([x + r * np.cos(turn), y + r * np.sin(turn)], axis=-1))
    return found


def top_view(scene: Scene, title: str, path: np.ndarray | None = None) -> TopView:
    """A scene as `viz` draws it."""
    boxes, posts = scene.world.box_surfaces, scene.world.cylinder_surfaces
    material = np.concatenate([boxes.material, posts.material]).astype(int)
    return TopView(
        title=title,
        outlines=_outlines(scene),
        colours=np.concatenate([boxes.colour, posts.colour]),
        materials=[Material(m).name for m in material],
        passable=~BLOCKS[material],
        occupied=scene.occupied,
        origin=np.asarray(scene.origin),
        resolution=scene.resolution,
        ground=np.asarray(scene.world.scenery.ground_colour),
        start=None if scene.start is None else np.asarray(scene.start),
        goal=None if scene.goal is None else np.asarray(scene.goal),
        path=path,
    )


def _images(world: World, pose: np.ndarray, rig: RigSpec, seed: int = 0) -> np.ndarray:
    shown = render(rig, CameraParams(), world, rig_of(rig), jnp.asarray(pose, jnp.float32), jax.random.key(seed))
    return np.asarray(shown)


def picture(file: Path, scene: Scene, radius: float = 0.25, seed: int = 0) -> Path:
    """One world: top view, trip-conditioned dead ends, and what a robot at the start sees.

    Args:
        file: PNG to write.
        scene: A world with start and goal.
        radius: Of the robot [m].
        seed: Of the sensors' noise.

    Raises:
        ValueError: If its trip cannot be driven.
        MissingExtra: If matplotlib is not installed.
    """
    length, path = worlds.check_trip(scene, radius, radius + MARGIN - 0.25)
    assert scene.start is not None
    pose = np.asarray(scene.start, np.float32)
    found = truth(scene, TruthSpec(radius=radius), trip_path=path)
    points, valid = scan(LidarSpec(), LidarParams(), scene.world, jnp.asarray(pose), jax.random.key(seed))
    points = np.asarray(points)
    met = np.asarray(valid) & (np.linalg.norm(points - [0, 0, 0.5], axis=1) < LidarParams().max_range - 1e-3)
    xy = np.asarray(geometry.transform(jnp.asarray(pose), jnp.asarray(points[met, :2])))
    rig = RigSpec(shape=(PIXELS, PIXELS))
    images = {name: image for name, image in zip(CAMERAS, _images(scene.world, pose, rig, seed), strict=True)}
    view = top_view(scene, f"{scene.name}: shortest way {length:.1f} m", path)
    pockets = found.pockets
    gates = np.concatenate([pockets.gate, pockets.gap[:, None] / 2], axis=1)
    true = Truth(depth=found.depth, gates=gates, recovery_points=pockets.recovery)
    return viz.world(file, view, true, images, np.concatenate([xy, points[met, 2:]], axis=1), pose)


def _where_twins_differ(scene: Scene, other: Scene) -> np.ndarray:
    """A pose `BEFORE` metres before the first place that only one of the twins lets through, looking at it."""
    assert scene.start is not None and scene.goal is not None and other.start is not None and other.goal is not None
    blocked = scene.occupied != other.occupied
    if not blocked.any():
        return np.asarray(scene.start)
    place = (np.argwhere(blocked)[:, ::-1] + 0.5) * scene.resolution + np.asarray(scene.origin)
    for candidate in (scene, other):  # the open one leads through
        _, path = worlds.check_trip(candidate, 0.25, MARGIN)
        steps = np.concatenate([np.linspace(a, b, 40, endpoint=False) for a, b in zip(path[:-1], path[1:], strict=True)])
        away = np.linalg.norm(steps[:, None] - place[None], axis=-1).min(axis=1)
        if away.min() < 0.6:
            at = int(np.argmax(away < 0.6))
            along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(steps, axis=0), axis=1)))
            before = int(np.searchsorted(along, along[at] - BEFORE)) if along[at] > BEFORE else 0
            ahead = steps[min(at, before + 60)] - steps[before]
            return np.array([*steps[before], math.atan2(ahead[1], ahead[0])])
    middle = place.mean(axis=0)
    return np.array([*scene.start[:2], math.atan2(*(middle - np.asarray(scene.start[:2]))[::-1])])


def gallery(file: Path, families: Sequence[str], seed: int = 0, split: str = "test") -> Path:
    """A contact sheet: a row per closed family, the closed variant and its open twin, from above and through a camera.

    Args:
        file: PNG to write.
        families: Closed families.
        seed: Of the worlds.
        split: Of the worlds.

    Raises:
        MissingExtra: If matplotlib is not installed.
    """
    rig = RigSpec(RigSpec().mounts[:1], (192, 192))
    names = [[family, *([name] if (name := worlds.twin(family)) else [])] for family in families]
    scenes = [[worlds.sample(name, seed, split) for name in variants] for variants in names]
    # padded alike, all worlds are drawn by one program
    padded = worlds.stack_worlds([scene.world for row in scenes for scene in row])
    rows, count = [], 0
    for variants in scenes:
        pose = _where_twins_differ(variants[0], variants[-1])
        row = []
        for scene in variants:
            world = jax.tree.map(lambda a, k=count: a[k], padded)
            count += 1
            path = worlds.check_trip(scene, 0.25, MARGIN)[1]
            row.append((top_view(scene, scene.name, path), _images(world, pose, rig)[0]))
        rows.append(row)
    return viz.gallery(file, rows)
