"""What the robot that gathers frames is to do in a world: host code, drawn from a seed (`behaviours`).

Ways are shortest ways over the true map at `CLEARANCE` (the search graph of `worlds.paths`), their corners every
`SPACING` metres. A tour goes into cells of pockets: those of the closed twin for both twins, so that the same places are
looked at whether they are dead ends or not. Half of the episodes begin at the scene's start, the others anywhere around
pockets, or large worlds would be known by their first rooms only; random places lie around pockets too.
"""

import math
from typing import Any

import numpy as np
from scipy.sparse import csgraph

from drnav_jax.dataset.behaviours import KINDS, Plan
from drnav_jax.worlds import Scene
from drnav_jax.worlds.paths import Graph, search_graph, trace

CLEARANCE = 0.35  # [m] from the robot's centre to the walls
SPACING = 0.5  # [m] between corners
NUM_POINTS = 96  # L
NEAR = 12.0  # [m] by way from where the episode begins: how far off a random place may lie
ELSEWHERE = 0.5  # share of the episodes that do not begin at the scene's start
AROUND = 6.0  # [m] by way from a pocket
LEGS = 8  # most places of a way


def _corners(graph: Graph, nodes: np.ndarray) -> np.ndarray:
    """The way over nodes, thinned to corners `SPACING` apart, its end included."""
    points = graph.points(nodes)
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    wanted = np.arange(0.0, along[-1] + SPACING, SPACING)
    return points[np.minimum(np.searchsorted(along, wanted), len(points) - 1)]


def _node_at(graph: Graph, point: tuple[float, ...]) -> int:
    """Number of the node that is nearest to a point."""
    return int(np.argmin(np.linalg.norm(graph.points(np.arange(len(graph.cells))) - np.asarray(point), axis=1)))


def _nodes_where(graph: Graph, mask: np.ndarray, origin: tuple[float, float], resolution: float) -> np.ndarray:
    """Nodes whose place lies in a cell of `mask` `[H, W]`."""
    cell = np.floor((graph.points(np.arange(len(graph.cells))) - np.asarray(origin)) / resolution).astype(int)[:, ::-1]
    inside = np.all((cell >= 0) & (cell < np.asarray(mask.shape)), axis=1)
    cell = np.clip(cell, 0, np.asarray(mask.shape) - 1)
    return np.flatnonzero(inside & mask[cell[:, 0], cell[:, 1]])


def _way(graph: Graph, source: int, places: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """A way from `source` through one node of each set of `places`, as far as `NUM_POINTS` corners go."""
    parts, count = [graph.points(np.array([source]))], 1
    for choices in places:
        if count >= NUM_POINTS:
            break
        cost, previous = csgraph.dijkstra(graph.edges, indices=source, return_predecessors=True)
        choices = choices[np.isfinite(cost[choices]) & (cost[choices] > 2 * SPACING)]
        if len(choices) == 0:
            continue
        target = int(rng.choice(choices))
        corners = _corners(graph, np.asarray(trace(previous, source, target)))
        parts.append(corners[1:])
        count, source = count + len(corners) - 1, target
    return np.concatenate(parts)[:NUM_POINTS]


def draw(scene: Scene, pockets: np.ndarray, kind: str, seed: int) -> Plan:
    """The plan of one episode.

    Args:
        scene: A world with start and goal.
        pockets: True in cells to look into `[H, W]`, on the scene's grid.
        kind: One of `KINDS`.
        seed: Of what is drawn.

    Raises:
        ValueError: If the scene has no trip, or there is no such kind.
    """
    if kind not in KINDS:
        raise ValueError(f'there is no behaviour "{kind}": choose from {", ".join(KINDS)}.')
    if scene.start is None or scene.goal is None:
        raise ValueError(f"{scene.name}: frames are gathered on a trip; give the scene a start and a goal.")
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    graph = search_graph(scene, CLEARANCE)
    begin, goal = _node_at(graph, scene.start[:2]), _node_at(graph, scene.goal)
    first = begin
    deep = _nodes_where(graph, pockets, scene.origin, scene.resolution)
    around = np.isfinite(csgraph.dijkstra(graph.edges, indices=goal))
    if len(deep):
        around &= csgraph.dijkstra(graph.edges, indices=deep, limit=AROUND, min_only=True) <= AROUND
    if around.any() and rng.random() < ELSEWHERE:
        first = int(rng.choice(np.flatnonzero(around)))
    cost = csgraph.dijkstra(graph.edges, indices=first, limit=2 * NEAR)
    near = np.flatnonzero((cost <= NEAR) & around)
    anywhere = near if len(near) else np.array([first])
    if kind == "tour":
        close = deep[np.isfinite(cost[deep])]
        deep = close if len(close) else deep
        source, places = first, [deep, anywhere] * (LEGS // 2 - 1) + [np.array([goal])]
    else:
        source, places = int(rng.choice(anywhere)), [anywhere] * LEGS
    if kind == "wall":
        points = graph.points(np.array([source]))
    elif kind == "reach":
        source = first
        points = np.concatenate([[scene.goal], graph.points(rng.choice(anywhere, LEGS))])
    else:
        points = _way(graph, source, places, rng)
    given = source == begin
    xy = np.asarray(scene.start[:2]) if given else graph.points(np.array([source]))[0]
    yaw = scene.start[2] if given and kind in ("tour", "reach") else rng.uniform(-math.pi, math.pi)
    points = np.concatenate([points, np.repeat(points[-1:], NUM_POINTS - len(points), axis=0)])
    fields: dict[str, Any] = {
        "kind": np.int32(KINDS.index(kind)),
        "start": np.array([*xy, yaw], np.float32),
        "points": points.astype(np.float32),
        "speed": np.float32(rng.uniform(0.6, 1.0)),
        "side": np.float32(rng.choice([-1.0, 1.0])),
        "gap": np.float32(rng.uniform(0.45, 0.9)),
    }
    return Plan(**fields)
