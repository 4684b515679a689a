"""What the containers refuse, and what an empty observation is."""

import jax.numpy as jnp
import pytest

from drnav_jax.types import GridSpec, empty_observation


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"resolution": 0.0}, "resolution must be > 0 m, got 0.0"),
        ({"resolution": -0.1}, "resolution must be > 0 m"),
        ({"stride": 0}, "stride must be >= 1 cell, got 0"),
        ({"shape": (63, 64)}, "even numbers of cells"),
        ({"shape": (64, 6)}, "cells >= 8"),
    ],
)
def test_a_grid_that_cannot_be_is_refused(field, message):
    with pytest.raises(ValueError, match=message):
        GridSpec(**field)


def test_specs_are_keys():
    assert hash(GridSpec(shape=(8, 10))) == hash(GridSpec(shape=(8, 10)))
    assert GridSpec(shape=(8, 10)) != GridSpec(shape=(10, 8))


def test_an_empty_observation_is_all_masks():
    seen = empty_observation(5, num_cameras=2, image_shape=(3, 4))
    assert seen.points.shape == (5, 3) and seen.images.shape == (2, 3, 4, 3)
    assert not bool(jnp.any(seen.point_valid)) and not bool(jnp.any(seen.image_valid))
    assert all(a.dtype in (jnp.float32, bool) for a in seen)
    assert empty_observation(0).points.shape == (0, 3)
    with pytest.raises(ValueError, match="sizes must be >= 0"):
        empty_observation(-1)
