"""Ways of a site as a graph: which of them are shut, where the trip goes, and which shut one tempts.

Nodes are places, edges are ways with a length. From a spanning tree (every place can be reached), some more edges are
opened (loops); what stays shut makes dead ends. A *shortcut* is a shut edge that would make the trip shorter: in front
of it lies a dead end that a traveller without a map takes for the way. A site's closed twin has its shortcuts shut, its
open twin has them open.
"""

import heapq
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

Edge = tuple[int, int]  # nodes, the smaller one first


class Route(NamedTuple):
    """The shortest way between two nodes."""

    length: float
    nodes: list[int]


def edge(a: int, b: int) -> Edge:
    """The edge between two nodes."""
    return (a, b) if a < b else (b, a)


def grid_edges(columns: int, rows: int) -> list[Edge]:
    """Edges between neighbours in a grid whose node (i, j), column and row, is i + columns j."""
    across = [(i + columns * j, i + 1 + columns * j) for j in range(rows) for i in range(columns - 1)]
    return across + [(i + columns * j, i + columns * (j + 1)) for j in range(rows - 1) for i in range(columns)]


def neighbours(edges: Iterable[Edge]) -> dict[int, list[int]]:
    """Nodes beside each node, ascending."""
    out: dict[int, list[int]] = {}
    for a, b in sorted(edges):
        out.setdefault(a, []).append(b)
        out.setdefault(b, []).append(a)
    return {node: sorted(near) for node, near in out.items()}


def grow(edges: Sequence[Edge], root: int, winding: float, rng: np.random.Generator) -> set[Edge]:
    """A random spanning tree of the part that holds the root.

    Args:
        edges: Of the whole graph.
        root: Node to begin at.
        winding: 1 = long winding branches (the newest node grows), 0 = short bushy ones (a random one does).
        rng: Generator.
    """
    near = neighbours(edges)
    tree: set[Edge] = set()
    reached, active = {root}, [root]
    while active:
        k = len(active) - 1 if rng.random() < winding else int(rng.integers(len(active)))
        node = active[k]
        fresh = [n for n in near.get(node, []) if n not in reached]
        if not fresh:
            active.pop(k)
            continue
        chosen = fresh[rng.integers(len(fresh))]
        tree.add(edge(node, chosen))
        reached.add(chosen)
        active.append(chosen)
    return tree


def braid(edges: Sequence[Edge], ways: set[Edge], share: float, rng: np.random.Generator) -> set[Edge]:
    """The ways, and some of the other edges: loops."""
    others = [e for e in edges if e not in ways]
    return ways | {e for e in others if rng.random() < share}


def route(ways: Iterable[Edge], length: dict[Edge, float], start: int, goal: int) -> Route:
    """The shortest way; length inf and no nodes if there is none."""
    near = neighbours(ways)
    best, came, queue = {start: 0.0}, {}, [(0.0, start)]
    while queue:
        far, node = heapq.heappop(queue)
        if node == goal:
            break
        if far > best[node]:
            continue
        for n in near.get(node, []):
            reach = far + length[edge(node, n)]
            if reach < best.get(n, np.inf):
                best[n], came[n] = reach, node
                heapq.heappush(queue, (reach, n))
    if goal not in best:
        return Route(float("inf"), [])
    nodes = [goal]
    while nodes[-1] != start:
        nodes.append(came[nodes[-1]])
    return Route(best[goal], nodes[::-1])


def shortcuts(
    shut: Iterable[Edge], ways: set[Edge], length: dict[Edge, float], start: int, goal: int, saving: float
) -> list[Edge]:
    """The shut edges each of which would make the trip shorter by `saving` [m] or more, the best one first."""
    now = route(ways, length, start, goal).length
    gains = {e: now - route(ways | {e}, length, start, goal).length for e in sorted(shut)}
    return sorted((e for e, gain in gains.items() if gain >= saving), key=lambda e: (-gains[e], e))


def side_branches(ways: set[Edge], trip: Sequence[int]) -> dict[int, set[int]]:
    """Dead-end branches of the trip: node on the trip -> nodes that only it leads to (in one branch or more)."""
    on, near = set(trip), neighbours(ways)
    seen: set[int] = set(on)
    out: dict[int, set[int]] = {}
    for node in trip:
        for first in near.get(node, []):
            if first in seen:
                continue
            part, doors, todo = {first}, set(), [first]
            while todo:
                here = todo.pop()
                for n in near[here]:
                    if n in on:
                        doors.add(edge(here, n))
                    elif n not in part:
                        part.add(n)
                        todo.append(n)
            seen |= part
            if len(doors) == 1:
                out.setdefault(node, set()).update(part)
    return out
