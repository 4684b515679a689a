"""DWA: what it certifies can stop, what it commands can be done, and it gets to where it is sent."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from drnav_jax.planning import tracker
from drnav_jax.planning.tracker import TrackerParams, TrackerSpec
from drnav_jax.types import RobotParams

SPEC = TrackerSpec(num_speeds=5, num_turns=7)
ROBOT, PARAMS = RobotParams(), TrackerParams()
DT = SPEC.dt
SHAPE, RESOLUTION, ORIGIN = (70, 90), 0.05, np.array([-2.0, -1.5], np.float32)
LIMIT = ROBOT.radius + PARAMS.margin
# Clearance falls by at most one metre per metre, and the certificate looks every dt / samples: in between it may be
# lower by half of that way, and arcs are driven as chords. What is left is above the radius.
BETWEEN = 0.5 * ROBOT.v_max * DT / SPEC.samples + 1e-3
STATES = 200

assert BETWEEN < PARAMS.margin

track = jax.jit(tracker.track.__wrapped__, static_argnames="spec")
track_all = jax.jit(
    jax.vmap(tracker.track.__wrapped__, (None, None, None, None, 0, 0, 0, 0)), static_argnums=0
)


def f32(values):
    return jnp.asarray(values, jnp.float32)


def go(clear, pose, twist, target, seek_room=False, params=PARAMS):
    return track(SPEC, params, ROBOT, clear, f32(pose), f32(twist), f32(target), jnp.asarray(seek_room))


def arc(pose, v, w, t):
    """Exact poses `[..., 3]` after times t at constant speeds."""
    x, y, yaw = (np.asarray(pose)[..., k] for k in range(3))
    turn = w * t
    chord = v * t * np.sinc(turn / (2 * np.pi))
    return np.stack([x + chord * np.cos(yaw + turn / 2), y + chord * np.sin(yaw + turn / 2), yaw + turn], axis=-1)


def braking(pose, twist, command, fine=10):
    """Finely sampled poses `[n, B, 3]` of: the command for one tick, then both speeds down at their limits."""
    poses, v, w = [pose], command[:, 0], command[:, 1]
    for _ in range(8):
        for k in range(1, fine + 1):
            poses.append(arc(pose, v, w, k * DT / fine))
        pose = poses[-1]
        v = np.sign(v) * np.maximum(np.abs(v) - ROBOT.a_max * DT, 0)
        w = np.sign(w) * np.maximum(np.abs(w) - ROBOT.alpha_max * DT, 0)
    return np.stack(poses)


def room_of(clear, poses):
    """Bilinear clearance, by SciPy."""
    values = np.asarray(clear.values, np.float64)
    cells = (poses[..., 1::-1] - ORIGIN[::-1]) / RESOLUTION - 0.5
    return ndimage.map_coordinates(values, np.moveaxis(cells, -1, 0), order=1, mode="nearest")


@pytest.fixture(scope="module")
def clutter(clearance_of):
    occupied = np.random.default_rng(0).random(SHAPE) < 0.006
    return clearance_of(occupied, ORIGIN, RESOLUTION)


@pytest.fixture(scope="module")
def open_space(clearance_of):
    return clearance_of(np.zeros(SHAPE, bool), ORIGIN, RESOLUTION)


def random_states(seed, clear):
    """Poses anywhere, speeds anywhere within the limits, targets anywhere."""
    rng = np.random.default_rng(seed)
    span = np.array(SHAPE[::-1]) * RESOLUTION
    pose = np.concatenate([ORIGIN + rng.uniform(0, 1, (STATES, 2)) * span, rng.uniform(-3.1, 3.1, (STATES, 1))], 1)
    twist = rng.uniform((-0.2, -1.5), (1.0, 1.5), (STATES, 2))
    target = ORIGIN + rng.uniform(0, 1, (STATES, 2)) * span
    return pose.astype(np.float32), twist.astype(np.float32), target.astype(np.float32)


def test_what_is_certified_can_stop(clutter):
    pose, twist, target = random_states(1, clutter)
    seek = jnp.asarray(np.arange(STATES) % 4 == 0)
    got = track_all(SPEC, PARAMS, ROBOT, clutter, pose, twist, target, seek)
    command = np.stack([got.command.v, got.command.omega], axis=-1)
    motion = braking(pose.astype(np.float64), twist, command.astype(np.float64))
    room, here = room_of(clutter, motion), room_of(clutter, pose.astype(np.float64))
    certified = np.asarray(got.certified)
    allowed = np.minimum(LIMIT, here - tracker.DIP) - BETWEEN
    moving = np.abs(command).max(axis=1) > 0
    assert (room.min(axis=0) >= allowed)[certified & moving].all()
    safe = certified & (here >= LIMIT)
    assert (room.min(axis=0) >= ROBOT.radius)[safe].all(), "a footprint would touch"
    assert 0.3 < safe.mean() < 0.95 and (~certified).sum() > 10
    # ... and says how near it comes
    assert (np.asarray(got.clearance) >= allowed)[certified & moving].all()


def test_the_terms_add_up_and_the_best_come_first(clutter):
    pose, twist, target = random_states(4, clutter)
    got = track_all(SPEC, PARAMS, ROBOT, clutter, pose, twist, target, jnp.zeros(STATES, bool))
    why = jax.tree.map(np.asarray, got.critics)
    sure = np.isfinite(why.best_cost)
    assert why.best.shape == (STATES, SPEC.num_explained, len(tracker.TERMS)) and 0.5 < sure.mean() < 1.0
    np.testing.assert_allclose(why.best.sum(axis=-1)[sure], why.best_cost[sure], rtol=1e-5, atol=1e-5)
    assert (np.diff(np.where(sure, why.best_cost, 1e9), axis=1) >= 0).all()
    np.testing.assert_array_equal(why.chosen, why.best[:, 0])
    some = np.isfinite(np.asarray(got.cost))
    np.testing.assert_array_equal(why.best_cost[some, 0], np.asarray(got.cost)[some])
    # how far it is to the target from where the motion ends, and how much clearance counts, is known elsewhere
    wide = go(clutter, pose[0], twist[0], target[0], params=PARAMS._replace(clearance=0.0, room=0.0, smoothness=0.0))
    named = dict(zip(tracker.TERMS, np.asarray(wide.critics.chosen), strict=True))
    assert named["clearance"] == named["room"] == named["smoothness"] == 0.0 < named["distance"]
    least = np.hypot(*(target[0] - pose[0, :2])) - ROBOT.v_max * 4 * SPEC.num_steps * DT
    assert named["distance"] * ROBOT.v_max >= max(least, 0.0)


def test_seeking_room_the_terms_are_the_room(clutter):
    pose, twist, target = random_states(5, clutter)
    got = track_all(SPEC, PARAMS, ROBOT, clutter, pose, twist, target, jnp.ones(STATES, bool))
    chosen, room = np.asarray(got.critics.chosen), tracker.TERMS.index("room")
    assert (np.delete(chosen, room, axis=1) == 0).all()
    some = np.isfinite(np.asarray(got.cost))
    np.testing.assert_array_equal(chosen[some, room], np.asarray(got.cost)[some])


def test_commands_are_within_the_limits(clutter):
    pose, twist, target = random_states(2, clutter)
    got = track_all(SPEC, PARAMS, ROBOT, clutter, pose, twist, target, jnp.zeros(STATES, bool))
    v, w = np.asarray(got.command.v), np.asarray(got.command.omega)
    tiny = 1e-6
    assert (v >= ROBOT.v_min - tiny).all() and (v <= ROBOT.v_max + tiny).all()
    assert (np.abs(w) <= ROBOT.w_max + tiny).all()
    assert (np.abs(v - twist[:, 0]) <= ROBOT.a_max * DT + tiny).all()
    assert (np.abs(w - twist[:, 1]) <= ROBOT.alpha_max * DT + tiny).all()


def test_what_cannot_be_certified_brakes(clearance_of):
    occupied = np.zeros(SHAPE, bool)
    occupied[:, 60:] = True  # x >= 1.0
    clear = clearance_of(occupied, ORIGIN, RESOLUTION)
    got = go(clear, [0.65, 0.0, 0.0], [1.0, 1.0], [5.0, 0.0])
    assert not bool(got.certified)
    np.testing.assert_allclose([got.command.v, got.command.omega], [0.75, 0.68], atol=1e-6)
    # slower, it can stop or turn aside in time
    assert bool(go(clear, [0.3, 0.0, 0.0], [0.4, 0.0], [5.0, 0.0]).certified)


def drive(clear, pose, target, ticks, seek_room=False, twist=(0.0, 0.0)):
    """Closed loop with exact arcs; poses `[ticks + 1, 3]` and commands."""
    pose, twist = np.asarray(pose, np.float64), np.asarray(twist, np.float64)
    poses, commands, certified = [pose], [], []
    for _ in range(ticks):
        got = go(clear, pose, twist, target, seek_room)
        twist = np.array([got.command.v, got.command.omega], np.float64)
        pose = arc(pose, *twist, DT)
        poses.append(pose)
        commands.append(twist)
        certified.append(bool(got.certified))
    return np.stack(poses), np.stack(commands), certified


@pytest.mark.parametrize("seed", range(3))
def test_from_standing_free_it_never_gets_too_near(clutter, seed):
    rng = np.random.default_rng(seed)
    values = np.asarray(clutter.values)
    i, j = rng.permutation(np.argwhere(values > LIMIT + 0.05))[0]
    start = [*(ORIGIN + (np.array([j, i]) + 0.5) * RESOLUTION), rng.uniform(-3, 3)]
    i, j = rng.permutation(np.argwhere(values < 0.1))[0]  # sent into an obstacle
    poses, _, certified = drive(clutter, start, ORIGIN + np.array([j, i]) * RESOLUTION, 60)
    assert room_of(clutter, poses).min() >= LIMIT - BETWEEN
    assert all(certified), "braking is always certified after a certified motion"


def test_it_turns_on_the_spot_when_the_target_is_behind(open_space):
    poses, commands, _ = drive(open_space, [0.0, 0.0, 0.0], [-1.4, 0.0], 45)
    turning = np.abs(np.unwrap(poses[:, 2])) < 2.0
    assert np.hypot(*poses[turning, :2].T).max() < 0.3
    assert np.abs(commands[:6, 1]).max() > 1.0
    distance = np.hypot(poses[:, 0] + 1.4, poses[:, 1])
    assert distance[-1] < 0.5 and (np.diff(distance[25:]) < 0).all()  # on its way, slower as it comes near


def test_it_drives_straight_when_the_target_is_ahead(open_space):
    poses, commands, _ = drive(open_space, [-1.0, 0.2, 0.0], [1.5, 0.2], 20)
    assert np.abs(poses[:, 1] - 0.2).max() < 0.05 and poses[-1, 0] > 0.5
    assert commands[:8, 0].max() == pytest.approx(ROBOT.v_max, abs=1e-5)
    np.testing.assert_allclose(np.diff(commands[:4, 0]), ROBOT.a_max * DT, atol=1e-5)


def test_it_passes_a_door_but_not_a_slit(clearance_of):
    for width, through in ((0.9, True), (0.5, False)):
        y = ORIGIN[1] + (np.arange(SHAPE[0]) + 0.5) * RESOLUTION
        occupied = np.zeros(SHAPE, bool)
        occupied[:, 38:42] = np.abs(y[:, None]) > width / 2
        clear = clearance_of(occupied, ORIGIN, RESOLUTION)
        poses, _, _ = drive(clear, [-1.2, 0.1, 0.2], [1.5, 0.0], 60)
        assert (poses[-1, 0] > 0.8) == through
        assert room_of(clear, poses).min() >= LIMIT - BETWEEN


@pytest.mark.parametrize("x", [-1.2, -0.9, -0.33])
def test_a_wall_does_not_hold_a_robot_that_stands_at_the_margin(clearance_of, x):
    occupied = np.zeros(SHAPE, bool)
    occupied[:20] = True
    clear = clearance_of(occupied, ORIGIN, RESOLUTION)
    heights = np.arange(ORIGIN[1], 1.0, 1e-4)
    at = np.stack([np.full_like(heights, x), heights, np.zeros_like(heights)], axis=1)
    y = heights[np.argmax(room_of(clear, at) >= LIMIT)]
    poses, _, _ = drive(clear, [x, y, -0.08], [x + 0.5, y - 0.02], 25)  # every way on leads nearer by some 0.1 mm
    assert poses[-1, 0] > x + 0.15
    assert room_of(clear, poses).min() >= LIMIT - 2 * tracker.DIP - 1e-3


@pytest.mark.parametrize("turn", [-1.3, -0.7, 1.1])
def test_a_robot_between_walls_does_not_go_on_spinning(clearance_of, turn):
    occupied = np.ones(SHAPE, bool)
    occupied[23:37, 33:47] = False  # 0.7 m each way: room to turn, hardly any to drive
    clear = clearance_of(occupied, ORIGIN, RESOLUTION)
    poses, commands, _ = drive(clear, [0.0, 0.0, -0.1 * np.sign(turn)], [0.7, 0.0], 30, twist=(0.0, turn))
    assert np.abs(poses[:, 2]).max() < 0.1 + 1.5 * turn**2 / (2 * ROBOT.alpha_max) + 0.2, "no farther than it must"
    assert np.abs(poses[-1, 2]) < 0.2 and np.abs(commands[-1, 1]) < 0.1


def test_seeking_room_leads_out_of_a_squeeze(clearance_of):
    occupied = np.zeros(SHAPE, bool)
    occupied[:, :40] = True  # the wall ends at x = 0
    clear = clearance_of(occupied, ORIGIN, RESOLUTION)
    for yaw in (0.0, np.pi, 1.5):
        poses, _, _ = drive(clear, [0.2, 0.3, yaw], [0.2, 0.3], 25, seek_room=True)
        room = room_of(clear, poses)
        assert room[0] < LIMIT - 0.05, "it begins in a squeeze"
        assert room.min() >= room[0] - tracker.DIP - BETWEEN and room[-1] > room[0] + 0.03


def test_the_spec_is_checked():
    for wrong in ({"num_speeds": 0}, {"samples": 0}, {"dt": 0.0}):
        with pytest.raises(ValueError, match="must be >= 1 and dt > 0"):
            TrackerSpec(**wrong)


def test_one_trace_and_a_batch_equals_single_calls(clutter):
    once = jax.jit(chex.assert_max_traces(tracker.track.__wrapped__, n=1), static_argnames="spec")
    pose, twist, target = random_states(3, clutter)
    no = jnp.asarray(False)
    many = track_all(SPEC, PARAMS, ROBOT, clutter, pose, twist, target, jnp.zeros(STATES, bool))
    for k in range(12):
        robot = ROBOT._replace(v_max=f32(ROBOT.v_max))
        params, where = PARAMS._replace(heading=f32(1.0)), [f32(a[k]) for a in (pose, twist, target)]
        one = once(SPEC, params, robot, clutter, *where, no)
        assert bool(one.certified) == bool(many.certified[k])
        np.testing.assert_allclose(one.command, [many.command.v[k], many.command.omega[k]], atol=1e-5)
