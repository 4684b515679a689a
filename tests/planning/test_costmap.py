"""Nav2's inflation, and what packing three layers into a word costs."""

import chex
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from scipy import ndimage

import reference
from drnav_jax.planning import costmap
from drnav_jax.planning.costmap import CLEARANCE_STEP, VALUE_STEP, InflationParams

SHAPE = (6, 9)
ROUNDING = 1e-6


def f32(values):
    return jnp.asarray(values, jnp.float32)


def layer(low, high):
    return hnp.arrays(np.float32, SHAPE, elements=st.floats(low, high, width=32))


def test_inflation_is_nav2s():
    distance = np.concatenate([[0.0, 0.1, 0.25, np.nextafter(np.float32(0.25), 1), 0.7], np.linspace(0, 1, 777)])
    for inscribed, scaling, radius in [(0.25, 3.0, 0.7), (0.1, 10.0, 0.55), (0.22, 1.0, 1.0)]:
        got = np.asarray(costmap.inflation(f32(distance), inscribed, InflationParams(scaling, radius)))
        for d, cost in zip(distance.astype(np.float32), got, strict=True):
            args = (np.float32(inscribed), scaling, np.float32(radius))
            want = {reference.inflation(float(d) + e, *args) for e in (-1e-6, 0.0, 1e-6)}
            want = want if 0 < d else {254}  # float32 may round to the other side of a step
            assert cost in want, d
        assert got[0] == 254 and (np.diff(got[np.argsort(distance)]) <= 0).all()


def test_clearance_is_the_distance_between_centres():
    occupied = np.random.default_rng(0).random((20, 33)) < 0.02
    got = costmap.clearance(jnp.asarray(occupied), 0.05)
    want = np.minimum(ndimage.distance_transform_edt(~occupied) * 0.05, costmap.MAX_CLEARANCE)
    np.testing.assert_allclose(got, want, atol=ROUNDING)


@given(layer(0, 2), layer(-0.5, 1.5), layer(-300, 900))
def test_packing_keeps_three_layers_to_half_a_step(clear, risk, value):
    plan = costmap.pack_plan(f32(risk), f32(value))
    near, share, ahead = map(np.asarray, costmap.unpack(costmap.pack_clearance(plan, f32(clear))))
    kept = np.minimum(clear, 255 * CLEARANCE_STEP)
    assert (near <= kept + ROUNDING).all(), "clearance must never be overstated"
    assert (near >= kept - CLEARANCE_STEP - ROUNDING).all()
    np.testing.assert_allclose(share, np.clip(risk, 0, 1), atol=0.5 / 255 + ROUNDING)
    above = np.minimum(value - value.min(), 65535 * VALUE_STEP)
    np.testing.assert_allclose(ahead, above, atol=0.5 * VALUE_STEP + 1e-4)  # float32 at 1000 m


def test_packing_is_exact_at_its_ends():
    risk = f32([[0.0, 1.0]])
    word = costmap.pack_clearance(costmap.pack_plan(risk, f32([[5.0, 5.0 + 1e4]])), f32([[0.0, 9.0]]))
    near, share, value = costmap.unpack(word)
    np.testing.assert_array_equal(share, risk)
    np.testing.assert_allclose(near, [[0.0, 1.275]], rtol=1e-6)
    np.testing.assert_allclose(value, [[0.0, 655.35]], rtol=1e-6)


def test_every_verb_is_traced_once():
    verbs = [costmap.clearance, costmap.pack_plan, costmap.pack_clearance]
    clearance, plan, word = (
        jax.jit(chex.assert_max_traces(v.__wrapped__, n=1), static_argnames="resolution" if v is verbs[0] else ())
        for v in verbs
    )
    for k in range(3):
        near = clearance(jnp.eye(6, 9, k, dtype=bool), 0.1)
        word(plan(near * k, near + k), near)
