"""Shortest paths through the true map of a world.

The shortest path at a clearance is searched on a grid of 0.05-0.1 m whose cells know their exact
distance to the walls: a graph search over 16 directions (its lengths are up to 2.7 % too long) finds
the way, then a taut string along it is found by dynamic programming over points of the path that
see each other, in rounds that refine the string's own points:

    D_0 = 0,   D_j = min over i < j in sight of j of (D_i + |p_j - p_i|)                       (1)

All of it is host code for preparing worlds: nothing here runs inside an episode.
"""

import math
from collections import OrderedDict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array, csgraph, csr_array

from drnav_jax.types import GridMap
from drnav_jax.worlds.world import Scene, World, from_grid, near_distance

MAX_CELLS = 150_000  # of a search grid at 0.05 m; larger ones are searched at 0.1 m
STEPS = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))  # half of the 16
CACHED = 8  # graphs kept
MARGIN = 1.0  # [m] beyond the clearance, up to which a graph knows the distance to the walls
STRING_SPACING = 0.5  # [m] points of the string in its refining rounds
STRING_ROUNDS = 3
STRING_WINDOW = 80  # points that one point looks ahead
SLACK = 1e-3  # [m] sight lines may come this much closer to the walls


class Graph(NamedTuple):
    """The cells of a map that keep a clearance, linked in 16 directions."""

    distance: np.ndarray  # [H, W] to the walls [m], cut off at clearance + MARGIN
    origin: np.ndarray  # [2]
    resolution: float
    clearance: float
    node: np.ndarray  # [H, W] number of each free cell, -1 elsewhere
    cells: np.ndarray  # [K, 2] (row, column) of each node
    edges: csr_array  # [K, K] lengths [m], both directions
    part: np.ndarray  # [K] connected part of each node

    def points(self, nodes: np.ndarray) -> np.ndarray:
        """x, y [m] of nodes."""
        return self.origin + (self.cells[nodes][..., ::-1] + 0.5) * self.resolution

    def sample(self, points: np.ndarray) -> np.ndarray:
        """Distance to the walls [m] at points `[N, 2]`."""
        cell = ((points - self.origin) / self.resolution - 0.5)[:, ::-1].T
        return ndimage.map_coordinates(self.distance, cell, order=1, mode="nearest")


# What a graph was built from (the array and the world themselves, so that their ids stay theirs).
_cache: OrderedDict[tuple, tuple[object, object, np.ndarray, Graph]] = OrderedDict()


def _search_grid(occupied: np.ndarray, native: float) -> tuple[tuple[int, int], float]:
    """Shape and cell size [m] to search at: native, but >= 0.05 m, and >= 0.1 m if that is large."""
    for least in (0.05, 0.1):
        r = native if native > least - 1e-6 else least
        shape = tuple(max(1, math.floor(n * native / r + 1e-6)) for n in occupied.shape)
        if shape[0] * shape[1] <= MAX_CELLS:
            break
    return (shape[0], shape[1]), r


def _build(world: World, origin: np.ndarray, shape: tuple[int, int], r: float, c: float) -> Graph:
    h, w = shape
    distance = near_distance(world, origin, shape, r, c + MARGIN)
    free = distance >= c
    node = np.where(free, np.cumsum(free).reshape(h, w) - 1, -1).astype(np.int32)
    tails, heads, lengths = [], [], []
    for dr, dc in STEPS:
        a = np.s_[: h - dr, max(0, -dc) : w - max(0, dc)]
        b = np.s_[dr:, max(0, dc) : w + min(0, dc)]
        # Half way lies a cell edge, a corner or a cell's side: the mean of the cells around it.
        if abs(dc) + dr == 1:
            middle = np.minimum(distance[a], distance[b])
        elif (dr, abs(dc)) == (1, 1):
            p, q = np.s_[dr:, a[1]], np.s_[: h - dr, b[1]]
            middle = (distance[a] + distance[b] + distance[p] + distance[q]) / 4
        elif dr == 1:
            m = np.s_[max(0, -dc) + (1 if dc > 0 else -1) : w - max(0, dc) + (1 if dc > 0 else -1)]
            middle = (distance[: h - 1, m] + distance[1:, m]) / 2
        else:
            middle = (distance[1 : h - 1, a[1]] + distance[1 : h - 1, b[1]]) / 2
        linked = free[a] & free[b] & (middle >= c)
        tails.append(node[a][linked])
        heads.append(node[b][linked])
        lengths.append(np.full(int(linked.sum()), math.hypot(dr, dc) * r))
    tail, head, length = (np.concatenate(parts) for parts in (tails, heads, lengths))
    count = int(free.sum())
    both = (np.concatenate([tail, head]), np.concatenate([head, tail]))
    edges = coo_array((np.tile(length, 2), both), shape=(count, count)).tocsr()
    part = csgraph.connected_components(edges, directed=False)[1] if count else np.zeros(0, int)
    return Graph(distance, origin, r, c, node, np.argwhere(free), edges, part)


def search_graph(where: Scene | GridMap, clearance: float) -> Graph:
    """The search graph of a scene or an occupancy grid; the last few are kept."""
    if not (math.isfinite(clearance) and clearance >= 0):
        raise ValueError(f"clearance_radius must be finite and >= 0 m, got {clearance}.")
    is_scene = isinstance(where, Scene)
    occupied, world = (where.occupied, where.world) if is_scene else (where.values, None)
    grid = np.asarray(occupied)
    if grid.ndim != 2 or grid.dtype != bool:
        raise ValueError(f"occupancy must be bool [H, W], got {grid.dtype} {grid.shape}.")
    origin = (float(where.origin[0]), float(where.origin[1]))
    native = float(where.resolution)
    key = (id(occupied), id(world), origin, native, float(clearance))
    found = _cache.get(key)
    if found is not None and np.array_equal(found[2], grid):  # it may have been written to since
        _cache.move_to_end(key)
        return found[3]
    shape, r = _search_grid(grid, native)
    solid = from_grid(grid, origin, native) if world is None else world
    graph = _build(solid, np.array(origin), shape, r, float(clearance))
    _cache[key] = (occupied, world, grid.copy(), graph)
    while len(_cache) > CACHED:
        _cache.popitem(last=False)
    return graph


def _in_sight(graph: Graph, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whether each segment a -> b `[N, 2]` keeps the clearance, sampled every half cell."""
    count = np.ceil(np.linalg.norm(b - a, axis=1) / (graph.resolution / 2)).astype(int) + 1
    which = np.repeat(np.arange(len(a)), count)
    first = np.cumsum(count) - count
    t = (np.arange(len(which)) - first[which]) / np.maximum(count - 1, 1)[which]
    near = graph.sample(a[which] + t[:, None] * (b - a)[which]) < graph.clearance - SLACK
    blocked = np.zeros(len(a), bool)
    blocked[which[near]] = True
    return ~blocked


def _pull(graph: Graph, points: np.ndarray) -> np.ndarray:
    """The shortest chain of points in sight of each other, first to last (equation 1)."""
    n = len(points)
    i, j = np.triu_indices(n, 1)
    i, j = i[j - i <= STRING_WINDOW], j[j - i <= STRING_WINDOW]
    apart = np.linalg.norm(points[j] - points[i], axis=1)
    # Neighbours on the path are linked as they are, so that there always is a chain.
    sight = np.concatenate(
        [_in_sight(graph, points[i[s : s + 4096]], points[j[s : s + 4096]]) for s in range(0, len(i), 4096)]
    )
    apart[~sight & (j - i > 1)] = np.inf
    best, previous = np.full(n, np.inf), np.zeros(n, int)
    best[0] = 0.0
    order = np.argsort(j, kind="stable")
    starts = np.searchsorted(j[order], np.arange(n + 1))
    for k in range(1, n):
        into = order[starts[k] : starts[k + 1]]
        total = best[i[into]] + apart[into]
        m = int(np.argmin(total))
        best[k], previous[k] = total[m], i[into[m]]
    chain = [n - 1]
    while chain[-1] > 0:
        chain.append(int(previous[chain[-1]]))
    return points[chain[::-1]]


def _bends(points: np.ndarray) -> np.ndarray:
    """Points `[L, 2]` without those that lie on a straight line between their neighbours."""
    if len(points) < 3:
        return points
    a, b = np.diff(points[:-1], axis=0), np.diff(points[1:], axis=0)
    turn = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > 1e-9
    return points[np.concatenate([[True], turn, [True]])]


def _refined(points: np.ndarray, spacing: float) -> np.ndarray:
    """Points `[L, 2]` with further ones in between, at most `spacing` apart."""
    parts = [points[:1]]
    for a, b in zip(points[:-1], points[1:], strict=True):
        count = max(1, math.ceil(math.hypot(*(b - a)) / spacing))
        parts.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(parts)


def path_length(points: np.ndarray) -> float:
    """Length [m] of a polyline `[L, 2]`."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def nodes_near(graph: Graph, point: np.ndarray) -> np.ndarray:
    """Nodes within two cells of a point that see it, nearest first; none if it is too close."""
    if graph.sample(point[None])[0] < graph.clearance - SLACK:
        return np.zeros(0, int)
    h, w = graph.node.shape
    row, col = np.floor((point - graph.origin) / graph.resolution).astype(int)[::-1]
    if not (0 <= row < h and 0 <= col < w):
        return np.zeros(0, int)
    window = np.s_[max(0, row - 2) : row + 3, max(0, col - 2) : col + 3]
    nodes = graph.node[window].ravel()
    nodes = nodes[nodes >= 0]
    ends = graph.points(nodes)
    nodes = nodes[_in_sight(graph, np.broadcast_to(point, ends.shape), ends)] if len(nodes) else nodes
    return nodes[np.argsort(np.linalg.norm(graph.points(nodes) - point, axis=1), kind="stable")]


def taut(graph: Graph, nodes: list[int], start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """The taut string along the nodes of a path."""
    path = np.concatenate([start[None], graph.points(np.array(nodes)), goal[None]])
    if _in_sight(graph, start[None], goal[None])[0]:
        return np.stack([start, goal])
    path = _pull(graph, _refined(_bends(path), 4 * STRING_SPACING))
    for _ in range(STRING_ROUNDS - 1):
        path = _pull(graph, _refined(_bends(path), STRING_SPACING))
    return _bends(path)


def trace(previous: np.ndarray, source: int, target: int) -> list[int]:
    """The nodes from source to target that Dijkstra's predecessors tell of."""
    nodes = [target]
    while nodes[-1] != source:
        nodes.append(int(previous[nodes[-1]]))
    return nodes[::-1]


def shortest_path(
    where: Scene | GridMap,
    start: Sequence[float] | np.ndarray,
    goal: Sequence[float] | np.ndarray,
    clearance_radius: float,
) -> tuple[float, np.ndarray] | None:
    """The shortest any-angle path that keeps a clearance to all walls, within 1 % of its length.

    Args:
        where: A scene, or its occupancy as a `GridMap` of bool. The search graph of the last few
            pairs of map and clearance is kept. Paths do not leave the grid.
        start: x, y [m]; a yaw after them is ignored.
        goal: x, y [m].
        clearance_radius: Least distance of the path to anything solid [m].

    Returns:
        Length [m] and the corners of the path `[L, 2]` [m], start and goal included; None if either
        is too close to a wall or outside the grid, or there is no such path.

    Raises:
        ValueError: If the clearance is negative or the occupancy is not bool `[H, W]`.
    """
    graph = search_graph(where, clearance_radius)
    a, b = (np.asarray(p, np.float64).reshape(-1)[:2] for p in (start, goal))
    from_nodes, to_nodes = nodes_near(graph, a), nodes_near(graph, b)
    both = np.intersect1d(graph.part[from_nodes], graph.part[to_nodes])
    if len(both) == 0:
        return None
    source = int(from_nodes[graph.part[from_nodes] == both[0]][0])
    target = int(to_nodes[graph.part[to_nodes] == both[0]][0])
    previous = csgraph.dijkstra(graph.edges, indices=source, return_predecessors=True)[1]
    path = taut(graph, trace(previous, source, target), a, b)
    return path_length(path), path


def trip_cells(
    path: np.ndarray, origin: Sequence[float] | np.ndarray, resolution: float
) -> np.ndarray:
    """Every cell that a polyline passes.

    Args:
        path: x, y `[L, 2]` [m].
        origin: World position of the outer corner of cell (0, 0) [m].
        resolution: Edge of a cell [m].

    Returns:
        (row, column) `[N, 2]` int64 in the order of the path, each once; may lie off the grid.
    """
    points = (np.asarray(path, np.float64).reshape(-1, 2) - np.asarray(origin)) / resolution
    cells = [np.floor(points[:1])]
    for a, b in zip(points[:-1], points[1:], strict=True):
        t = [np.array([0.0, 1.0])]
        for k in (0, 1):
            low, high = sorted((a[k], b[k]))
            lines = np.arange(math.ceil(low), math.floor(high) + 1)
            if high > low:
                t.append((lines - a[k]) / (b[k] - a[k]))
        t = np.unique(np.clip(np.concatenate(t), 0.0, 1.0))
        # Between two crossings of grid lines the segment is inside one cell.
        cells += [np.floor(a + (b - a) * ((t[:-1] + t[1:]) / 2)[:, None]), np.floor(b[None])]
    found = np.concatenate(cells).astype(np.int64)[:, ::-1]
    _, first = np.unique(found, axis=0, return_index=True)
    return found[np.sort(first)]
