"""The dead-end belief against the equations in NumPy, and footprints against SciPy."""

import math

import chex
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from scipy import ndimage

from drnav_jax.filter import DeadEndParams, dead_end
from drnav_jax.types import Evidence

SHAPE = (9, 13)
PARAMS = DeadEndParams()
L0 = math.log(0.06 / 0.94)


def evidence(p, confidence=1.0):
    def full(v):
        return jnp.broadcast_to(jnp.asarray(v, jnp.float32), SHAPE)

    return Evidence(p_dead=full(p), confidence=full(confidence))


def prior():
    return jnp.full(SHAPE, dead_end.prior_log_odds(PARAMS))


ALL = jnp.ones(SHAPE, bool)


def test_equals_the_recursion_in_numpy():
    rng = np.random.default_rng(0)
    params = PARAMS._replace(forgetting=0.3, gain=0.7, l_max=3.0)
    belief = prior()
    expected = np.full(SHAPE, L0)
    for _ in range(50):
        p, confidence = rng.uniform(0, 1, SHAPE), rng.uniform(-0.2, 1.2, SHAPE)
        p[rng.random(SHAPE) < 0.05] = np.nan
        confidence[rng.random(SHAPE) < 0.05] = np.inf
        visible = rng.random(SHAPE) < 0.6
        belief = dead_end.update(params, belief, evidence(p, confidence), jnp.asarray(visible), 0.1)
        for c in np.ndindex(SHAPE):
            expected[c] = L0 + (expected[c] - L0) * math.exp(-0.3 * 0.1)
            if visible[c] and np.isfinite(p[c]) and np.isfinite(confidence[c]):
                q = min(max(p[c], 1e-4), 1 - 1e-4)
                weight = 0.7 * min(max(confidence[c], 0.0), 1.0)
                expected[c] += weight * (math.log(q / (1 - q)) - L0)
            expected[c] = min(max(expected[c], -6.0), 3.0)
    np.testing.assert_allclose(np.asarray(belief), expected, atol=2e-5)
    want = 1 / (1 + np.exp(-expected))
    np.testing.assert_allclose(np.asarray(dead_end.probability(belief)), want, atol=1e-6)


def test_a_dead_end_that_may_hold_the_goal_is_less_of_a_risk():
    rng = np.random.default_rng(1)
    risk, away = rng.uniform(0, 1, SHAPE), rng.uniform(0, 9, SHAPE)
    away.flat[:2] = 0.0, 40.0
    f32 = lambda a: jnp.asarray(a, jnp.float32)  # noqa: E731
    got = np.asarray(dead_end.on_trip(PARAMS, f32(risk), f32(away), jnp.asarray(False)))
    want = [r * (1 - math.exp(-((d / 3.0) ** 2))) for r, d in zip(risk.flat, away.flat, strict=True)]
    np.testing.assert_allclose(got.ravel(), want, rtol=1e-5, atol=1e-7)
    assert got.flat[0] == 0 and got.flat[1] == np.float32(risk.flat[1])
    assert not np.any(dead_end.on_trip(PARAMS, f32(risk), f32(away), jnp.asarray(True)))
    kept = dead_end.on_trip(PARAMS._replace(extent=0.0), f32(risk), f32(away), jnp.asarray(False))
    np.testing.assert_array_equal(np.asarray(kept)[away > 0], f32(risk)[away > 0])


@given(st.floats(1e-4, 1 - 1e-4))
def test_probability_inverts_log_odds(p):
    back = dead_end.probability(dead_end.log_odds(jnp.float32(p)))
    assert float(back) == pytest.approx(p, rel=1e-4, abs=1e-7)


def test_evidence_at_the_prior_changes_nothing():
    once = dead_end.update(PARAMS, prior() + 1.0, evidence(0.06), ALL, 0.1)
    np.testing.assert_allclose(np.asarray(once), np.asarray(prior() + 1.0), atol=1e-5)


@pytest.mark.parametrize(
    ("data", "visible"),
    [
        (evidence(0.9), ~ALL),
        (evidence(0.9, 0.0), ALL),
        (evidence(0.9, -1.0), ALL),
        (evidence(np.nan), ALL),
        (evidence(np.inf), ALL),
        (evidence(0.9, np.nan), ALL),
    ],
)
def test_no_evidence_leaves_the_belief_alone(data, visible):
    start = prior() + 0.5
    after = dead_end.update(PARAMS, start, data, visible, 0.1)
    np.testing.assert_allclose(np.asarray(after), np.asarray(start), atol=1e-6)


def test_contradiction_flips_a_saturated_cell_as_fast_as_the_clip_says():
    for start, p in ((PARAMS.l_max, 0.01), (PARAMS.l_min, 0.3)):
        gained = math.log(p / (1 - p)) - L0
        belief, n = jnp.full(SHAPE, start, jnp.float32), 0
        while bool((jnp.sign(belief) == np.sign(start)).any()):
            belief = dead_end.update(PARAMS, belief, evidence(p), ALL, 0.1)
            n += 1
        assert n == math.floor(abs(start) / abs(gained)) + 1
    for p in (0.0, 1.0):  # the most certain frame still stays within the clip
        for _ in range(20):
            belief = dead_end.update(PARAMS, belief, evidence(p), ALL, 0.1)
        assert float(belief[0, 0]) == (PARAMS.l_max if p else PARAMS.l_min)


def test_what_repeats_itself_tends_to_what_it_says_and_no_further():
    """Eq. 7: l_n = l_0 + (1 - (1 - w)^n) (logit p^ - l_0) for r = 1; r = 0 adds up, as does evidence that does not say."""
    said = evidence(0.3, 0.35)
    ones = {r: said._replace(repeats=None if r is None else jnp.float32(r)) for r in (None, 0.0, 0.5, 1.0, 7.0)}
    beliefs = dict.fromkeys(ones, prior())
    for n in range(1, 13):
        beliefs = {r: dead_end.update(PARAMS, belief, ones[r], ALL, 0.1) for r, belief in beliefs.items()}
        expected = L0 + (1 - 0.65**n) * (math.log(0.3 / 0.7) - L0)
        np.testing.assert_allclose(beliefs[1.0], expected, rtol=1e-5)
    np.testing.assert_array_equal(beliefs[0.0], beliefs[None])
    np.testing.assert_array_equal(beliefs[7.0], beliefs[1.0])  # kept within 0..1
    p = {r: float(dead_end.probability(belief)[0, 0]) for r, belief in beliefs.items()}
    assert p[None] > 0.99 and p[1.0] < 0.3 and p[1.0] < p[0.5] < p[None]
    held = dead_end.update(PARAMS, beliefs[None], ones[1.0], jnp.zeros(SHAPE, bool), 0.1)
    np.testing.assert_array_equal(held, beliefs[None])  # nothing is said of what is out of view


def test_forgetting_returns_to_the_prior_at_its_rate():
    params = PARAMS._replace(forgetting=0.5)
    belief = prior() + 4.0
    for _ in range(20):
        belief = dead_end.update(params, belief, evidence(0.5, 0.0), ALL, 0.1)
    np.testing.assert_allclose(np.asarray(belief - prior()), 4.0 * math.exp(-1.0), rtol=1e-4)
    for _ in range(20):
        belief = dead_end.update(params, belief, evidence(0.5, 0.0), ALL, 10.0)
    np.testing.assert_allclose(np.asarray(belief), np.asarray(prior()), atol=1e-5)


@given(st.floats(1e-3, 0.5))
def test_cells_without_evidence_add_no_risk(p0):
    params = PARAMS._replace(prior=jnp.float32(p0))
    untouched = dead_end.prior_log_odds(params)
    assert float(dead_end.risk(params, untouched)) == 0.0
    assert float(dead_end.risk(params, untouched - 2.0)) == 0.0
    assert float(dead_end.risk(params, jnp.float32(30.0))) == pytest.approx(1.0, abs=1e-5)
    certain = dead_end.risk(params, dead_end.log_odds(jnp.float32((1 + p0) / 2)))
    assert float(certain) == pytest.approx(0.5, abs=1e-4)


def disc_by_sampling(radius, half_width, n=40):
    """Covered share of each cell by brute force."""
    k = (np.arange((2 * half_width + 1) * n) + 0.5) / n - half_width - 0.5
    inside = (np.hypot(*np.meshgrid(k, k)) * 0.1 < radius).astype(float)
    w = 2 * half_width + 1
    cover = inside.reshape(w, n, w, n).mean((1, 3))
    return cover / cover.sum()


@pytest.mark.parametrize("radius", [0.0, 0.12, 0.25, 0.31])
def test_disc_kernel_is_the_covered_share(radius):
    kernel = np.asarray(dead_end.disc_kernel(radius, 0.1, 3))
    assert kernel.sum() == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_array_equal(kernel, kernel.T)
    np.testing.assert_array_equal(kernel, kernel[::-1])
    if radius == 0:
        assert kernel[3, 3] == 1.0
    else:  # the rim is taken as straight across a cell and square to the radius
        np.testing.assert_allclose(kernel, disc_by_sampling(radius, 3), atol=0.02)


def test_footprint_equals_scipy():
    rng = np.random.default_rng(0)
    values = rng.random((33, 40)).astype(np.float32)
    for radius in (0.1, 0.25, 0.3):
        kernel = np.asarray(dead_end.disc_kernel(radius, 0.1, 3), np.float64)
        got = dead_end.footprint(jnp.asarray(values), radius, 0.1)
        want = ndimage.convolve(values.astype(np.float64), kernel, mode="constant")
        np.testing.assert_allclose(np.asarray(got), want, atol=1e-6)
    vertices = jnp.asarray([[0.35, 0.2], [0.35, -0.2], [-0.15, -0.1], [-0.15, 0.1]], jnp.float32)
    kernel = dead_end.polygon_kernel(vertices, 0.7, 0.1, 5)
    got = dead_end.aggregate(jnp.asarray(values), kernel, 0.25)
    want = ndimage.correlate(values.astype(np.float64), np.asarray(kernel, np.float64), mode="constant", cval=0.25)
    np.testing.assert_allclose(np.asarray(got), want, atol=1e-6)


@pytest.mark.parametrize(("radius", "resolution"), [(0.25, 0.1), (0.35, 0.1), (0.25, 0.05), (0.35, 0.02)])
def test_the_kernel_holds_the_robot_on_cells_of_any_size(radius, resolution):
    """Beside a half plane that is dead, cell by cell: the share of the disc in it, by its segment's area."""
    values = jnp.zeros((121, 121), jnp.float32).at[:, 61:].set(1.0)
    got = np.asarray(dead_end.footprint(values, radius, resolution, half_width=dead_end.half_width(resolution)))[60]
    d = np.clip(((60.5 - np.arange(121)) * resolution) / radius, -1, 1)
    np.testing.assert_allclose(got[30:91], ((np.arccos(d) - d * np.sqrt(1 - d * d)) / np.pi)[30:91], atol=0.03)


def test_polygon_kernel():
    square = jnp.asarray([[0.15, 0.15], [-0.15, 0.15], [-0.15, -0.15], [0.15, -0.15]], jnp.float32)
    kernel = np.asarray(dead_end.polygon_kernel(square, 0.0, 0.1, 2))
    want = np.pad(np.full((3, 3), 1 / 9), 1)
    np.testing.assert_allclose(kernel, want, atol=1e-6)
    # x forward is +column, y left is +row; a quarter turn to the left takes +x to +y.
    nose = jnp.asarray([[0.35, 0.05], [0.35, -0.05], [-0.05, -0.05], [-0.05, 0.05]], jnp.float32)
    ahead = np.asarray(dead_end.polygon_kernel(nose, 0.0, 0.1, 4))
    np.testing.assert_allclose(ahead[4, 4:8], 0.25, atol=1e-6)
    left = np.asarray(dead_end.polygon_kernel(nose, math.pi / 2, 0.1, 4))
    np.testing.assert_allclose(left, ahead.T, atol=0.02)
    # Either sense of the corners; a concave outline; many corners make a disc.
    np.testing.assert_allclose(
        np.asarray(dead_end.polygon_kernel(nose[::-1], 0.3, 0.1, 4)),
        np.asarray(dead_end.polygon_kernel(nose, 0.3, 0.1, 4)),
    )
    ell = jnp.asarray([[0, 0], [0.3, 0], [0.3, 0.1], [0.1, 0.1], [0.1, 0.3], [0, 0.3]], jnp.float32)
    kernel = np.asarray(dead_end.polygon_kernel(ell - 0.05, 0.0, 0.1, 3))
    np.testing.assert_allclose(sorted(kernel[kernel > 0.01]), [0.2] * 5, atol=1e-6)
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring = jnp.asarray(0.25 * np.stack([np.cos(turn), np.sin(turn)], -1), jnp.float32)
    kernel = np.asarray(dead_end.polygon_kernel(ring, 0.2, 0.1, 3))
    np.testing.assert_allclose(kernel, disc_by_sampling(0.25, 3), atol=0.01)


def test_batch_equals_loop_and_traces_once():
    rng = np.random.default_rng(0)
    n = 3
    p, c = (jnp.asarray(rng.random((n, *SHAPE)), jnp.float32) for _ in range(2))
    visible = jnp.asarray(rng.random((n, *SHAPE)) < 0.7)
    update = jax.jit(chex.assert_max_traces(dead_end.update.__wrapped__, n=1))
    loop = [update(PARAMS, prior(), Evidence(*a[:2]), a[2], 0.1) for a in zip(p, c, visible)]  # noqa: B905
    batch = jax.vmap(lambda p, c, v: dead_end.update(PARAMS, prior(), Evidence(p, c), v, 0.1))(p, c, visible)
    np.testing.assert_allclose(np.asarray(batch), np.stack(loop), atol=1e-6)

    footprint = jax.jit(chex.assert_max_traces(dead_end.footprint.__wrapped__, n=1))
    for radius in (0.1, 0.2, 0.3):
        footprint(p[0], radius, 0.1)
