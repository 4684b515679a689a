"""Expected dead-end exposure: the sum is the paper's, the integral is SciPy's and does not depend on the step."""

import math

import chex
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from scipy import integrate, ndimage

from drnav_jax import geometry
from drnav_jax.planning import exposure
from drnav_jax.planning.exposure import STANDING_SPEED, exposure_integral, exposure_sum
from drnav_jax.types import GridMap

RESOLUTION = 0.05
SHAPE = (84, 110)  # 4.2 m x 5.5 m
ORIGIN = np.array([-1.0, -2.0], np.float32)
QUADRATURE = 1e-4  # promised
HALVING = 0.01  # promised: share by which halving the step may change the integral


def f32(values):
    return jnp.asarray(values, jnp.float32)


def centres():
    x = ORIGIN[0] + (np.arange(SHAPE[1]) + 0.5) * RESOLUTION
    y = ORIGIN[1] + (np.arange(SHAPE[0]) + 0.5) * RESOLUTION
    return np.meshgrid(x, y)


def field(f):
    return GridMap(f32(f(*centres())), f32(ORIGIN), RESOLUTION)


def arc(radius, angle, num):
    a = np.linspace(0, angle, num)
    return np.stack([radius * np.sin(a), radius * (1 - np.cos(a))], axis=-1)


LINEAR = lambda x, y: 0.4 + 0.08 * x - 0.05 * y  # noqa: E731
HILL = lambda x, y: 0.9 * np.exp(-((x - 1.3) ** 2 + (y - 0.4) ** 2) / 2)  # noqa: E731


@pytest.mark.parametrize("f", [LINEAR, HILL])
@pytest.mark.parametrize("decay", [0.0, 0.1, 1.5])
def test_integral_is_scipys(f, decay):
    start, end = np.array([-0.7, -1.6]), np.array([3.9, 1.7])
    length = np.linalg.norm(end - start)
    density = lambda s: math.exp(-decay * s) * f(*(start + s / length * (end - start)))  # noqa: E731
    want, _ = integrate.quad(density, 0, length, epsabs=1e-10)
    # 40 steps, or uneven ones: along a straight line the value is the same
    for share in (np.linspace(0, 1, 41), np.linspace(0, 1, 12) ** 2):
        path = start + share[:, None] * (end - start)
        # the hill itself is interpolated: h^2 / 8 |f''| = 3e-4 of the height between the centres, half of it on average
        error = 2e-4 * (1 - math.exp(-decay * length)) / decay if f is HILL and decay else 2e-4 * length
        error = error + QUADRATURE if f is HILL else QUADRATURE
        assert float(exposure_integral(field(f), f32(path), decay)) == pytest.approx(want, abs=error)


@pytest.mark.parametrize("decay", [0.0, 0.5])
def test_integral_along_an_arc_is_scipys(decay):
    radius, angle = 1.2, 1.5
    point = lambda a: LINEAR(radius * math.sin(a), radius * (1 - math.cos(a)))  # noqa: E731
    density = lambda a: math.exp(-decay * radius * a) * point(a) * radius  # noqa: E731
    want, _ = integrate.quad(density, 0, angle, epsabs=1e-10)
    got = exposure_integral(field(LINEAR), f32(arc(radius, angle, 80)), decay)  # chords: (angle / 79)^2 / 24 = 2e-5
    assert float(got) == pytest.approx(want, abs=QUADRATURE)


@pytest.mark.parametrize("seed", range(5))
def test_halving_the_step_changes_less_than_a_hundredth(seed):
    """On what planners integrate: blocks of dead ends, averaged over a footprint."""
    rng = np.random.default_rng(seed)
    blocks = np.kron(rng.random((7, 10)) < 0.4, np.ones((12, 11)))
    risk = GridMap(f32(ndimage.uniform_filter(blocks, 10)), f32(ORIGIN), RESOLUTION)
    bend = rng.uniform(0.2, 1.2)
    paths = [f32(arc(3.0, bend, n)) for n in (41, 81, 161)]
    coarse, fine, finest = (float(exposure_integral(risk, p, 0.1)) for p in paths)
    assert fine > 0.05
    assert fine == pytest.approx(coarse, rel=HALVING) and finest == pytest.approx(fine, rel=HALVING / 2)
    halved = float(exposure_integral(risk, paths[0], 0.1, substeps=8))
    assert halved == pytest.approx(coarse, rel=HALVING)
    # ... and the sum does not do that: with twice the cells it is about twice as large
    sums = [float(exposure_sum(f32(np.full(n, 0.5)), f32(np.linspace(0, 4, n)), 0.1)) for n in (41, 81)]
    assert sums[1] > 1.9 * sums[0]


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 0.5)), min_size=1, max_size=30), st.floats(0, 3))
def test_sum_is_the_papers(cells, decay):
    p, s = [c[0] for c in cells], np.cumsum([c[1] for c in cells])
    want = sum(math.exp(-decay * s_k) * p_k for p_k, s_k in zip(p, s, strict=True))
    got = exposure_sum(f32(p), f32(s), decay)
    assert float(got) == pytest.approx(want, rel=1e-5, abs=1e-6)  # float32 sums


def test_standing_and_turning_on_the_spot_are_not_free():
    still = f32(np.tile([1.3, 0.4], (21, 1)))
    risk = field(lambda x, y: 0 * x + 0.8)
    got = exposure_integral(risk, still, 0.1, dt=0.1)  # where the robot looks is no part of the path
    assert float(got) == pytest.approx(0.8 * 2.0 * STANDING_SPEED, rel=1e-4)
    creep = f32(np.linspace([1.3, 0.4], [1.31, 0.4], 21))
    assert float(exposure_integral(risk, creep, 0.1, dt=0.1)) >= 0.99 * float(got)
    # A moving robot pays for its way, not for its time.
    way = f32(np.linspace([0.0, 0.0], [2.0, 0.0], 21))
    timed, plain = (float(exposure_integral(risk, way, 0.1, dt=dt)) for dt in (0.1, 0.0))
    assert timed == plain and timed > float(got)


def test_outside_the_map_nothing_is_risked():
    risk = field(lambda x, y: 0 * x + 1.0)
    out = f32(np.linspace([10.0, 0.0], [12.0, 0.0], 9))
    assert float(exposure_integral(risk, out, 0.0)) == 0.0
    across = f32(np.linspace([3.5, 0.0], [5.5, 0.0], 41))  # the map ends at 4.5
    assert float(exposure_integral(risk, across, 0.0)) == pytest.approx(1.0, abs=0.02)  # half a panel


@pytest.mark.parametrize(("f", "kinks"), [(LINEAR, 0.01), (HILL, 0.1)])
def test_gradients_are_the_differences(f, kinks):
    """In the path up to `kinks`: the slope jumps where bilinear patches meet, unless the field is linear."""
    risk, path = field(f), f32(arc(2.0, 1.0, 12))
    value = lambda risk, path: exposure_integral(risk, path, 0.3, dt=0.1)  # noqa: E731
    slope = np.asarray(jax.grad(value, argnums=1)(risk, path))
    rng, eps = np.random.default_rng(0), 0.001
    for _ in range(4):
        way = rng.normal(size=path.shape)
        ahead, behind = (float(value(risk, path + f32(sign * eps * way))) for sign in (1, -1))
        want = float((slope * way).sum())
        assert (ahead - behind) / (2 * eps) == pytest.approx(want, rel=kinks, abs=5e-4)  # float32: 1e-7 / eps
        assert abs(want) > 0.01
    # The integral is linear in the map, so there the difference is exact.
    weights = jax.grad(lambda v: value(risk._replace(values=v), path))(risk.values)
    bump = f32(rng.normal(size=SHAPE))
    change = float(value(risk._replace(values=risk.values + bump), path)) - float(value(risk, path))
    assert change == pytest.approx(float((weights * bump).sum()), rel=1e-3, abs=1e-4)
    assert bool(jnp.all(weights >= 0)) and float(weights.sum()) > 1.0


def bilinear(values, x, y):
    """Interpolation between centres in float64; outside the cells nothing."""
    h, w = values.shape
    gx, gy = (x - ORIGIN[0]) / RES64, (y - ORIGIN[1]) / RES64
    if not (0 <= gx < w and 0 <= gy < h):
        return 0.0
    gx, gy = min(max(gx - 0.5, 0), w - 1), min(max(gy - 0.5, 0), h - 1)
    j, i = min(int(gx), w - 2), min(int(gy), h - 2)
    a, b = gx - j, gy - i
    return float(np.array([1 - b, b]) @ values[i : i + 2, j : j + 2] @ np.array([1 - a, a]))


def arcs(path):
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(path, axis=0).T)))


def reference_integral(values, path, decay, dt):
    """Simpson's rule on four panels per segment, in loops and float64."""
    total, s = 0.0, arcs(path)
    for a, b, s0, s1 in zip(path[:-1], path[1:], s[:-1], s[1:], strict=True):
        density = [math.exp(-decay * (s0 + f * (s1 - s0))) * bilinear(values, *(a + f * (b - a)))
                   for f in np.linspace(0, 1, 9)]  # fmt: skip
        panels = sum(density[k] + 4 * density[k + 1] + density[k + 2] for k in range(0, 8, 2)) / 24
        total += max(s1 - s0, STANDING_SPEED * dt) * panels
    return total


def reference_sum(values, path, decay, dt):
    del dt
    return sum(math.exp(-decay * s) * bilinear(values, *p) for s, p in zip(arcs(path), path, strict=True))


def sampled_sum(risk, path, decay, dt):
    """The chain map -> risk at the path's points -> the paper's sum."""
    del dt
    return exposure_sum(geometry.sample_bilinear(risk, path, fill=0.0), exposure.arc_lengths(path), decay)


def integral(risk, path, decay, dt):
    return exposure_integral(risk, path, decay, dt=dt)


CHAINS = [(integral, reference_integral), (sampled_sum, reference_sum)]
RES64 = float(np.float32(RESOLUTION))
# float32 against float64: positions are rounded to 1e-7 of cells of 5 cm, which moves weights by 1e-5
SLOPE = {"rel": 2e-3, "abs": 2e-4}


@pytest.mark.parametrize(("ours", "theirs"), CHAINS)
@pytest.mark.parametrize("crawl", [False, True])
def test_every_slope_is_the_difference_in_double_precision(ours, theirs, crawl):
    """Of every point of the path, of the decay, and of cells: on a rough map, also where the robot crawls or leaves it."""
    rng = np.random.default_rng(3)
    values = rng.random(SHAPE).astype(np.float32)
    path = arc(2.0, 1.0, 8) + rng.normal(0, 0.02, (8, 2))
    path[-1] = [5.03, 0.4]  # beyond the edge
    if crawl:
        path = path[0] + 2e-3 * (path - path[0])  # below the standing speed
    path, decay, dt = path.astype(np.float32).astype(float), 0.4, 0.1
    values64, eps = values.astype(float), 1e-7
    risk = GridMap(f32(values), f32(ORIGIN), RESOLUTION)
    value, slopes = jax.value_and_grad(
        lambda v, p, d: ours(risk._replace(values=v), p, d, dt), argnums=(0, 1, 2)
    )(f32(values), f32(path), f32(decay))
    assert float(value) == pytest.approx(theirs(values64, path, decay, dt), rel=1e-4)
    for t, axis in np.ndindex(path.shape):
        bump = np.zeros_like(path)
        bump[t, axis] = eps
        want = (theirs(values64, path + bump, decay, dt) - theirs(values64, path - bump, decay, dt)) / (2 * eps)
        assert float(slopes[1][t, axis]) == pytest.approx(want, **SLOPE), (t, axis)
    want = (theirs(values64, path, decay + 1e-4, dt) - theirs(values64, path, decay - 1e-4, dt)) / 2e-4
    assert float(slopes[2]) == pytest.approx(want, **SLOPE)
    touched = np.argwhere(np.asarray(slopes[0]) != 0)
    assert len(touched) >= 4
    for i, j in [*touched[:: max(len(touched) // 12, 1)], (0, 0)]:
        bump = np.zeros_like(values64)
        bump[i, j] = 1.0  # linear in the map: no error of the difference
        want = theirs(values64 + bump, path, decay, dt) - theirs(values64, path, decay, dt)
        assert float(slopes[0][i, j]) == pytest.approx(want, **SLOPE), (i, j)


@pytest.mark.parametrize("ours", [integral, sampled_sum])
@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_slopes_are_numbers_where_points_coincide(ours, dt):
    """At rest, resting between two moves, on a corner of the map, and outside: no 0 / 0 out of the root."""
    risk = field(HILL)
    rest = np.tile([1.0, 0.2], (5, 1))
    paused = np.array([[0.0, 0.0], [0.5, 0.1], [0.5, 0.1], [0.5, 0.1], [1.0, 0.0]])
    corner, outside = np.tile(ORIGIN, (4, 1)), np.tile([99.0, 99.0], (4, 1))
    for path in (rest, paused, corner, outside):
        slopes = jax.grad(lambda v, p: ours(risk._replace(values=v), p, 0.3, dt), argnums=(0, 1))(risk.values, f32(path))
        assert all(bool(jnp.all(jnp.isfinite(s))) for s in slopes)
    # the pause costs time on the spot, and where it is spent matters
    pull = jax.grad(lambda p: ours(risk, p, 0.3, dt))(f32(paused))
    assert float(jnp.abs(pull[1:4]).sum()) > 1e-3


def test_descent_leads_a_path_out_of_the_risk():
    """What the slope is for: a path across a hill of risk, its ends held, is bent around it."""
    risk, path = field(lambda x, y: 0.9 * np.exp(-((x - 1.3) ** 2 + (y - 0.0) ** 2) / 0.18)), None
    # beyond the cell on the hill's top, in which a bilinear field says nothing of where down is
    begin = f32(np.stack([np.linspace(0.0, 2.6, 14), 0.1 * np.sin(np.linspace(0, np.pi, 14))], 1))

    def objective(middle):
        whole = jnp.concatenate([begin[:1], middle, begin[-1:]])
        bends = whole[2:] - 2.0 * whole[1:-1] + whole[:-2]
        return 3.0 * exposure_integral(risk, whole, 0.0) + exposure.arc_lengths(whole)[-1] + 5.0 * jnp.sum(bends * bends)

    step, path = jax.jit(jax.grad(objective)), begin[1:-1]
    for _ in range(800):
        path = path - 0.006 * step(path)
    assert float(objective(path)) < 0.75 * float(objective(begin[1:-1]))
    assert float(jnp.abs(path[:, 1]).max()) > 0.3


def test_arc_lengths():
    path = arc(2.0, 1.0, 200)
    got = np.asarray(exposure.arc_lengths(f32(path)))
    np.testing.assert_allclose(got, np.linspace(0, 2.0, 200), atol=5e-4)  # 1e-6 is added to every step
    assert got[0] == 0


def test_batch_equals_loop_and_traces_once():
    risk, paths = field(HILL), f32([arc(r, 1.0, 9) for r in (1.0, 1.5, 2.0)])
    integral = jax.jit(chex.assert_max_traces(exposure_integral.__wrapped__, n=1), static_argnames="substeps")
    total = jax.jit(chex.assert_max_traces(exposure_sum.__wrapped__, n=1))
    loop = jnp.stack([integral(risk, p, f32(d)) for p, d in zip(paths, (0.1, 0.2, 0.3), strict=True)])
    batch = jax.vmap(lambda p, d: exposure_integral(risk, p, d))(paths, f32([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(batch, loop, rtol=1e-5)
    for p, d in zip(paths, (0.1, 0.2, 0.3), strict=True):
        total(p[:, 0], p[:, 1], f32(d))
