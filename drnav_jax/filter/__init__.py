"""The belief of one robot: occupancy, dead ends (paper eq. 4-6) and recovery points."""

from drnav_jax.filter import barrier, belief, dead_end, occupancy, recovery
from drnav_jax.filter.barrier import BarrierParams
from drnav_jax.filter.belief import FilterParams, FilterSpec, FilterState
from drnav_jax.filter.dead_end import DeadEndParams
from drnav_jax.filter.occupancy import OccupancyParams
from drnav_jax.filter.recovery import RecoveryParams, RecoveryPoints, RecoverySpec

__all__ = [
    "BarrierParams",
    "DeadEndParams",
    "FilterParams",
    "FilterSpec",
    "FilterState",
    "OccupancyParams",
    "RecoveryParams",
    "RecoveryPoints",
    "RecoverySpec",
    "barrier",
    "belief",
    "dead_end",
    "occupancy",
    "recovery",
]
