"""Maps that the planners' tests share."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from drnav_jax.types import GridMap


@pytest.fixture(scope="session")
def clearance_of():
    """A function from obstacles to the clearance [m] that planners read, as a `GridMap`."""

    def clearance(occupied, origin, resolution, cap=1.0):
        distance = np.full(occupied.shape, cap)
        if occupied.any():
            distance = np.minimum(ndimage.distance_transform_edt(~occupied) * resolution, cap)
        values = jnp.asarray(distance, jnp.float32)
        return GridMap(values, jnp.asarray(origin, jnp.float32), resolution)

    return clearance
