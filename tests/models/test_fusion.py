"""The network in the loop: where its answer lands in the window, and how much it weighs."""

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_network import BEV, RIG, SPEC, params_of

from drnav_jax import navigator
from drnav_jax.filter import FilterSpec, RecoverySpec
from drnav_jax.models import bev, fusion, geometric
from drnav_jax.models.batch import FREE, OCCUPIED, UNKNOWN
from drnav_jax.models.calibration import Calibration, Temperature
from drnav_jax.models.fusion import FusionParams
from drnav_jax.models.weights import Trained
from drnav_jax.navigator import NavParams, NavSpec
from drnav_jax.planning import GeneratorSpec, TrackerSpec
from drnav_jax.planning.memory import MemorySpec
from drnav_jax.types import Evidence, GridSpec, LocalMap, empty_observation

pytestmark = pytest.mark.relaxed  # flax
SHAPE, RESOLUTION, ORIGIN = (60, 80), 0.1, (-3.05, 1.45)
POSES = [(0.427, 4.283, 0.0), (1.3, 3.8, 2.1), (0.02, 4.4, -0.7)]


def f32(values):
    return jnp.asarray(values, jnp.float32)


def window(seed=0, seen=0.7):
    rng = np.random.default_rng(seed)
    return LocalMap(
        occupancy=f32(rng.choice([-2.0, 2.0], SHAPE, p=[0.9, 0.1])), seen=jnp.asarray(rng.random(SHAPE) < seen),
        origin=f32(ORIGIN), resolution=f32(RESOLUTION),
    )  # fmt: skip


def observed(pose=POSES[0], twist=(0.5, 0.0), goal=(9.0, 1.0), rig=RIG, seed=0):
    rng = np.random.default_rng(seed)
    blank = empty_observation(14, rig)
    n = len(rig.mounts)
    return blank._replace(
        images=f32(rng.random(blank.images.shape)), image_valid=jnp.ones(n, bool), pose=f32(pose), twist=f32(twist),
        points=f32(rng.normal(size=(14, 3)) + [2.0, 0.0, 0.5]), point_valid=jnp.ones(14, bool), goal=f32(goal),
    )  # fmt: skip


@pytest.fixture(scope="module")
def params():
    return FusionParams(params_of())


predict = jax.jit(chex.assert_max_traces(fusion.predictor(SPEC), n=1))


def network_cell(pose, x, y):
    """(row, column) of the network's cell under a place in odom, and how far that place lies from its edge [m]."""
    dx, dy = x - pose[0], y - pose[1]
    ahead = math.cos(pose[2]) * dx + math.sin(pose[2]) * dy
    left = -math.sin(pose[2]) * dx + math.cos(pose[2]) * dy
    column = (ahead - BEV.ahead) / BEV.resolution + BEV.shape[1] / 2
    row = left / BEV.resolution + BEV.shape[0] / 2
    return (math.floor(row), math.floor(column)), min(abs(row - round(row)), abs(column - round(column))) * BEV.resolution


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("painted", [(1, 2), (6, 13), (3, 0)])
def test_a_painted_cell_lands_where_it_lies_in_odom(pose, painted):
    p_dead, confidence = np.full(BEV.shape, 0.1, np.float32), np.full(BEV.shape, 0.2, np.float32)
    p_dead[painted], confidence[painted] = 0.9, 0.7
    grids = [jnp.asarray(a) for a in (p_dead, confidence, confidence - 0.5)]
    got = jax.device_get(fusion.evidence(SPEC, f32(pose), *grids, window()))
    count = 0
    for i in range(SHAPE[0]):
        for j in range(SHAPE[1]):
            cell, margin = network_cell(pose, ORIGIN[0] + (j + 0.5) * RESOLUTION, ORIGIN[1] + (i + 0.5) * RESOLUTION)
            if margin < 1e-4:
                continue  # on the line between two cells float32 may fall either way
            inside = 0 <= cell[0] < BEV.shape[0] and 0 <= cell[1] < BEV.shape[1]
            want = (0.9, 0.7) if cell == painted else (0.1, 0.2) if inside else (0.0, 0.0)
            assert abs(got.p_dead[i, j] - want[0]) < 1e-6 and abs(got.confidence[i, j] - want[1]) < 1e-6, (i, j)
            assert abs(got.blocked[i, j] - (want[1] - 0.5 if inside else 0.0)) < 1e-6, (i, j)
            count += cell == painted
    assert count >= 10  # of the 16 window cells that are as large as it


def test_trust_by_what_has_been_seen():
    rng = np.random.default_rng(0)
    spec = dataclasses.replace(SPEC, bev=dataclasses.replace(BEV, shape=(16, 40)))
    known = np.zeros((16, 40), np.uint8)
    known[:, :6] = rng.choice([UNKNOWN, FREE, OCCUPIED], (16, 6))
    known[2, 30] = OCCUPIED
    params = FusionParams(None, weight=0.4, unseen=0.5, still=0.2, moving=0.3)
    got = np.asarray(fusion.trust(spec, params, observed(twist=(0.9, 0.0)), jnp.asarray(known)))
    reach = round(2.0 / BEV.resolution)
    for i in range(16):
        for j in range(40):
            around = known[max(0, i - reach) : i + reach + 1, max(0, j - reach) : j + reach + 1]
            if known[i, j] == FREE:
                want = 0.4
            else:
                want = 0.2 if known[i, j] == UNKNOWN and (around == FREE).any() else 0.0
            assert got[i, j] == pytest.approx(want, abs=1e-6), (i, j)
    assert not got[:, 6 + reach :].any() and (got == np.float32(0.2)).any()


@pytest.mark.parametrize(
    ("twist", "share"), [((0.0, 0.0), 0.2), ((0.15, 0.0), 0.6), ((-0.15, 0.0), 0.6), ((0.0, -0.3), 1.0), ((0.1, 1.4), 1.0)]
)
def test_a_robot_that_stands_trusts_less(twist, share):
    params = FusionParams(None, weight=0.4, still=0.2, moving=0.3)
    got = fusion.trust(SPEC, params, observed(twist=twist), jnp.full(BEV.shape, FREE, jnp.uint8))
    np.testing.assert_allclose(got, np.full(BEV.shape, 0.4 * share), rtol=1e-5)


def test_what_it_says_of_panes_and_grass():
    rng = np.random.default_rng(1)
    spec = dataclasses.replace(SPEC, bev=dataclasses.replace(BEV, shape=(16, 40)))
    known = rng.choice([UNKNOWN, FREE, OCCUPIED], (16, 40), p=[0.2, 0.75, 0.05]).astype(np.uint8)
    logits = (3 * rng.normal(size=known.shape)).astype(np.float32)
    logits[0, 0] = np.nan
    params = FusionParams(None, weight=0.4, still=0.2, moving=0.3, sight=2.5, pane=0.7, closes=1.5, clears=1.1, opens=0.8)
    ask = lambda seen: np.asarray(fusion.blocked(spec, params, seen, jnp.asarray(known), jnp.asarray(logits)))  # noqa: E731
    got, count = ask(observed(twist=(0.9, 0.0))), {FREE: 0, OCCUPIED: 0}
    for i, j in np.ndindex(16, 40):
        x = spec.bev.ahead + (j + 0.5 - 20) * spec.bev.resolution
        y = (i + 0.5 - 8) * spec.bev.resolution
        beside = known[max(0, i - 1) : i + 2, max(0, j - 1) : j + 2]
        asked = known[i, j] == OCCUPIED or (known[i, j] == FREE and not (beside == OCCUPIED).any())
        if abs(math.hypot(x, y) - 2.5) < 1e-4:
            continue
        said = asked and math.hypot(x, y) < 2.5 and np.isfinite(logits[i, j])
        t = float(logits[i, j])
        pair = (min(max(-t, -0.8), 0.8), min(max(0.7 - t, -1.1), 1.5))
        want = pair[int(known[i, j] == FREE)] if said else 0.0
        assert got[i, j] == pytest.approx(want, abs=1e-6), (i, j)
        count[int(known[i, j])] = count.get(int(known[i, j]), 0) + (want != 0)
    assert count[FREE] > 20 and count[OCCUPIED] > 2
    np.testing.assert_allclose(ask(observed(twist=(0.0, 0.0))), 0.2 * got, atol=1e-6)
    blind = observed()._replace(image_valid=jnp.zeros(len(RIG.mounts), bool))
    assert not ask(blind).any()  # LiDAR alone knows of neither


@pytest.mark.parametrize("pose", POSES)
def test_evidence_lies_only_where_something_was_seen(params, pose):
    local = window()._replace(seen=jnp.zeros(SHAPE, bool).at[20:30, 30:50].set(True))
    got = predict(params, observed(pose), local)
    assert got.p_dead.shape == got.confidence.shape == SHAPE
    assert got.p_dead.dtype == got.confidence.dtype == jnp.float32
    confidence, seen = np.asarray(got.confidence), np.argwhere(local.seen & (local.occupancy < 0))
    assert confidence.max() == pytest.approx(0.35)
    for i, j in np.argwhere(confidence > 0):  # the square of 2 m, turned, half a cell of the network and of the window more
        assert np.hypot(*(seen - [i, j]).T).min() * RESOLUTION <= (2.0 + BEV.resolution) * 2**0.5
    nothing = predict(params, observed(pose), local._replace(seen=jnp.zeros(SHAPE, bool)))
    assert not np.asarray(nothing.confidence).any()


def test_standing_still_lowers_confidence(params):
    moving, still = (predict(params, observed(twist=t), window()) for t in ((0.5, 0.0), (0.0, 0.0)))
    np.testing.assert_allclose(still.confidence, 0.1 * np.asarray(moving.confidence), rtol=1e-5)
    np.testing.assert_array_equal(still.p_dead, moving.p_dead)
    assert np.asarray(moving.confidence).any()


def test_a_robot_without_cameras_has_the_rule():
    seen = observed(rig=dataclasses.replace(RIG, mounts=()))
    params = FusionParams(None, rule=geometric.GeometricParams(p_dead=0.4))
    got = fusion.predictor(SPEC)(params, seen, window())
    chex.assert_trees_all_equal(got, geometric.predict(params.rule, seen, window()))
    near = fusion.predictor(SPEC)(params, seen._replace(goal=f32((1.0, 4.5))), window())  # and is asked with the goal
    assert isinstance(near, Evidence)


def test_answers_that_are_not_finite_weigh_nothing(params, monkeypatch):
    broken = jax.tree.map(lambda a: jnp.full_like(a, jnp.nan), params.network)
    got = predict(params._replace(network=broken), observed(), window())
    assert not np.asarray(got.confidence).any() and np.isfinite(got.p_dead).all()

    class Answered:
        dead = jnp.zeros(BEV.shape, jnp.float32).at[2, 4].set(jnp.nan).at[5, 9].set(jnp.inf).at[6, 3].set(-jnp.inf)
        traversable = jnp.full(BEV.shape, jnp.nan)

    monkeypatch.setattr(fusion, "answer", lambda *_: Answered)
    local = window()._replace(occupancy=jnp.full(SHAPE, -2.0), seen=jnp.ones(SHAPE, bool))
    some = jax.device_get(fusion.predictor.__wrapped__(SPEC)(params, observed(POSES[0]), local))
    assert all(np.isfinite(field).all() for field in some)
    zero = np.zeros(BEV.shape, bool)
    zero[[2, 5, 6], [4, 9, 3]] = True
    for i in range(SHAPE[0]):
        for j in range(SHAPE[1]):
            x, y = ORIGIN[0] + (j + 0.5) * RESOLUTION, ORIGIN[1] + (i + 0.5) * RESOLUTION
            cell, margin = network_cell(POSES[0], x, y)
            if margin > 1e-4 and 0 <= cell[0] < BEV.shape[0] and 0 <= cell[1] < BEV.shape[1]:
                assert (float(some.confidence[i, j]) == 0) == zero[cell]


def test_the_same_network_is_the_same_function():
    assert fusion.predictor(SPEC) is fusion.predictor(dataclasses.replace(SPEC))
    assert fusion.predictor(SPEC) is not fusion.predictor(dataclasses.replace(SPEC, joint=9))


def test_what_the_network_reads(params):
    seen, local = observed(POSES[1]), window()
    x = fusion.inputs_of(SPEC, params, seen, local)
    np.testing.assert_array_equal(x.images[0], seen.images)
    np.testing.assert_array_equal(x.points[0], seen.points)
    np.testing.assert_array_equal(x.local_map[0], bev.classes(BEV, local, seen.pose))
    rule = geometric.predict(params.rule, seen._replace(goal=f32((1e4, 1e4))), local)
    for name, values in (("rule_p", rule.p_dead), ("rule_confidence", rule.confidence)):
        got = np.asarray(getattr(x, name)[0])
        for i in range(BEV.shape[0]):
            for j in range(BEV.shape[1]):
                ahead = BEV.ahead + (j + 0.5 - BEV.shape[1] / 2) * BEV.resolution
                left = (i + 0.5 - BEV.shape[0] / 2) * BEV.resolution
                c, s = math.cos(POSES[1][2]), math.sin(POSES[1][2])
                column = (POSES[1][0] + c * ahead - s * left - ORIGIN[0]) / RESOLUTION
                row = (POSES[1][1] + s * ahead + c * left - ORIGIN[1]) / RESOLUTION
                if min(abs(column - round(column)), abs(row - round(row))) < 1e-3:
                    continue  # float32 may fall either way
                inside = 0 <= row < SHAPE[0] and 0 <= column < SHAPE[1]
                assert got[i, j] == (np.asarray(values)[int(row), int(column)] if inside else 0.0)
    other = fusion.inputs_of(SPEC, params, seen._replace(goal=f32((1.5, 4.0))), local)
    chex.assert_trees_all_equal(other, x)  # as in training, nobody asks for the goal


def test_temperatures_are_applied(params):
    trained = Trained(SPEC, params.network, Calibration(dead=Temperature(2.0, -0.3)), {}, "")
    held = fusion.params_of(trained, weight=0.2)
    assert held.weight == 0.2 and held.network is params.network
    raw, tempered = (predict(p, observed(), window()) for p in (params, held._replace(weight=0.35)))
    inside = np.asarray(raw.confidence) > 0
    logit = lambda p: np.log(p) - np.log1p(-p)  # noqa: E731
    want = logit(np.float64(raw.p_dead)[inside]) / 2 - 0.3
    np.testing.assert_allclose(logit(np.float64(tempered.p_dead)[inside]), want, rtol=1e-3, atol=1e-4)  # float32


GRID = GridSpec(shape=(64, 96))
NAV = NavSpec(
    filter=FilterSpec(grid=GRID, num_bearings=60, local_cells=64), predictor=fusion.predictor(SPEC),
    generator=GeneratorSpec(num_speeds=3, num_turns=7, num_headings=34), tracker=TrackerSpec(num_speeds=5, num_turns=7),
    recovery_points=RecoverySpec(grid=GRID, capacity=8, num_directions=12), memory=MemorySpec(cells=32),
)  # fmt: skip


@pytest.mark.long
def test_the_robot_drives_by_it_with_broken_sensors_too(params):
    nav = NavParams(predictor=params)
    step = jax.jit(
        chex.assert_max_traces(navigator.step.__wrapped__, n=1), static_argnames=("spec", "replan")
    )  # fmt: skip
    state = navigator.init(NAV, nav, f32((0.0, 0.0, 0.3)))
    prior = np.asarray(state.belief.dead_end)
    rng = np.random.default_rng(0)
    bearing = rng.uniform(-1.5, 1.5, 14)
    points = np.stack([3 * np.cos(bearing), 3 * np.sin(bearing), np.full(14, 0.5)], axis=-1)
    seen = observed((0.0, 0.0, 0.3))._replace(points=f32(points))
    for number, spoilt in enumerate((
        seen, seen._replace(images=seen.images.at[1, 3].set(jnp.nan)),
        seen._replace(image_valid=jnp.zeros(3, bool), point_valid=jnp.zeros(14, bool)),
        seen._replace(images=jnp.full_like(seen.images, jnp.nan), points=jnp.full_like(seen.points, jnp.inf)),
    )):  # fmt: skip
        state, command, _ = step(NAV, nav, state, spoilt, jax.random.key(number), replan=True)
        assert np.isfinite([float(command.v), float(command.omega)]).all()
        belief = np.asarray(state.belief.dead_end)
        assert np.isfinite(belief).all()
        if number == 0:
            moved = belief != prior
            assert moved.any() and not moved.all()
