"""Worlds to drive in: geometry, ground truth, loaders and seeded families."""

from drnav_jax.worlds.barn import load_barn
from drnav_jax.worlds.families import FAMILIES, SPLITS, sample, twin
from drnav_jax.worlds.maps import load_floor_plan, load_map_server, load_occupancy
from drnav_jax.worlds.materials import BLOCKS, EXTINCTION, FLOORS, Material
from drnav_jax.worlds.moving_ai import ScenarioTrip, load_moving_ai, load_scenario, with_scenario
from drnav_jax.worlds.ranges import HELD_OUT, RANGES
from drnav_jax.worlds.trips import check_trip, sample_trips, shortest_path, trip_cells
from drnav_jax.worlds.world import (
    FAR,
    HEADROOM,
    WALL_HEIGHT,
    Scene,
    Scenery,
    Surfaces,
    World,
    distance_field,
    from_grid,
    make_world,
    no_field,
    rasterise,
    signed_distance,
    stack_worlds,
    surfaces,
)

__all__ = [
    "BLOCKS",
    "EXTINCTION",
    "FAMILIES",
    "FAR",
    "FLOORS",
    "HEADROOM",
    "HELD_OUT",
    "RANGES",
    "SPLITS",
    "WALL_HEIGHT",
    "Material",
    "Scene",
    "ScenarioTrip",
    "Scenery",
    "Surfaces",
    "World",
    "check_trip",
    "distance_field",
    "from_grid",
    "load_barn",
    "load_floor_plan",
    "load_map_server",
    "load_moving_ai",
    "load_occupancy",
    "load_scenario",
    "make_world",
    "no_field",
    "rasterise",
    "sample",
    "sample_trips",
    "shortest_path",
    "signed_distance",
    "stack_worlds",
    "surfaces",
    "trip_cells",
    "twin",
    "with_scenario",
]
