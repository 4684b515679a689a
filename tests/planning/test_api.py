"""`plan`: a quadratic price's optimum, a wall in a field, one program for a sweep; slopes that are the differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax import planning
from drnav_jax.planning import api
from drnav_jax.planning.api import PlanParams, drive, init, plan
from drnav_jax.planning.mppi import MppiParams
from drnav_jax.planning.noise import NoiseSpec
from drnav_jax.types import GridMap, RobotParams

DT = 0.1
KEY = jax.random.key(0)
WIDE = RobotParams(v_min=-9.0, v_max=9.0, w_max=9.0, a_max=900.0, alpha_max=900.0)  # no limit is met
PARAMS = PlanParams()


def f32(values):
    return jnp.asarray(values, jnp.float32)


def squares(data, m):
    """Distance from a place, and effort."""
    place, effort = data
    return jnp.square(m.x - place[0]) + jnp.square(m.y - place[1]) + effort * (jnp.square(m.v) + jnp.square(m.w))


def optimum(place, effort, steps):
    """Least of sum (dt sum_{k<=t} v_k - place)^2 + effort v_t^2: linear least squares. Speeds and cost."""
    reach = DT * np.tril(np.ones((steps, steps)))
    v = np.linalg.solve(reach.T @ reach + effort * np.eye(steps), reach.T @ np.full(steps, place))
    return v, float(np.sum((reach @ v - place) ** 2) + effort * np.sum(v**2))


@pytest.mark.long
def test_a_quadratic_price_is_driven_to_its_optimum():
    steps, place, effort = 12, 1.0, 0.05
    best, least = optimum(place, effort, steps)
    data = (f32([place, 0.0]), f32(effort))
    state = init(f32([0, 0, 0]), num_steps=steps)
    still = float(drive(PARAMS, state, squares, f32(np.zeros((steps, 2))), data=data)[1])
    assert still == pytest.approx(steps * place**2)
    path, known = drive(PARAMS._replace(robot=WIDE), state, squares, f32(np.stack([best, 0 * best], 1)), data=data)
    assert float(known) == pytest.approx(least, rel=1e-5)
    np.testing.assert_allclose(path[:, 0], DT * np.cumsum(best), rtol=1e-5)
    params = PlanParams(WIDE, MppiParams(temperature=0.01, gamma=0.0, std_v=0.3, std_w=0.1))
    for k in range(6):
        found = plan(
            params, state, squares, jax.random.key(k), num_samples=512, num_iterations=8, data=data, smooth=False
        )
        state = found.state._replace(  # the same trip again, from where this plan got
            pose=state.pose, twist=state.twist, mppi=found.state.mppi._replace(control=found.commands)
        )
    assert least < float(found.cost) < 1.02 * least < 0.5 * still
    np.testing.assert_allclose(found.commands[:, 0], best, atol=0.25)
    assert float(jnp.abs(found.path[:, 1]).max()) < 0.05 and not bool(found.failed)
    assert float(found.best) == pytest.approx(float(found.cost), rel=0.05)
    # what gradients are for: the rest of the way to the optimum
    slope = jax.jit(jax.grad(lambda u: drive(params, state, squares, u, data=data)[1]))
    u = found.commands
    for _ in range(300):
        u = u - 0.5 * slope(u)
    assert float(drive(params, state, squares, u, data=data)[1]) == pytest.approx(least, rel=1e-4)
    np.testing.assert_allclose(u[:, 0], best, atol=1e-2)


def field(wall):
    """5 m x 4 m, with a wall of that cost at x = 1.5 .. 1.8 from the lower edge up to y = 2.3."""
    values = np.zeros((40, 50), np.float32)
    values[:23, 15:18] = wall
    return GridMap(f32(values), f32([0, 0]), 0.1)


def through(wall, path):
    """Metres of the path inside the wall."""
    xy = np.asarray(path)[:, :2]
    inside = (xy[1:, 0] > 1.5) & (xy[1:, 0] < 1.8) & (xy[1:, 1] < 2.3)
    return float(np.linalg.norm(np.diff(xy, axis=0), axis=1)[inside].sum())


@pytest.mark.parametrize(("wall", "around"), [(0.0, False), (0.5, False), (30.0, True), (np.inf, True)])
def test_a_wall_is_passed_through_where_that_is_cheap_and_around_where_it_is_not(wall, around):
    goal, state = f32([3.0, 2.0]), init(f32([0.7, 2.0, 0.0]), num_steps=40)
    for k in range(4):
        found = plan(PARAMS, state, field(wall), jax.random.key(k), num_samples=1000, num_iterations=5, goal=goal)
        state = state._replace(mppi=found.state.mppi._replace(control=found.commands))
    end = np.asarray(found.path[-1, :2])
    # of 2.3 m; by other noise, or rounding, it ends 0.1 to 0.8 m away
    assert np.hypot(*(end - goal)) < 1.0 and not bool(found.failed)
    assert through(wall, found.path) == (0.0 if around else pytest.approx(0.3, abs=0.11))
    assert (float(found.path[:, 1].max()) > 2.3) == around
    at = field(wall)._replace(values=jnp.where(jnp.isinf(field(wall).values), 0.0, field(wall).values))
    steps = np.abs(np.asarray(found.commands[:, 0])) * DT
    paid = sum(s * float(planning.api.geometry.sample_bilinear(at, p[:2])) for s, p in zip(steps, found.path, strict=True))
    assert float(found.cost) == pytest.approx(paid + np.hypot(*(end - goal)), rel=1e-3, abs=1e-4)


def test_walled_in_it_fails_and_brakes():
    values = np.full((20, 20), np.inf, np.float32)
    state = init(f32([1.0, 1.0, 0.0]), f32([0.4, 0.2]), num_steps=8)
    found = plan(PARAMS, state, GridMap(f32(values), f32([0, 0]), 0.1), KEY, num_samples=16, goal=f32([5, 1]))
    assert bool(found.failed) and float(found.cost) > api.COLLISION
    np.testing.assert_allclose(found.commands[:, 0], np.maximum(0.4 - 0.25 * np.arange(1, 9), 0), atol=1e-6)
    assert bool(jnp.all(jnp.isfinite(found.path)))


@pytest.mark.parametrize("mppi", [{}, {"std_v": 0.0}, {"temperature": 0.0, "gamma": 0.01}])
def test_what_has_no_price_is_kept_out_of(mppi):
    """NaN, as maps have it for what nobody has seen, beside the way; and parameters at their ends."""
    values = np.zeros((80, 120), np.float32)
    values[50:] = np.nan  # y > 1
    params = PARAMS._replace(mppi=PARAMS.mppi._replace(**mppi))
    state = init(f32([0, 0.8, 0.5]), num_steps=20)
    for k in range(25):
        found = plan(
            params, state, GridMap(f32(values), f32([-2, -4]), 0.1), jax.random.key(k), num_samples=200, goal=f32([5, 0.5])
        )
        assert all(bool(jnp.all(jnp.isfinite(a))) for a in (found.commands, found.path, found.cost, found.best))
        state = found.state
    assert not bool(found.failed) and float(state.pose[1]) < 1.05
    assert float(state.pose[0]) > (0.5 if "std_v" not in mppi else -0.1), "it drives on"


def test_nothing_has_a_price_and_it_brakes():
    state = init(f32([1.0, 1.0, 0.0]), f32([0.4, 0.2]), num_steps=8)
    unknown = GridMap(jnp.full((20, 20), jnp.nan), f32([0, 0]), 0.1)
    found = plan(PARAMS, state, unknown, KEY, num_samples=16, goal=f32([5, 1]))
    assert bool(found.failed)
    np.testing.assert_allclose(found.commands[:, 0], np.maximum(0.4 - 0.25 * np.arange(1, 9), 0), atol=1e-6)


def test_limits_hold_and_the_loop_drives():
    robot, state = PARAMS.robot, init(f32([0, 0, 0.5]))
    for k in range(60):
        found = plan(PARAMS, state, field(0.0), jax.random.key(k), num_samples=200, goal=f32([3.0, 0.5]))
        u = np.concatenate([state.twist[None], found.commands])
        assert u[:, 0].min() >= robot.v_min - 1e-6 and u[:, 0].max() <= robot.v_max + 1e-6
        assert np.abs(u[:, 1]).max() <= robot.w_max + 1e-6
        assert np.abs(np.diff(u, axis=0)).max(axis=0) == pytest.approx(
            [0, 0], abs=max(robot.a_max, robot.alpha_max) * DT + 1e-5
        )
        assert np.abs(np.diff(u[:, 0])).max() <= robot.a_max * DT + 1e-5
        np.testing.assert_array_equal(found.state.pose, found.path[0])
        state = found.state
    assert np.hypot(*(np.asarray(state.pose[:2]) - [3.0, 0.5])) < 0.3


def test_one_program_for_a_sweep_and_a_batch_is_its_members():
    traces = []

    def price(data, m):
        traces.append(None)
        return squares(data, m)

    data, state = (f32([1.0, 0.5]), f32(0.1)), init(f32([0, 0, 0]), num_steps=10)
    call = lambda p, d, k: plan(p, state, price, k, num_samples=32, data=d)  # noqa: E731
    single, counts = [], set()
    sweep = [(f32(t), f32(s), k) for t, s, k in [(0.1, 0.3, 1), (0.5, 0.2, 2), (1.0, 0.4, 3)]]
    for temperature, std, k in sweep:
        params = PARAMS._replace(mppi=PARAMS.mppi._replace(temperature=temperature, std_v=std))
        single.append((params, call(params, (data[0] * temperature, std), jax.random.key(k))))
        counts.add(len(traces))
    assert len(counts) == 1, "the first compiles, the others do not"
    params = jax.tree.map(lambda *a: jnp.stack([f32(x) for x in a]), *[p for p, _ in single])
    stds, keys = f32([s for _, s, _ in sweep]), jax.vmap(jax.random.key)(jnp.array([k for *_, k in sweep]))
    places = jnp.stack([data[0] * t for t, *_ in sweep])
    batch = jax.vmap(call)(params, (places, stds), keys)
    one = jax.tree.map(lambda *a: jnp.stack(a), *[found for _, found in single])
    for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(one), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)  # float32 sums over samples


def test_a_field_may_change_without_compiling_again():
    state, goal = init(f32([0.7, 2.0, 0.0]), num_steps=10), f32([3.0, 2.0])
    plan(PARAMS, state, field(0.0), KEY, num_samples=20, goal=goal)
    before = api._plan._cache_size()
    for wall in (1.0, np.inf):
        plan(PARAMS, state, field(wall), KEY, num_samples=20, goal=goal)
    assert api._plan._cache_size() == before


def reference_cost(values, goal, pose, commands):
    """Equation (3) in float64, for commands within the limits."""
    x, y, yaw = map(float, pose)
    total, (h, w) = 0.0, values.shape
    for v, omega in commands:
        x, y, yaw = x + v * np.cos(yaw) * DT, y + v * np.sin(yaw) * DT, yaw + omega * DT
        fx, fy = np.clip(x / 0.1 - 0.5, 0, w - 1), np.clip(y / 0.1 - 0.5, 0, h - 1)
        j, i = min(int(fx), w - 2), min(int(fy), h - 2)
        a, b = fx - j, fy - i
        near = values[i : i + 2, j : j + 2]
        total += np.array([1 - b, b]) @ near @ np.array([1 - a, a]) * abs(v) * DT
    return total + np.hypot(x - goal[0], y - goal[1])


def test_slopes_of_a_drive_are_the_differences():
    rng = np.random.default_rng(0)
    values, goal, pose = rng.random((40, 50)), np.array([3.0, 1.0]), np.array([0.7, 1.2, 0.3])
    u = np.stack([0.5 + 0.1 * rng.random(15), rng.uniform(-0.1, 0.1, 15)], 1)  # within the limits
    state = init(f32(pose), f32(u[0]), num_steps=15)

    def cost(commands, at, values):
        return drive(PARAMS, state._replace(pose=at), GridMap(values, f32([0, 0]), 0.1), commands, goal=f32(goal))[1]

    slopes = jax.grad(cost, argnums=(0, 1, 2))(f32(u), f32(pose), f32(values))
    assert float(cost(f32(u), f32(pose), f32(values))) == pytest.approx(reference_cost(values, goal, pose, u), rel=1e-5)
    eps = 1e-6
    for k in range(3):  # of a dozen entries each: all of the pose, some commands, cells on the way
        bump = np.eye(3)[k] * eps
        want = (reference_cost(values, goal, pose + bump, u) - reference_cost(values, goal, pose - bump, u)) / (2 * eps)
        assert float(slopes[1][k]) == pytest.approx(want, rel=2e-3, abs=1e-4)
    for t, axis in [(0, 0), (3, 1), (7, 0), (9, 1), (14, 0)]:
        bump = np.zeros_like(u)
        bump[t, axis] = eps
        want = (reference_cost(values, goal, pose, u + bump) - reference_cost(values, goal, pose, u - bump)) / (2 * eps)
        assert float(slopes[0][t, axis]) == pytest.approx(want, rel=2e-3, abs=1e-4)
    touched = np.argwhere(np.asarray(slopes[2]) != 0)
    assert 10 < len(touched) < 80
    for i, j in touched[::4]:
        bump = np.zeros_like(values)
        bump[i, j] = 1.0  # linear in the field
        want = reference_cost(values + bump, goal, pose, u) - reference_cost(values, goal, pose, u)
        assert float(slopes[2][i, j]) == pytest.approx(want, rel=1e-3, abs=1e-5)


def test_a_plan_is_differentiable_forwards():
    """How its first command answers to the goal: the differences of whole plans with the same key."""
    state = init(f32([0.7, 1.2, 0.3]), f32([0.5, 0.0]), num_steps=12)
    warm = PARAMS._replace(mppi=PARAMS.mppi._replace(temperature=0.3))
    turn = lambda y: plan(  # noqa: E731
        warm, state, field(0.0), KEY, num_samples=400, goal=jnp.stack([f32(3.0), y])
    ).commands[3, 1]
    value, slope = jax.jvp(turn, (f32(1.4),), (f32(1.0),))
    differences = (float(turn(f32(1.45))) - float(turn(f32(1.35)))) / 0.1
    assert float(slope) == pytest.approx(differences, rel=0.05) and differences > 1e-3


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_samples": 0}, "num_samples must be >= 1"),
        ({"dt": 0.0}, "dt > 0 s"),
        ({"noise": NoiseSpec(bank=100)}, "bank must be 0"),
        ({"goal": None}, r"needs goal=\(x, y\)"),
        ({"data": 1.0}, "takes no data"),
    ],
)
def test_mistakes_are_named(wrong, message):
    given = {"num_samples": 8, "goal": f32([1, 0])} | wrong
    with pytest.raises(ValueError, match=message):
        plan(PARAMS, init(f32([0, 0, 0]), num_steps=8), field(0.0), KEY, **given)


def test_a_function_takes_no_goal_and_is_exported():
    state = init(f32([0, 0, 0]), num_steps=8)
    with pytest.raises(ValueError, match="goal belongs to a field"):
        planning.plan(PARAMS, state, squares, KEY, num_samples=8, goal=f32([1, 0]))
