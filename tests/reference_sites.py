"""Checks of worlds made of many decisions: flood fills on the ground truth, independent of how ways are searched."""

import numpy as np
from scipy import ndimage

from drnav_jax.worlds import Scene, check_trip, trip_cells
from drnav_jax.worlds.labels import LabelSpec, dead_ends

EIGHT = np.ones((3, 3), int)
ROBOT = 0.33  # [m] R and the planning margin
DOOR = 0.45  # [m] half of the narrowest door on a trip


def clearance(occupied: np.ndarray, resolution: float) -> np.ndarray:
    """Distance [m] of cell centres to the nearest occupied cell's edge; outside is free."""
    return ndimage.distance_transform_edt(~np.pad(occupied, 1))[1:-1, 1:-1] * resolution - resolution / 2


def cell(scene: Scene, point: np.ndarray | tuple) -> tuple[int, int]:
    """(row, column) of a point."""
    x, y = np.floor((np.asarray(point[:2]) - scene.origin) / scene.resolution).astype(int)
    return int(y), int(x)


def joined(scene: Scene, least: float, occupied: np.ndarray | None = None) -> bool:
    """Whether start and goal are joined by cells that keep a clearance; the grid's edge is the world's."""
    free = clearance(scene.occupied if occupied is None else occupied, scene.resolution) >= least
    part, _ = ndimage.label(free, EIGHT)
    a, b = part[cell(scene, scene.start)], part[cell(scene, scene.goal)]
    return bool(a == b > 0)


def closed_area(scene: Scene, radius: float) -> float:
    """Area [m^2] where a robot's centre may be that has no way to the grid's edge."""
    free = np.pad(clearance(scene.occupied, scene.resolution) > radius, 1, constant_values=True)
    part, _ = ndimage.label(free, EIGHT)
    return float((free & (part != part[0, 0])).sum() * scene.resolution**2)


def filled(scene: Scene, hull: np.ndarray) -> np.ndarray:
    """The ground truth with a convex polygon `[4, 2]` (corners in order) solid."""
    h, w = scene.occupied.shape
    x = scene.origin[0] + (np.arange(w) + 0.5) * scene.resolution
    y = scene.origin[1] + (np.arange(h) + 0.5) * scene.resolution
    inside = np.ones((h, w), bool)
    turn = np.sign(np.linalg.det(np.stack([hull[1] - hull[0], hull[2] - hull[1]])))
    for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        side = (b[0] - a[0]) * (y[:, None] - a[1]) - (b[1] - a[1]) * (x[None, :] - a[0])
        inside &= turn * side >= 0
    return scene.occupied | inside


def check_trip_and_truth(scene: Scene, boxes: int, loose: float = 1.0) -> None:
    """What holds of every such world: start and goal are free and joined, few boxes, hardly any closed space."""
    room = clearance(scene.occupied, scene.resolution)
    assert room[cell(scene, scene.start)] >= 0.4 and room[cell(scene, scene.goal)] >= 0.4
    assert joined(scene, ROBOT)
    assert joined(scene, DOOR - 0.07)  # doors at least 0.9 m wide, less what the grid takes of turned walls
    assert len(scene.world.boxes) <= boxes
    assert closed_area(scene, 0.25) <= loose
    assert scene.outside_is_free


def check_twins(closed: Scene, opened: Scene) -> None:
    """Twins share all but what stands in a few passages."""
    assert (closed.start, closed.goal, closed.origin) == (opened.start, opened.goal, opened.origin)
    assert closed.occupied.shape == opened.occupied.shape
    rows = [
        {tuple(row) for row in np.column_stack([s.world.boxes, s.world.box_surfaces.material]).tolist()}
        for s in (closed, opened)
    ]
    assert 1 <= len(rows[0] - rows[1]) <= 16 and len(rows[1] - rows[0]) <= 16
    np.testing.assert_array_equal(closed.world.cylinders, opened.world.cylinders)
    for a, b in zip(closed.world.scenery, opened.world.scenery, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (closed.occupied & ~opened.occupied).sum() * closed.resolution**2 < 40.0  # [m^2]


def pockets_by_the_way(scene: Scene, near: float = 4.0) -> tuple[float, int, int]:
    """Length [m] of the shortest way, how many of its cells are labelled, and how many pockets lie along it."""
    length, path = check_trip(scene, 0.25, ROBOT)
    cells = trip_cells(path, scene.origin, scene.resolution)
    labels = dead_ends(scene.occupied, scene.resolution, LabelSpec(), trip_path=cells)
    on = np.zeros(scene.occupied.shape, bool)
    on[tuple(cells.T)] = True
    beside = ndimage.distance_transform_edt(~on) * scene.resolution <= near
    found = np.unique(labels.pocket[beside & (labels.pocket > 0)])
    return length, int(labels.label[on].sum()), len(found)


def check_no_way_around(scene: Scene) -> None:
    """What is before the wings is joined to what is behind them through the site only."""
    long = scene.world.boxes[scene.world.boxes[:, 3:5].max(axis=1) > 45.0]  # the wings
    assert len(long) == 2
    length, _ = check_trip(scene, 0.25, ROBOT)
    assert 2 * long[:, 3:5].max(axis=1).min() > 0.7 * length + 20.0
    # With the site's own block filled up, start and goal are apart on the grid.
    ends = np.concatenate([_ends(row) for row in long])
    a, b = min(((p, q) for p in ends[:2] for q in ends[2:]), key=lambda e: np.hypot(*(e[0] - e[1])))
    assert np.hypot(*(a - b)) > 5.0
    ahead = np.array([[0, -1], [1, 0]]) @ (b - a) / np.hypot(*(b - a))
    ahead = ahead * np.sign(ahead @ (np.array(scene.goal) - a)) * 300.0
    back = -ahead / np.hypot(*ahead) * 0.2
    block = np.array([a + back, b + back, b + ahead, a + ahead])
    parts, _ = ndimage.label(~filled(scene, block), EIGHT)
    assert parts[cell(scene, scene.start)] > 0
    side = [p for p in (a, b)]
    beyond = [p + ahead / 300.0 * 4.0 + (p - q) / np.hypot(*(p - q)) * 1.5 for p, q in (side, side[::-1])]
    for point in beyond:  # beside the site, in front of its wings
        r, c = cell(scene, point)
        if 0 <= r < parts.shape[0] and 0 <= c < parts.shape[1]:
            assert parts[r, c] != parts[cell(scene, scene.start)]


def _ends(row: np.ndarray) -> np.ndarray:
    """Both ends `[2, 2]` of a long box's centre line."""
    x, y, yaw, hx, hy = row[:5].astype(float)
    yaw, half = (yaw, hx) if hx > hy else (yaw + np.pi / 2, hy)
    along = half * np.array([np.cos(yaw), np.sin(yaw)])
    return np.array([[x, y] + along, [x, y] - along])
