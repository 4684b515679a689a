"""The predictors that need no map: the truth, and silence."""

import jax.numpy as jnp
import numpy as np

from drnav_jax.models import oracle, silent
from drnav_jax.models.oracle import OracleParams
from drnav_jax.types import GridMap, LocalMap, empty_observation

SHAPE, RESOLUTION = (20, 30), 0.1
ORIGIN = np.array([-1.0, -0.5], np.float32)


def f32(values):
    return jnp.asarray(values, jnp.float32)


def local_map(seen=False):
    return LocalMap(jnp.zeros(SHAPE), jnp.full(SHAPE, seen), f32(ORIGIN), f32(RESOLUTION))


def test_the_oracle_tells_the_truth_nearby_also_where_nothing_is_seen():
    label = np.zeros((12, 50), np.float32)  # 0.2 m cells, 10 m x 2.4 m, on another lattice than the window
    label[:, 8:] = 1.0  # from x = 0.57 on
    truth = GridMap(f32(label), f32([-1.03, -0.77]), 0.2)
    seen = empty_observation(0)._replace(pose=f32([0.4, 0.3, 2.0]))
    got = oracle.predict(OracleParams(truth, reach=0.9), seen, local_map())
    x = ORIGIN[0] + (np.arange(30)[None, :] + 0.5) * RESOLUTION + np.zeros(SHAPE)
    y = ORIGIN[1] + (np.arange(20)[:, None] + 0.5) * RESOLUTION + np.zeros(SHAPE)
    near = np.hypot(x - 0.4, y - 0.3) <= 0.9
    np.testing.assert_array_equal(got.confidence, near.astype(np.float32))
    np.testing.assert_allclose(got.p_dead, np.where(x > 0.57, 0.97, 0.03))
    assert 0 < near.sum() < near.size and (x[near] > 0.57).any()


def test_beyond_the_labelled_ground_there_are_no_dead_ends():
    truth = GridMap(jnp.ones((2, 2)), f32([0.0, 0.0]), 0.1)
    got = oracle.predict(OracleParams(truth, p_dead=0.9, p_open=0.1), empty_observation(0), local_map())
    assert int((got.p_dead == jnp.float32(0.9)).sum()) == 4
    assert float(got.p_dead[0, 0]) == np.float32(0.1)


def test_the_silent_one_says_nothing():
    got = silent.predict(None, empty_observation(0), local_map(seen=True))
    assert got.p_dead.shape == SHAPE and not bool(got.confidence.any())
