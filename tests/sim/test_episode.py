"""Episodes with a policy that just drives: bookkeeping, and that batching changes nothing."""

import signal
import time
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.sim import episode
from drnav_jax.sim.episode import EpisodeParams, EpisodeSpec, Policy
from drnav_jax.sim.kinematic import FaultParams
from drnav_jax.sim.lidar import LidarParams, LidarSpec
from drnav_jax.types import Command, RobotParams
from drnav_jax.worlds.world import make_world, stack_worlds

BEAMS = LidarSpec(rings=1, azimuths=9, elevation_min=0.0, elevation_max=0.0)
SPEC = EpisodeSpec(lidar=BEAMS, chunk_ticks=10, replan_every=5)
DT = SPEC.dt
ROUNDING = 1e-4  # [m] float32 over a few seconds


class Wish(NamedTuple):
    """The policy's parameters."""

    v: float
    omega: float
    noise: float


class Mind(NamedTuple):
    """The policy's state."""

    steps: jax.Array
    replans: jax.Array


def init(params, pose):
    del params, pose
    return Mind(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def step(params, state, observation, key, replan):
    ahead = observation.points[4, 0]  # the beam along +x
    state = Mind(state.steps + 1, state.replans + int(replan))
    v = params.v + params.noise * jax.random.normal(key)
    log = {"steps": state.steps, "replans": state.replans, "replan": jnp.asarray(replan), "ahead": ahead}
    return state, Command(v=v, omega=params.omega * jnp.ones(())), log


POLICY = Policy(init=init, step=step)

# A box of 1 m x 2 m whose face is at x = 2.5; the others are alone.
WALL = make_world(boxes=[[3.0, 0.0, 0.0, 0.5, 1.0, 0.0, 2.0]])
EMPTY = make_world()


def batch(rows):
    """Episodes out of (world, start, goal, v, omega, noise, time limit)."""
    count = len(rows)
    world, start, goal, v, omega, noise, limit = zip(*rows, strict=True)
    spread = lambda tree: jax.tree.map(lambda a: np.full(count, a, np.float32), tree)  # noqa: E731
    numbers = lambda a: np.asarray(a, np.float32)  # noqa: E731
    return EpisodeParams(
        world=stack_worlds(list(world)), start=numbers(start), goal=numbers(goal), time_limit=numbers(limit),
        goal_tolerance=np.full(count, 0.3, np.float32), robot=spread(RobotParams()),
        policy=Wish(numbers(v), numbers(omega), numbers(noise)), lidar=spread(LidarParams()),
        faults=spread(FaultParams()),
    )  # fmt: skip


def keys(count, seed=0):
    return jax.random.split(jax.random.key(seed), count)


ROWS = [
    (EMPTY, (0, 0, 0), (2.0, 0), 1.0, 0.0, 0.0, 60.0),  # arrives
    (WALL, (0, 0, 0), (6.0, 0), 1.0, 0.0, 0.0, 60.0),  # drives into the box
    (WALL, (3.0, 0.5, 1.0), (6.0, 0), 0.0, 0.0, 0.0, 60.0),  # begins inside it
    (EMPTY, (0, 0, 0), (-5.0, 0), 0.5, 0.0, 0.0, 2.0),  # runs out of time, going the wrong way
    (WALL, (0, -3.0, 0), (9.0, -3.0), 0.8, 0.0, 0.3, 4.0),  # passes beside it, unsteadily
]
ARRIVES, HITS, INSIDE, LATE, PASSES = range(5)


@pytest.fixture(scope="module")
def params():
    return batch(ROWS)


@pytest.fixture(scope="module")
def result(params):
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        return episode.run(SPEC, POLICY, params, keys(5))


def ticks(result, k):
    return int(result.log.active[k].sum())


def test_every_episode_ends_as_it_must(result):
    state = result.state
    np.testing.assert_array_equal(state.success, [True, False, False, False, False])
    np.testing.assert_array_equal(state.collision, [False, True, True, False, False])
    assert result.finished.all() and not state.active.any()
    np.testing.assert_array_equal(state.tick, [ticks(result, k) for k in range(5)])
    assert state.policy is None


def test_arriving_takes_as_long_as_the_way_is(result):
    # 0.25, 0.5, 0.75, 1, 1, ... m/s: 0.15 m are lost while it speeds up; it has arrived 0.3 m before the goal
    assert ticks(result, ARRIVES) == np.ceil((2.0 - 0.3 + 0.15) / DT)
    assert result.state.distance[ARRIVES] == pytest.approx(result.state.pose[ARRIVES, 0], abs=ROUNDING)
    assert result.state.min_clearance[ARRIVES] > 1e5 and result.state.retreat[ARRIVES] == 0


def test_a_collision_is_where_the_footprint_meets_the_box(result):
    x = result.state.pose[HITS, 0] + 0.25
    assert 2.5 < x <= 2.5 + 0.1 + ROUNDING and result.log.pose[HITS, ticks(result, HITS) - 2, 0] + 0.25 <= 2.5
    assert result.state.min_clearance[HITS] == pytest.approx(2.5 - x, abs=ROUNDING)


def test_beginning_in_contact_is_a_collision_at_once(result):
    assert ticks(result, INSIDE) == 1
    assert result.state.min_clearance[INSIDE] == pytest.approx(-0.5 - 0.25, abs=ROUNDING)  # deepest: half a metre


def test_the_time_limit_ends_it(result):
    assert ticks(result, LATE) == 2.0 / DT
    driven = 0.5 * 2.0 - 0.025
    assert result.state.distance[LATE] == pytest.approx(driven, abs=ROUNDING)
    assert result.state.retreat[LATE] == pytest.approx(driven, abs=ROUNDING)
    assert ticks(result, PASSES) == 4.0 / DT


def test_clearance_is_measured_to_the_truth(result):
    path = result.log.pose[PASSES][result.log.active[PASSES]]
    beyond = np.maximum(np.abs(path[:, :2] - [3.0, 0.0]) - [0.5, 1.0], 0.0)
    room = np.hypot(*beyond.T).min() - 0.25
    assert result.state.min_clearance[PASSES] == pytest.approx(room, abs=0.01)  # it is also looked at in mid-tick


def test_what_is_over_stays_as_it_was(result):
    for k in range(5):
        n = ticks(result, k)
        active, pose = result.log.active[k], result.log.pose[k]
        assert active[:n].all() and not active[n:].any()
        np.testing.assert_array_equal(pose[n - 1], result.state.pose[k])
        rest = pose[n : -(-n // 10) * 10]  # to the end of its last chunk
        np.testing.assert_array_equal(rest, np.broadcast_to(pose[n - 1], rest.shape))


def test_logs_are_padded_to_the_longest(result):
    length = result.log.active.shape[1]
    assert length == 40 == ticks(result, PASSES)
    assert all(a.shape[:2] == (5, length) for a in jax.tree.leaves(result.log))
    assert not result.log.pose[INSIDE, 10:].any(), "chunks that were never run"
    np.testing.assert_array_equal(result.log.policy["steps"][PASSES], np.arange(1, 41))


def test_it_replans_every_fifth_tick(result):
    replan = result.log.policy["replan"][PASSES]
    np.testing.assert_array_equal(np.flatnonzero(replan), np.arange(0, 40, 5))
    assert result.log.policy["replans"][PASSES, -1] == 8


def test_the_policy_sees_the_world(result):
    ahead = result.log.policy["ahead"]
    assert ahead[HITS, 0] == pytest.approx(2.5, abs=0.1) and ahead[LATE, 0] > 11


def outcome(result):
    s = result.state
    return s.success, s.collision, s.tick, result.finished


LONG = pytest.mark.long


@pytest.mark.parametrize(
    ("lanes", "workers"), [(1, 7), pytest.param(2, 1, marks=LONG), pytest.param(8, 2, marks=LONG)]
)
def test_neither_lanes_nor_workers_change_a_result(params, result, lanes, workers):
    spec = EpisodeSpec(lidar=SPEC.lidar, chunk_ticks=10, replan_every=5, lanes=lanes)
    other = episode.run(spec, POLICY, params, keys(5), workers=workers)
    chex.assert_trees_all_equal(outcome(other), outcome(result))
    np.testing.assert_allclose(other.state.pose, result.state.pose, atol=1e-5)  # other programs round otherwise
    np.testing.assert_array_equal(other.log.active, result.log.active)
    for k in range(5):
        n = ticks(result, k)
        np.testing.assert_allclose(other.log.pose[k, :n], result.log.pose[k, :n], atol=1e-5)
        np.testing.assert_array_equal(other.log.policy["steps"][k, :n], result.log.policy["steps"][k, :n])


@pytest.mark.long
@pytest.mark.parametrize(("chunk", "every"), [(20, 2)])
def test_nor_do_chunks(params, result, chunk, every):
    spec = EpisodeSpec(lidar=SPEC.lidar, chunk_ticks=chunk, replan_every=every)
    other = episode.run(spec, POLICY, params, keys(5))
    chex.assert_trees_all_equal(outcome(other), outcome(result))
    assert other.log.policy["replans"][PASSES].max() == 40 // every


def test_the_same_keys_give_the_same_episode_and_others_do_not(params, result):
    again = episode.run(SPEC, POLICY, params, keys(5))
    chex.assert_trees_all_equal(again.log.pose, result.log.pose)
    other = episode.run(SPEC, POLICY, params, keys(5, seed=1))
    assert (other.state.pose[PASSES] != result.state.pose[PASSES]).any()
    np.testing.assert_array_equal(other.state.pose[LATE], result.state.pose[LATE])


def test_a_replay_is_the_episode_again(params, result):
    one = jax.tree.map(lambda a: a[PASSES], params)
    states = list(episode.replay(SPEC, POLICY, one, keys(5)[PASSES]))
    assert len(states) == 5 and [int(s.tick) for s in states] == [0, 10, 20, 30, 40]
    np.testing.assert_allclose(states[-1].pose, result.state.pose[PASSES], atol=1e-5)
    assert int(states[-1].policy.steps) == 40
    np.testing.assert_allclose(states[1].pose, result.log.pose[PASSES, 9], atol=1e-5)


@pytest.mark.usefixtures("ctrl_c")
def test_an_interrupt_keeps_what_is_finished():
    rows = [ROWS[INSIDE], (EMPTY, (0, 0, 0), (1e6, 0), 1.0, 0.0, 0.0, 1e6)]
    counts = []

    def progress(done):
        counts.append(done)
        if len(counts) == 5:  # let the main thread come to wait
            time.sleep(0.3)
            signal.raise_signal(signal.SIGINT)

    result = episode.run(SPEC, POLICY, batch([rows[0]] * 2 + [rows[1]] * 4), keys(6), workers=2, progress=progress)
    np.testing.assert_array_equal(result.finished, [True, True, False, False, False, False])
    assert result.state.collision[:2].all() and max(counts) == 2
    assert (result.state.tick[2:4] > 0).all(), "under way"
    assert (result.state.tick[4:] == 0).all() and not result.log.active[4:].any(), "not begun"


def test_an_error_ends_the_run():
    def broken(*args):
        jax.debug.callback(lambda: (_ for _ in ()).throw(OSError("no disk")))
        return step(*args)

    counts = []
    with pytest.raises(Exception, match="no disk"):
        episode.run(SPEC, Policy(init, broken), batch([ROWS[ARRIVES]] * 9), keys(9), progress=counts.append)
    assert len(counts) < 9


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"dt": 0.0}, "dt must be > 0 s, got 0.0"),
        ({"chunk_ticks": 12}, "multiple of replan_every >= 1, got 12 and 5"),
        ({"replan_every": 0}, "multiple of replan_every"),
        ({"lanes": 0}, "lanes must be >= 1"),
    ],
)
def test_the_spec_is_checked(wrong, message):
    with pytest.raises(ValueError, match=message):
        EpisodeSpec(**wrong)


def test_one_trace_for_all_chunks_and_parameters(params):
    calls = []

    def counted(*args):
        calls.append(args[-1])
        return step(*args)

    policy = Policy(init=init, step=counted)
    episode.run(SPEC, policy, params, keys(5), workers=1)
    before = len(calls)
    later = params._replace(time_limit=params.time_limit + 3, goal=params.goal + 1, start=params.start - 0.1)
    assert episode.run(SPEC, policy, later, keys(5, 3), workers=1).state.tick.max() > 50
    assert len(calls) == before > 0
