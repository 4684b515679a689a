"""MJX physics against native MuJoCo, closed forms and the true distance to obstacles."""

import functools
import importlib
import subprocess
import sys

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax import worlds
from drnav_jax.bench.obstacles import random_obstacles
from drnav_jax.sim import episode, mjx
from drnav_jax.sim.kinematic import FaultParams
from drnav_jax.sim.lidar import LidarParams, LidarSpec
from drnav_jax.sim.mjx import MjxParams, MjxSpec
from drnav_jax.sim.solids import Solids
from drnav_jax.types import Command, RobotParams
from drnav_jax.worlds import Material, make_world, signed_distance, surfaces

SPEC = MjxSpec()
H = SPEC.timestep
DT = 0.1
ROBOT, USUAL, NONE = RobotParams(), MjxParams(), FaultParams()
QUICK = RobotParams(a_max=1e6, alpha_max=1e6)  # set-points jump: what is left is eq. 1
RADIUS = 0.25
ROWS = 64  # of all solids here, so that they share a program
ENTERED = 0.02  # [m] deepest that a robot at 1 m/s may be inside an obstacle


def rows_of(*each):
    """Solids `[B, ...]` of worlds, padded to `ROWS`."""
    given = mjx.solids_of(list(each))

    def padded(rows):
        more = np.tile(rows[:1, :1], (len(rows), ROWS - rows.shape[1], 1))
        more[..., :2] = worlds.FAR
        return jnp.asarray(np.concatenate([rows, more], axis=1))

    return Solids(*map(padded, given))


def single(world):
    return jax.tree.map(lambda a: a[0], rows_of(world))


EMPTY = make_world()
FACE = 2.0  # [m] x of the front of the wall
WALL = make_world(boxes=[[FACE + 0.5, 0.0, 0.0, 0.5, 5.0, 0.0, 2.0]])


def f32(tree):
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), tree)


def drive(solids, commands, pose=(0, 0, 0), params=USUAL, robot=ROBOT, faults=NONE, body=None):
    """Ticks of one robot: poses `[T, 3]`, twists `[T, 2]` and bodies."""
    pose, body = jnp.asarray(pose, jnp.float32), mjx.init() if body is None else body
    params, robot, faults = f32((params, robot, faults))
    out = []
    for v, omega in commands:
        command = Command(jnp.float32(v), jnp.float32(omega))
        pose, twist, body = mjx.step(SPEC, params, robot, solids, pose, body, command, DT, faults)
        out.append((np.asarray(pose), np.asarray(twist), jax.device_get(body)))
    poses, twists, bodies = zip(*out, strict=True)
    return np.array(poses), np.array(twists), bodies


@functools.partial(jax.jit, static_argnames="ticks")
def drive_many(solids, poses, bodies, key, ticks):
    """Random commands, a new one each second, some not numbers: poses `[B, ticks, 3]` and bodies, and how it ended."""

    def one(solids, pose, body, key):
        def tick(carry, k):
            pose, body = carry
            u = jax.random.uniform(jax.random.fold_in(key, k // 10), (3,))
            v, omega = 1.3 * u[0] - 0.3, 3 * u[1] - 1.5
            v = jnp.where(u[2] < 0.02, jnp.nan, jnp.where(u[2] < 0.04, jnp.inf, v))
            pose, _, body = mjx.step(SPEC, f32(MjxParams()), ROBOT, solids, pose, body, Command(v, omega), DT)
            return (pose, body), (pose, body)

        end, log = jax.lax.scan(tick, (pose, body), jnp.arange(ticks))
        return log, end

    return jax.vmap(one)(solids, poses, bodies, jax.random.split(key, poses.shape[0]))


def native(world, params=USUAL, robot=ROBOT, faults=NONE):
    """The same XML in native MuJoCo, 100 iterations: all solids of the world at once, cylinders as true ones."""
    mujoco, _ = mjx.load()
    nb, nc = len(world.boxes), len(world.cylinders)
    text = mjx.xml(MjxSpec(near_boxes=max(nb, 1), near_posts=max(nc, 1), iterations=100))
    spec = mujoco.MjSpec.from_string(text)
    geoms = list(spec.geoms)
    for geom, (x, y, yaw, half_x, half_y, _, _) in zip(geoms, np.asarray(world.boxes, float), strict=False):
        geom.pos, geom.size = [x, y, 0], [half_x, half_y, 3]
        geom.quat = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    for geom, (x, y, r, _, _) in zip(geoms[max(nb, 1) :], np.asarray(world.cylinders, float), strict=False):
        geom.type, geom.pos, geom.size = mujoco.mjtGeom.mjGEOM_CYLINDER, [x, y, 0], [r, 3, 0]
    mass = params.mass + params.payload
    inertia = mass * robot.radius**2 / 2
    body = spec.body("robot")
    body.mass, body.inertia = mass, [inertia] * 3
    geoms[-1].size = [robot.radius, 0, 0]
    weights = {"along": (mass, params.lag), "across": (mass, 0), "about": (inertia, params.turn_lag)}
    slips = {"along": faults.slip_v, "across": 0, "about": faults.slip_omega}
    for actuator in spec.actuators:
        weight, lag = weights[actuator.name]
        gain = weight / H * (1 - np.exp(-H * params.mass / (lag * mass)) if lag else 1)
        actuator.gainprm[0], actuator.biasprm[2] = gain * (1 - slips[actuator.name]), -gain
        force = params.grip * mass * 9.81 * (robot.radius if actuator.name == "about" else 1)
        actuator.forcerange = [-force, force]
    model = spec.compile()
    assert model.opt.iterations == 100 and model.ngeom == max(nb, 1) + max(nc, 1) + 1
    return mujoco, model


def drive_native(world, commands, pose=(0, 0, 0), robot=ROBOT, **how):
    """Poses `[T, 3]` of native MuJoCo, and the deepest penetration; set-points as eq. 1 has them."""
    mujoco, model = native(world, robot=robot, **how)
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    setpoint, poses, deepest = np.zeros(2), [], 0.0
    most = np.array([robot.a_max, robot.alpha_max]) * H
    for command in commands:
        for _ in range(round(DT / H)):
            setpoint += np.clip(command - setpoint, -most, most)
            data.ctrl[:] = setpoint[0], 0, setpoint[1]
            mujoco.mj_step(model, data)
            deepest = max(deepest, -min((c.dist for c in data.contact), default=0))
        poses.append(data.qpos.copy())
    return np.array(poses), deepest


def random_commands(seed, seconds=5, every=7):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform([-0.2, -1.5], [1.0, 1.5], (50, 2)), every, axis=0)[: seconds * 10]


def apart(a, b):
    """Largest distance of positions [m]."""
    return np.hypot(*(a - b)[:, :2].T).max()


PARAMETERS = {
    "default": {},
    "laden": {"params": MjxParams(payload=30.0)},
    "slow motors on ice": {"params": MjxParams(lag=0.3, turn_lag=0.2, grip=0.1)},
    "slipping": {"faults": FaultParams(slip_v=0.2, slip_omega=0.4)},
    "small": {"params": MjxParams(mass=5.0, lag=0.0, turn_lag=0.0), "robot": ROBOT._replace(radius=0.15)},
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_away_from_contact_it_is_native_mujoco(name):
    for seed in range(3):
        commands = random_commands(seed)
        expected, _ = drive_native(EMPTY, commands, (0.3, -0.2, 1.0), **PARAMETERS[name])
        poses, _, bodies = drive(single(EMPTY), commands, (0.3, -0.2, 1.0), **PARAMETERS[name])
        assert apart(poses, expected) < 1e-3, "5 cm are allowed"
        turned = (poses - expected)[:, 2]
        np.testing.assert_allclose((turned + np.pi) % (2 * np.pi) - np.pi, 0, atol=1e-3)
        assert not any(b.contact for b in bodies) and all(b.sound for b in bodies)


def test_away_from_contact_it_is_native_mujoco_in_a_full_world():
    # 40 obstacles; only what never touches one is compared, and there is enough of it.
    compared = 0
    for seed in range(8):
        world = random_obstacles(seed, 40, extent=8.0, gap=0.6)
        world = jax.tree.map(np.asarray, world)
        commands = random_commands(seed)
        poses, _, bodies = drive(single(world), commands)
        free = int(np.argmax([b.contact for b in bodies])) if any(b.contact for b in bodies) else 50
        expected, _ = drive_native(world, commands)
        compared += free
        assert free == 0 or apart(poses[:free], expected[:free]) < 1e-3
    assert compared > 150


@pytest.mark.parametrize(
    ("world", "start"),
    [
        (WALL, (0, 0, 0)),  # head on
        (WALL, (0.6, 0, 0.9)),  # at a slant: it slides along
        (make_world(cylinders=[[2.0, 0.0, 0.6, 0.0, 2.0]]), (0, 0, 0)),
        (make_world(cylinders=[[2.0, 0.3, 0.2, 0.0, 2.0]]), (0, 0, 0)),  # off the centre: it is pushed aside
        (make_world(boxes=[[2.0, 0.5, 0.7, 0.5, 0.3, 0.0, 2.0]]), (0, 0, 0)),  # a corner
        (make_world(boxes=[[2, 1, 0.5, 2, 0.2, 0, 2], [2, -1, -0.5, 2, 0.2, 0, 2]]), (-1, 0, 0)),  # a wedge
    ],
)
def test_contact_is_where_native_mujoco_has_it(world, start):
    commands = np.tile([[1.0, 0.0]], (40, 1))
    poses, _, bodies = drive(single(world), commands, start)
    expected, native_deepest = drive_native(world, commands, start)
    assert any(b.contact for b in bodies)
    assert apart(poses, expected) < 1e-3
    deepest = max(float(b.depth) for b in bodies)
    assert deepest < ENTERED and native_deepest < ENTERED
    assert abs(deepest - native_deepest) < 1e-3
    assert (signed_distance(world, poses[:, :2]) - RADIUS).min() > -ENTERED


def test_among_many_obstacles_it_stays_close_to_native_mujoco():
    off, touched = [], 0
    for seed in range(10):
        world = jax.tree.map(np.asarray, random_obstacles(seed, 60, extent=4.0, gap=0.4))
        commands = random_commands(seed)
        poses, _, bodies = drive(single(world), commands)
        off.append(apart(poses, drive_native(world, commands)[0]))
        touched += any(b.contact for b in bodies)
    assert touched >= 8
    assert np.median(off) < 1e-3 and max(off) < 0.05, "one solver iteration instead of 100"


def test_a_wall_stops_it():
    poses, twists, bodies = drive(single(WALL), [(1.0, 0.0)] * 40)
    np.testing.assert_allclose(poses[-1], [FACE - RADIUS, 0, 0], atol=1e-3)
    np.testing.assert_allclose(twists[-1], 0, atol=1e-3)
    assert bodies[-1].contact and 0 < bodies[-1].depth < 1e-3 and not bodies[5].contact
    back, _, bodies = drive(single(WALL), [(-0.2, 0.0)] * 10, poses[-1], body=bodies[-1])
    assert back[-1, 0] < FACE - RADIUS - 0.1 and not bodies[-1].contact, "and lets it go again"


def crowd(num):
    """Worlds of 100 obstacles and a free pose in each."""
    rng = np.random.default_rng(0)
    every, poses = [], []
    for seed in range(num):
        world = jax.tree.map(np.asarray, random_obstacles(seed, 100, extent=8.0))
        places = rng.uniform(-7, 7, (400, 2))
        xy = places[signed_distance(world, places) > RADIUS + 0.05][0]
        every.append(world)
        poses.append([*xy, rng.uniform(-np.pi, np.pi)])
    return every, rows_of(*every), jnp.asarray(poses, jnp.float32), jax.vmap(lambda _: mjx.init())(jnp.arange(num))


TICKS = 100


@pytest.mark.parametrize("num", [pytest.param(64, marks=pytest.mark.long), pytest.param(256, marks=pytest.mark.slow)])
def test_contact_stops_it_in_random_worlds(num):
    every, solids, poses, bodies = crowd(num)
    (path, log), _ = drive_many(solids, poses, bodies, jax.random.key(0), TICKS)
    path, touched = np.asarray(path), np.asarray(log.contact)
    room = np.array([signed_distance(w, p[:, :2]).min() for w, p in zip(every, path, strict=True)]) - RADIUS
    assert room.min() > -ENTERED and np.asarray(log.depth).max() < ENTERED
    assert touched.any(axis=1).sum() > 0.78 * num, "nearly all of them hit something"
    assert np.asarray(log.sound).all()
    apart_from_all = np.array([signed_distance(w, p[:, :2]) for w, p in zip(every, path, strict=True)]) > RADIUS + 0.1
    assert not (touched & apart_from_all).any(), "and nothing where there is nothing (0.1 m: moved within the tick)"


@pytest.mark.slow
def test_never_a_state_that_is_not_finite_in_a_million_steps():
    _, solids, poses, bodies = crowd(256)
    inside = solids.boxes[:, 0, :2]  # half of them begin in the middle of a box
    poses = poses.at[::2, :2].set(inside[::2])
    steps = 0
    for k in range(5):
        (path, log), (poses, bodies) = drive_many(solids, poses, bodies, jax.random.key(k), TICKS)
        assert np.isfinite(path).all() and np.asarray(log.sound).all() and np.isfinite(log.velocity).all()
        steps += path.shape[0] * path.shape[1] * SPEC.steps_in(DT)
    assert steps > 1e6


def test_a_state_that_is_not_finite_is_replaced_and_flagged():
    body = mjx.init()._replace(velocity=jnp.asarray([jnp.nan, 0.0, 0.0], jnp.float32))
    poses, twists, bodies = drive(single(WALL), [(1.0, 0.2)] * 5, (1.0, 2.0, 0.5), body=body)
    np.testing.assert_array_equal(poses[0], np.float32([1.0, 2.0, 0.5]))
    np.testing.assert_array_equal(twists[0], 0)
    assert np.isfinite(poses).all() and poses[-1, 0] > 1.1 and not bodies[-1].sound
    poses, _, bodies = drive(single(WALL), [(1.0, 0.0)], (1.0, 2.0, 0.5), params=MjxParams(payload=np.nan))
    np.testing.assert_array_equal(poses[0], np.float32([1.0, 2.0, 0.5]))
    assert not bodies[0].sound


def test_a_command_that_is_no_number_is_a_stop():
    _, twists, bodies = drive(single(EMPTY), [(1.0, 0.5)] * 10 + [(np.nan, np.nan)] * 10)
    np.testing.assert_allclose(twists[9], [1.0, 0.5], atol=1e-3)
    np.testing.assert_allclose(twists[-1], 0, atol=1e-3)
    _, twists, _ = drive(single(EMPTY), [(np.inf, -np.inf)] * 15)
    np.testing.assert_allclose(twists[-1], [1.0, -1.5], atol=1e-3)


@pytest.mark.parametrize("payload", [0.0, 20.0])
def test_the_drive_answers_like_a_first_order_lag(payload):
    params = MjxParams(lag=0.2, turn_lag=0.1, payload=payload, grip=10.0)
    _, twists, _ = drive(single(EMPTY), [(0.5, 0.0)] * 12, params=params, robot=QUICK)
    t = DT * np.arange(1, 13)
    np.testing.assert_allclose(twists[:, 0], 0.5 * (1 - np.exp(-t / (0.2 * (1 + payload / 20)))), atol=1e-4)
    _, twists, _ = drive(single(EMPTY), [(0.0, 1.0)] * 12, params=params, robot=QUICK)
    np.testing.assert_allclose(twists[:, 1], 1 - np.exp(-t / (0.1 * (1 + payload / 20))), atol=1e-4)


def test_acceleration_is_limited_by_the_motors_and_by_the_grip():
    none = MjxParams(lag=0.0, turn_lag=0.0)
    _, twists, _ = drive(single(EMPTY), [(1.0, 1.5)] * 3, params=none)
    np.testing.assert_allclose(twists[:, 0], 2.5 * DT * np.arange(1, 4), atol=2e-3)  # the skid across takes a little
    np.testing.assert_allclose(twists[:, 1], 3.2 * DT * np.arange(1, 4), atol=2e-3)
    _, twists, _ = drive(single(EMPTY), [(1.0, 0.0)] * 5, params=none._replace(grip=0.1), robot=QUICK)
    np.testing.assert_allclose(twists[:, 0], 0.1 * 9.81 * DT * np.arange(1, 6), atol=1e-4)


def skid(poses):
    """Speed across the robot between ticks [m/s]; the chord of an arc points half-way through the turn."""
    step, heading = np.diff(poses[:, :2], axis=0), (poses[1:, 2] + poses[:-1, 2]) / 2
    return np.abs(-np.sin(heading) * step[:, 0] + np.cos(heading) * step[:, 1]) / DT


def test_wheels_roll_and_do_not_skid_unless_the_ground_is_slippery():
    commands = [(1.0, 0.0)] * 10 + [(1.0, 1.5)] * 10  # 1.5 m/s^2 across
    poses, _, _ = drive(single(EMPTY), commands)
    assert skid(poses).max() < 0.02
    poses, _, _ = drive(single(EMPTY), commands, params=MjxParams(grip=0.1))
    assert skid(poses).max() > 0.2


def test_slip_moves_the_robot_less_than_its_wheels():
    poses, twists, bodies = drive(single(EMPTY), [(1.0, 0.6)] * 20, faults=FaultParams(slip_v=0.25, slip_omega=0.5))
    np.testing.assert_allclose(twists[-1], [1.0, 0.6], atol=1e-3)
    np.testing.assert_allclose(np.hypot(*bodies[-1].velocity[:2]), 0.75, atol=1e-3)
    np.testing.assert_allclose(poses[-1, 2] - poses[-2, 2], 0.3 * DT, atol=1e-4)


@pytest.mark.parametrize(
    ("material", "stops"),
    [(Material.WALL, True), (Material.GLASS, True), (Material.BUSH, True), (Material.CAR, True),
     (Material.DROP, True), (Material.GRASS, False), (Material.STRIPE, False)],
)  # fmt: skip
def test_what_blocks_stops_it_unless_it_passes_under(material, stops):
    low, high = (-2.0, 0.0) if material == Material.DROP else (1.0, 2.0)
    box = make_world([[2.0, 0.0, 0.0, 0.5, 2.0, low, high]], box_surfaces=surfaces(1, material))
    post = make_world(cylinders=[[2.0, 0.0, 0.5, low, high]], cylinder_surfaces=surfaces(1, material))
    for world in (box, post):
        poses, _, _ = drive(single(world), [(1.0, 0.0)] * 30)
        assert poses[-1, 0] == pytest.approx(1.5 - RADIUS, abs=1e-3) if stops else poses[-1, 0] > 2.5
    above = make_world([[2.0, 0.0, 0.0, 0.5, 2.0, 2.1, 2.5]], [[2.0, 0.0, 0.5, 1.6, 3.0]])  # a lintel, a crown
    assert drive(single(above), [(1.0, 0.0)] * 30)[0][-1, 0] > 2.5


def test_a_grid_map_stops_it_where_its_cells_are():
    occupied = np.zeros((40, 60), bool)
    occupied[:, 30:] = True
    occupied[23:, 25:] = True  # 5 cm away on the left
    solids = single(worlds.from_grid(occupied, (-1.0, -2.0), 0.1))
    poses, _, bodies = drive(solids, [(1.0, 0.0)] * 30)
    np.testing.assert_allclose(poses[-1], [-1.0 + 3.0 - RADIUS, 0.0, 0.0], atol=1e-3)
    assert bodies[-1].contact


def test_what_is_near_counts_even_among_many_long_walls():
    # Their bounding spheres all hold the robot, which is what MJX's own broad phase looks at.
    walls = [[0.0, 3.0 + 0.5 * k, 0.0, 20.0, 0.1, 0.0, 2.0] for k in range(15)]
    walls += [[0.0, -3.0 - 0.5 * k, 0.0, 20.0, 0.1, 0.0, 2.0] for k in range(15)]
    world = make_world([*walls, [2.0, 0.0, 0.0, 0.1, 0.1, 0.0, 2.0]])
    poses, _, _ = drive(single(world), [(1.0, 0.0)] * 30)
    assert poses[-1, 0] == pytest.approx(1.9 - RADIUS, abs=1e-3)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"timestep": 0.0}, "timestep must lie in"),
        ({"num_boxes": 0}, "num_boxes must be >= 1, got 0"),
        ({"iterations": 0}, "iterations must be >= 1"),
    ],
)
def test_the_spec_is_checked(wrong, message):
    with pytest.raises(ValueError, match=message):
        MjxSpec(**wrong)
    with pytest.raises(ValueError, match="multiple of MjxSpec.timestep, got 0.1 s and 0.03 s"):
        MjxSpec(timestep=0.03).steps_in(0.1)


def test_uniform_draws_between_its_ends():
    low, high = MjxParams(lag=0.02, payload=0.0, grip=0.5), MjxParams(lag=0.2, payload=20.0, grip=0.5)
    drawn = jax.vmap(lambda k: mjx.uniform(k, low, high))(jax.random.split(jax.random.key(0), 400))
    assert isinstance(drawn, MjxParams) and drawn.lag.shape == (400,)
    for name in MjxParams._fields:
        a, b, x = getattr(low, name), getattr(high, name), np.asarray(getattr(drawn, name))
        assert (a - 1e-6 <= x).all() and (x <= b + 1e-6).all()
        assert np.mean(x) == pytest.approx((a + b) / 2, abs=0.06 * (b - a) + 1e-6)
    assert abs(np.corrcoef(drawn.lag, drawn.payload)[0, 1]) < 0.2
    faults = mjx.uniform(jax.random.key(1), FaultParams(), FaultParams(slip_v=0.3))
    assert 0 < faults.slip_v < 0.3 and faults.delay == 0


@pytest.mark.long
def test_vmap_is_a_loop_and_a_sweep_compiles_once():
    world = jax.tree.map(np.asarray, random_obstacles(5, 60, extent=5.0))
    solids = rows_of(world, WALL, EMPTY)
    poses = jnp.asarray([[0, 0, 0.3], [1.5, 0, 0], [3, 1, -2]], jnp.float32)
    command = Command(jnp.float32(0.8), jnp.float32(0.4))
    bodies = jax.vmap(lambda _: mjx.init())(jnp.arange(3))

    @jax.jit
    @chex.assert_max_traces(n=1)
    def many(params, robot, poses, bodies):
        go = lambda s, p, b: mjx.step(SPEC, params, robot, s, p, b, command, DT)  # noqa: E731
        return jax.vmap(go)(solids, poses, bodies)

    for payload in (0.0, 15.0):
        params, robot = f32((MjxParams(payload=payload), ROBOT._replace(v_max=1.0 + payload)))
        got = (poses, None, bodies)
        for _ in range(5):
            got = many(params, robot, got[0], got[2])
        for k in range(3):
            one = (poses[k], None, mjx.init())
            for _ in range(5):
                mine = jax.tree.map(lambda a, k=k: a[k], solids)
                one = mjx.step(SPEC, params, robot, mine, one[0], one[2], command, DT, f32(NONE))
            chex.assert_trees_all_close(jax.tree.map(lambda a, k=k: a[k], got), one, atol=1e-5)


BEAMS = LidarSpec(rings=1, azimuths=9, elevation_min=0.0, elevation_max=0.0)


def _init(params, pose):
    return jnp.zeros((), jnp.float32)


def _toward(params, state, observation, key, replan):
    """Turn to the goal while driving at the speed asked for."""
    x, y, yaw = observation.pose
    aim = jnp.arctan2(observation.goal[1] - y, observation.goal[0] - x) - yaw
    aim = jnp.mod(aim + jnp.pi, 2 * jnp.pi) - jnp.pi
    return state, Command(v=params, omega=jnp.clip(2 * aim, -1.0, 1.0)), {"twist": observation.twist}


PURSUIT = episode.Policy(init=_init, step=_toward)


def pursue(physics, rows, faults=NONE, max_delay=10):
    """Episodes out of (world, start, goal, time limit) at 0.9 m/s."""
    every, start, goal, limit = zip(*rows, strict=True)
    spread = lambda tree: jax.tree.map(lambda a: np.full(len(rows), a, np.float32), tree)  # noqa: E731
    numbers = lambda a: np.asarray(a, np.float32)  # noqa: E731
    spec = episode.EpisodeSpec(lidar=BEAMS, chunk_ticks=10, physics=physics, lanes=4, max_delay=max_delay)
    params = episode.EpisodeParams(
        world=worlds.stack_worlds(list(every)), start=numbers(start), goal=numbers(goal), time_limit=numbers(limit),
        goal_tolerance=spread(0.3), robot=spread(ROBOT), policy=spread(0.9), lidar=spread(LidarParams()),
        faults=spread(faults), motors=() if physics is None else spread(MjxParams()),
        solids=() if physics is None else mjx.solids_of(list(every), physics),
    )  # fmt: skip
    return episode.run(spec, PURSUIT, params, jax.random.split(jax.random.key(0), len(rows)), workers=1)


POST = make_world(cylinders=[[3.0, 0.0, 0.4, 0.0, 2.0]])
ROWS_DRIVEN = [
    (EMPTY, (0, 0, 0.5), (9.0, 2.0), 60.0),
    (EMPTY, (1, 1, -2.5), (6.0, 8.0), 60.0),
    (POST, (0, 1.5, 0), (9.0, 1.5), 60.0),  # passes by
    (POST, (0, 0, 0), (9.0, 0.1), 60.0),  # hits
]


@pytest.mark.long
def test_both_physics_agree_in_open_space_and_on_what_a_collision_is():
    rough, fine = pursue(None, ROWS_DRIVEN).state, pursue(SPEC, ROWS_DRIVEN).state
    np.testing.assert_array_equal(fine.success, [True, True, True, False])
    np.testing.assert_array_equal(fine.collision, [False, False, False, True])
    np.testing.assert_array_equal(rough.success, fine.success)
    np.testing.assert_array_equal(rough.collision, fine.collision)
    np.testing.assert_allclose(fine.distance[:3], rough.distance[:3], rtol=0.02)
    # Times are whole ticks: one tick of rounding, and 2 %.
    np.testing.assert_allclose(fine.tick[:3] - 0.0, rough.tick[:3], rtol=0.02, atol=1)
    assert -ENTERED < fine.min_clearance[3] < 0 and fine.body.sound.all()


def test_mjx_needs_its_parameters():
    spec = episode.EpisodeSpec(physics=SPEC)
    with pytest.raises(ValueError, match="MJX needs EpisodeParams.motors"):
        episode.run(spec, PURSUIT, _bare(), jax.random.split(jax.random.key(0), 1))
    with pytest.raises(ValueError, match="multiple of MjxSpec.timestep"):
        episode.EpisodeSpec(physics=SPEC, dt=0.11)


def _bare():
    one = np.ones(1, np.float32)
    return episode.EpisodeParams(
        world=EMPTY, start=one, goal=one, time_limit=one, goal_tolerance=one, robot=ROBOT, policy=one,
        faults=FaultParams(*[one * 0] * 5),
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("physics", [None, SPEC])
def test_a_late_command_is_the_same_command_later(physics):
    rows = [(EMPTY, (0, 0, 0), (4.0, 0.0), 60.0), *ROWS_DRIVEN[1:]]  # straight ahead, so that nothing is steered late
    prompt, late = pursue(physics, rows), pursue(physics, rows, FaultParams(delay=0.3))
    assert late.state.tick[0] == prompt.state.tick[0] + 3
    n = int(prompt.state.tick[0])
    np.testing.assert_allclose(late.log.pose[0, 3 : n + 3], prompt.log.pose[0, :n], atol=1e-5)
    np.testing.assert_array_equal(late.log.pose[0, :3], 0)


def test_a_delay_beyond_the_spec_is_refused():
    with pytest.raises(ValueError, match="faults.delay is 3.0 ticks, EpisodeSpec.max_delay 2: raise it"):
        pursue(None, ROWS_DRIVEN[:1], FaultParams(delay=0.3), max_delay=2)


def test_importing_mujoco_says_nothing_on_stdout():
    program = "from drnav_jax.sim import mjx; import sys; assert 'mujoco' not in sys.modules; mjx.load()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == ""


def test_the_module_is_found_under_its_own_name():
    assert importlib.import_module("drnav_jax.sim.mjx") is mjx
