"""BARN worlds: SDF files of cylinders, with the challenge's start, goal, tolerance and time limit.

The robot starts inside the field, which is closed on three sides, and leaves it at the top. It may
drive around in the open. The reference path of world i, `path_i.npy`, holds cells of 0.15 m; its
length is that of start + path + goal.
"""

import math
import os
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from drnav_jax.worlds.maps import read_text
from drnav_jax.worlds.world import Scene, make_world, rasterise

START = (-2.0, 3.0, 1.57)
GOAL = (-2.0, 13.0)
TOLERANCE = 1.0  # [m]
TIME_LIMIT = 100.0  # [s]
PATH_CELL = 0.15  # [m] of the reference paths' grid ...
PATH_OFFSET = (-4.575, 5.075)  # ... and where its cell (0, 0) lies
RESOLUTION = 0.05  # [m] of the ground truth: the cylinders are 0.15 m wide
MARGIN = 3.0  # [m] of ground truth around obstacles, start and goal
HARMLESS = ("ground_plane", "sun")  # includes that hold nothing to run into


def _floats(text: str | None, count: int, what: str) -> np.ndarray:
    try:
        values = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{what} must be {count} finite numbers, got {text!r:.60}")
    return values


def _pose(element: ElementTree.Element | None) -> np.ndarray:
    """x, y, z, yaw of an SDF pose; tilted solids are not boxes and cylinders of ours."""
    found = None if element is None else element.find("pose")
    if found is None:
        return np.zeros(4)
    x, y, z, roll, pitch, yaw = _floats(found.text, 6, "a pose")
    if max(abs(roll), abs(pitch)) > 1e-3:
        raise ValueError(f"a pose is tilted (roll {roll}, pitch {pitch}); only upright ones are read")
    return np.array([x, y, z, yaw])


def _compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    c, s = np.cos(a[3]), np.sin(a[3])
    return a + np.array([c * b[0] - s * b[1], s * b[0] + c * b[1], b[2], b[3]])


def _solids(root: ElementTree.Element) -> tuple[list[list[float]], list[list[float]]]:
    """Boxes and cylinders (rows as in `World`) of all collision elements; states override poses."""
    world = root.find("world")
    if root.tag != "sdf" or world is None:
        raise ValueError("no <sdf><world> in it")
    for include in world.iter("include"):
        uri = include.findtext("uri", "")
        if not uri.strip().endswith(HARMLESS):
            raise ValueError(f"includes {uri!r}; put that model itself into the file")
    states = {m.get("name"): m for state in world.findall("state") for m in state.findall("model")}
    boxes, cylinders = [], []
    for model in world.findall("model"):
        name = model.get("name")
        model_pose = _pose(states.get(name, model))
        for link in model.findall("link"):
            for collision in link.findall("collision"):
                x, y, z, yaw = _compose(_compose(model_pose, _pose(link)), _pose(collision))
                geometry = collision.find("geometry")
                kind = None if geometry is None or len(geometry) == 0 else geometry[0]
                if kind is None or kind.tag not in ("box", "cylinder", "plane"):
                    found = "no shape" if kind is None else kind.tag
                    raise ValueError(f"model {name} has {found}; only boxes and cylinders are read")
                if kind.tag == "box":
                    half = _floats(kind.findtext("size"), 3, f"the size of {name}") / 2
                    boxes.append([x, y, yaw, half[0], half[1], z - half[2], z + half[2]])
                elif kind.tag == "cylinder":
                    radius = _floats(kind.findtext("radius"), 1, f"the radius of {name}")
                    length = _floats(kind.findtext("length"), 1, f"the length of {name}")
                    half = np.concatenate([radius, length / 2])
                    cylinders.append([x, y, half[0], z - half[1], z + half[1]])
                if kind.tag != "plane" and half.min() <= 0:
                    raise ValueError(f"model {name} has a size that is not > 0 m")
    if not boxes and not cylinders:
        raise ValueError("no box and no cylinder in it")
    return boxes, cylinders


def _reference_length(path: Path) -> float | None:
    """Length [m] of start + reference path + goal, or None if there is no such file."""
    number = re.fullmatch(r"world_(\d+)", path.stem)
    file = path.with_name(f"path_{number[1]}.npy") if number else None
    if file is None or not file.is_file():
        return None
    try:
        cells = np.load(file, allow_pickle=False)
        if cells.ndim != 2 or cells.shape[1] != 2 or len(cells) == 0:
            raise ValueError(f"expected cells [L, 2], got shape {cells.shape}")
        points = cells.astype(np.float64) * PATH_CELL + PATH_OFFSET
        if not np.isfinite(points).all():
            raise ValueError("it holds numbers that are not finite")
    except Exception as error:  # NumPy raises whatever its header parser does
        raise ValueError(f"{file}: not a reference path ({error}); remove it or mend it.") from None
    whole = np.concatenate([[START[:2]], points, [GOAL]])
    return float(np.linalg.norm(np.diff(whole, axis=0), axis=1).sum())


def load_barn(path: str | os.PathLike) -> Scene:
    """The world of a BARN `.world` file with the challenge's trip.

    Args:
        path: The SDF file. If `path_i.npy` lies beside `world_i.world`, the scene gets its length.

    Raises:
        ValueError: If the file is no SDF world of upright boxes and cylinders, or the path file is
            malformed.
    """
    path = Path(path)
    text = read_text(path)
    try:
        boxes, cylinders = _solids(ElementTree.fromstring(text))
    except ElementTree.ParseError as error:
        raise ValueError(f"{path}: not valid XML ({error}).") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}.") from None
    world = make_world(boxes, cylinders)
    reach = np.array([math.hypot(*row[3:5]) for row in boxes] + [row[2] for row in cylinders])
    centres = np.array([row[:2] for row in boxes + cylinders])
    ends = np.array([START[:2], GOAL])
    low = np.minimum((centres - reach[:, None]).min(0), ends.min(0)) - MARGIN
    high = np.maximum((centres + reach[:, None]).max(0), ends.max(0)) + MARGIN
    if (high - low).max() > 1000:
        raise ValueError(f"{path}: is {(high - low).max():.0f} m wide; the limit is 1000 m.")
    low = np.floor(low / RESOLUTION) * RESOLUTION
    columns, rows = np.ceil((high - low) / RESOLUTION).astype(int)
    origin = (float(low[0]), float(low[1]))
    return Scene(
        name=path.stem,
        world=world,
        occupied=rasterise(world, origin, (int(rows), int(columns)), RESOLUTION),
        origin=origin,
        resolution=RESOLUTION,
        start=START,
        goal=GOAL,
        goal_tolerance=TOLERANCE,
        time_limit=TIME_LIMIT,
        reference_length=_reference_length(path),
    )
