"""Trips: where to start and where to go in a world, drawn at random or checked."""

import dataclasses
import math

import numpy as np
from scipy.sparse import csgraph

from drnav_jax.worlds.paths import (
    nodes_near,
    path_length,
    search_graph,
    shortest_path,
    taut,
    trace,
    trip_cells,
)
from drnav_jax.worlds.world import Scene, signed_distance

__all__ = ["check_trip", "sample_trips", "shortest_path", "trip_cells"]


def sample_trips(
    scene: Scene,
    num: int,
    seed: int,
    clearance_radius: float,
    min_length: float = 8.0,
) -> list[Scene]:
    """The scene with random starts and goals.

    Starts are uniform over the largest connected part that keeps the clearance, goals over what lies
    at least `min_length` away by the shortest path, yaws over the circle.

    Args:
        scene: The world; a start and a goal of its own are replaced.
        num: Number of trips.
        seed: Same seed, same trips.
        clearance_radius: Distance that start, goal and the path between them keep to walls [m].
        min_length: Least length of the shortest path [m].

    Returns:
        `num` scenes, named NAME#k; their tolerance, time limit and reference length are unset.

    Raises:
        ValueError: If a number is out of range, or the scene has no such trips.
    """
    if num < 0 or seed < 0:
        raise ValueError(f"num and seed must be >= 0, got {num} and {seed}.")
    if not (math.isfinite(min_length) and min_length >= 0):
        raise ValueError(f"min_length must be finite and >= 0 m, got {min_length}.")
    graph = search_graph(scene, clearance_radius)
    if len(graph.part) == 0:
        raise ValueError(
            f"{scene.name}: nowhere is {clearance_radius} m away from the walls; lower the clearance."
        )
    largest = np.flatnonzero(graph.part == np.argmax(np.bincount(graph.part)))
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    trips: list[Scene] = []
    for _ in range(20 * num + 20):
        if len(trips) == num:
            break
        source = int(rng.choice(largest))
        cost, previous = csgraph.dijkstra(graph.edges, indices=source, return_predecessors=True)
        far = np.flatnonzero(np.isfinite(cost) & (cost >= min_length))
        if len(far) == 0:
            continue
        target = int(rng.choice(far))
        start, goal = graph.points(np.array([source, target]))
        # The graph's length is up to 2.7 % too long.
        if cost[target] < 1.03 * min_length:
            if path_length(taut(graph, trace(previous, source, target), start, goal)) < min_length:
                continue
        trips.append(
            dataclasses.replace(
                scene,
                name=f"{scene.name}#{len(trips)}",
                start=(float(start[0]), float(start[1]), float(rng.uniform(-math.pi, math.pi))),
                goal=(float(goal[0]), float(goal[1])),
                goal_tolerance=None,
                time_limit=None,
                reference_length=None,
            )
        )
    if len(trips) < num:
        raise ValueError(
            f"{scene.name}: found {len(trips)} of {num} trips of {min_length} m or more at a clearance "
            f"of {clearance_radius} m; lower either."
        )
    return trips


def check_trip(
    scene: Scene, radius: float, clearance_radius: float | None = None
) -> tuple[float, np.ndarray]:
    """Make sure that a scene's trip can be driven.

    Args:
        scene: A scene with start and goal.
        radius: Of the robot [m].
        clearance_radius: What the path is to keep to walls [m]; None = `radius`.

    Returns:
        Length [m] and corners `[L, 2]` [m] of the shortest path.

    Raises:
        ValueError: If start or goal is missing, off the map or in an obstacle, or no path joins
            them; names the coordinates and, if there is one near, a free place.
    """
    clearance = radius if clearance_radius is None else clearance_radius
    if scene.start is None or scene.goal is None:
        raise ValueError(f"{scene.name}: has no start or no goal; give both, or use sample_trips.")
    graph = search_graph(scene, clearance)
    ends = {"start": np.array(scene.start[:2]), "goal": np.array(scene.goal)}
    for name, point in ends.items():
        place = f"({point[0]:.2f}, {point[1]:.2f})"
        if not np.isfinite(point).all():
            raise ValueError(f"{scene.name}: the {name} {place} must be finite numbers.")
        low, high = graph.origin, graph.origin + np.array(graph.node.shape[::-1]) * graph.resolution
        if (point < low).any() or (point > high).any():
            raise ValueError(
                f"{scene.name}: the {name} {place} is off the map, which spans x {low[0]:.2f} to "
                f"{high[0]:.2f} m, y {low[1]:.2f} to {high[1]:.2f} m."
            )
        if len(nodes_near(graph, point)) == 0:
            distance = float(signed_distance(scene.world, point[None])[0])
            away = np.linalg.norm(graph.points(np.arange(len(graph.cells))) - point, axis=1)
            hint = "nothing on the map is free"
            if len(away):
                near = graph.points(np.array([np.argmin(away)]))[0]
                hint = f"the nearest place is ({near[0]:.2f}, {near[1]:.2f})"
            what = "in an obstacle" if distance <= 0 else f"{distance:.2f} m from an obstacle"
            raise ValueError(f"{scene.name}: the {name} {place} is {what}, needs {clearance} m; {hint}.")
    found = shortest_path(scene, ends["start"], ends["goal"], clearance)
    if found is None:
        (x0, y0), (x1, y1) = ends["start"], ends["goal"]
        raise ValueError(
            f"{scene.name}: no way from ({x0:.2f}, {y0:.2f}) to ({x1:.2f}, {y1:.2f}) keeps {clearance} m "
            "to the walls; move the start or the goal, or use sample_trips."
        )
    return found
