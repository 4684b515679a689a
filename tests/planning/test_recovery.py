"""The rules of semantic recovery: when it begins, what it does, and that it ends."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.planning import recovery
from drnav_jax.planning.recovery import CLEAR, DRIVE, RETREAT, STOP, RecoveryParams
from drnav_jax.types import GridSpec

SPEC = GridSpec(shape=(24, 32), resolution=0.25)
ORIGIN = np.array([-4.0, -3.0], np.float32)
PARAMS = RecoveryParams()
DT = 0.1

update = jax.jit(recovery.update.__wrapped__, static_argnames="spec")


def f32(values):
    return jnp.asarray(values, jnp.float32)


class Run:
    """The state machine under test, ticked on a made-up robot."""

    def __init__(self, xy=(0.0, 0.0), params=PARAMS):
        self.params, self.time, self.xy = params, 0.0, np.array(xy, np.float32)
        self.state = recovery.init(SPEC, f32(xy))
        self.modes = []  # [(mode, ticks it lasted)]

    def tick(self, xy=None, free=True, way=True, refuge=(2.0, 0.0), has_refuge=True, risky=False, ahead=(1.0, 1.0)):
        before = self.xy
        self.xy = self.xy if xy is None else np.array(xy, np.float32)
        self.state = self.state._replace(refuge=f32(refuge), has_refuge=jnp.asarray(has_refuge))
        self.state = update(
            spec=SPEC, params=self.params, state=self.state, time=f32(self.time), dt=DT, xy=f32(self.xy),
            driven=f32(np.hypot(*(self.xy - before))), origin=f32(ORIGIN), candidate_free=jnp.asarray(free),
            has_way=jnp.asarray(way), risky=jnp.asarray(risky), ahead=f32(ahead),
        )  # fmt: skip
        self.time += DT
        if self.modes and self.modes[-1][0] == self.mode:
            self.modes[-1][1] += 1
        else:
            self.modes.append([self.mode, 1])
        return self.mode

    @property
    def mode(self):
        return int(self.state.mode)

    def until(self, mode, limit=400, **kwargs):
        """Seconds until `mode` is reached."""
        begin = self.time
        for _ in range(limit):
            if self.tick(**kwargs) == mode:
                return self.time - begin
        raise AssertionError(f"mode {mode} was not reached: {self.modes}")


def visit(state, x, y):
    return float(state.visits[int((y - ORIGIN[1]) / 0.25), int((x - ORIGIN[0]) / 0.25)])


def test_driving_on_is_no_reason():
    run = Run()
    for k in range(300):
        assert run.tick(xy=(0.05 * k, 0.0), way=True) == DRIVE
    assert int(run.state.entries) == 0


@pytest.mark.parametrize("reason", ["stands", "circles", "blocked"])
def test_it_begins_when_the_robot_is_stuck(reason):
    run = Run()
    if reason == "stands":
        assert run.until(CLEAR) == pytest.approx(PARAMS.stuck_time, abs=3 * DT)
    elif reason == "blocked":
        assert run.until(CLEAR, free=False) == pytest.approx(PARAMS.blocked_time, abs=3 * DT)
    else:  # it moves, but stays within the large circle
        for k in range(250):
            angle = 0.08 * k
            if run.tick(xy=(0.8 * np.cos(angle), 0.8 * np.sin(angle))) == CLEAR:
                break
        assert run.time == pytest.approx(PARAMS.circle_time, abs=2.0)
    assert int(run.state.entries) == int(run.state.attempts) == 1
    assert run.until(DRIVE) == pytest.approx(PARAMS.clear_time, abs=2 * DT)


def test_at_a_blocked_moment_it_does_not_begin():
    run = Run()
    for k in range(200):
        assert run.tick(xy=(0.05 * k, 0.0), free=k % 10 == 0) == DRIVE


def test_the_second_attempt_retreats():
    run = Run()
    run.until(CLEAR)
    run.until(DRIVE)
    run.until(CLEAR)
    assert int(run.state.attempts) == 2
    assert run.until(RETREAT, refuge=(2.0, 1.0)) == pytest.approx(PARAMS.clear_time, abs=2 * DT)
    np.testing.assert_allclose(run.state.target, [2.0, 1.0])
    # another refuge that becomes better meanwhile is not swung to
    run.tick(refuge=(-3.0, 0.0))
    np.testing.assert_allclose(run.state.target, [2.0, 1.0])


def test_without_a_refuge_it_drives_on():
    run = Run()
    for _ in range(3):
        run.until(CLEAR, has_refuge=False)
        run.until(DRIVE, has_refuge=False)
    assert RETREAT not in [m for m, _ in run.modes]


def retreating():
    run = Run()
    run.until(CLEAR)
    run.until(DRIVE)
    run.until(CLEAR)
    run.until(RETREAT)
    return run


def test_a_retreat_ends_on_arrival_in_time_or_without_a_way():
    run = retreating()
    for _ in range(20):
        assert run.tick(xy=(1.2, 0.0)) == RETREAT
    assert run.tick(xy=(1.6, 0.0)) == DRIVE
    assert retreating().until(DRIVE) == pytest.approx(PARAMS.retreat_time, abs=3 * DT)
    assert retreating().until(DRIVE, way=False) == pytest.approx(1.0, abs=3 * DT)


def test_visits_are_stamped_on_the_second_attempt_and_decay():
    run = Run()
    run.until(CLEAR)
    assert float(run.state.visits.max()) == 0.0
    run.until(DRIVE)
    run.until(CLEAR)
    assert visit(run.state, 0.1, 0.1) == 1.0 == float(run.state.visits.max())
    assert visit(run.state, 2.0, 0.0) == 0.0
    x, y = np.meshgrid((np.arange(32) + 0.5) * 0.25 + ORIGIN[0], (np.arange(24) + 0.5) * 0.25 + ORIGIN[1])
    np.testing.assert_array_equal(np.asarray(run.state.visits) > 0, np.hypot(x, y) <= PARAMS.visit_radius)
    for k in range(100):
        run.tick(xy=(9.0 + k, 0.0))  # far away it only decays
    assert visit(run.state, 0.1, 0.1) == pytest.approx(np.exp(-10.0 / PARAMS.visit_time), rel=1e-3)


def test_driving_leaves_a_faint_visit():
    run = Run((-3.0, 0.0), PARAMS._replace(visit_time=1e6))
    for k in range(121):
        run.tick(xy=(-3.0 + 0.05 * k, 0.0))
    across = 2 * PARAMS.visit_radius  # driven while a point is within the radius
    assert visit(run.state, 0.1, 0.1) == pytest.approx(PARAMS.visit_driven * across, rel=0.05)
    assert visit(run.state, 0.1, 2.0) == 0.0
    for k in range(1200):
        run.tick(xy=(0.5 * np.sin(0.5 * k), 0.0))
    assert float(run.state.visits.max()) == 1.0


def test_attempts_are_forgotten_only_far_from_where_they_began():
    run = Run()
    for n in range(1, 5):
        run.until(CLEAR, has_refuge=False, xy=(0.25 * (n % 2), 0.0))
        assert int(run.state.attempts) == n
        run.until(DRIVE, has_refuge=False)
    run.tick(xy=(2.9, 0.0))
    assert int(run.state.attempts) == 4
    run.tick(xy=(3.3, 0.0))
    assert int(run.state.attempts) == 0
    np.testing.assert_allclose(run.state.place, [0.25, 0.0])
    run.until(CLEAR)
    np.testing.assert_allclose(run.state.place, [3.3, 0.0])


def test_a_robot_that_never_moves_does_not_flicker():
    """Every mode lasts as long as its rule says, attempts grow, and retreats go on."""
    run = Run()
    for _ in range(1500):
        run.tick()
    inner = run.modes[:-1]
    least = {DRIVE: PARAMS.stuck_time, CLEAR: PARAMS.clear_time, RETREAT: PARAMS.retreat_time}
    assert all(n * DT >= least[m] - 2 * DT for m, n in inner)
    assert [m for m, _ in inner[:7]] == [DRIVE, CLEAR, DRIVE, CLEAR, RETREAT, DRIVE, CLEAR]
    assert int(run.state.attempts) == int(run.state.entries) == sum(m == CLEAR for m, _ in run.modes) > 4


def test_at_random_every_rule_holds():
    """Whatever the inputs: modes are the four, `since` is when the mode began, visits stay in 0..1."""
    rng = np.random.default_rng(0)
    run, xy = Run(), np.zeros(2)
    seen = set()
    for _ in range(1500):
        calm = rng.random() < 0.5
        xy = xy + (0 if calm else rng.normal(0, 0.1, 2))
        before, began = run.mode, float(run.state.since)
        run.tick(xy=xy, free=rng.random() < 0.2, way=rng.random() < 0.02, has_refuge=rng.random() < 0.7,
                 refuge=rng.uniform(-3, 3, 2))  # fmt: skip
        seen.add(run.mode)
        assert float(run.state.since) == pytest.approx(run.time - DT if run.mode != before else began, abs=1e-3)
        if before == CLEAR and run.mode != CLEAR:
            assert run.time - DT - began >= PARAMS.clear_time - DT
        assert 0 <= float(run.state.visits.min()) and float(run.state.visits.max()) <= 1
    assert seen == {DRIVE, CLEAR, RETREAT, STOP}


def test_hopeless_it_stops_and_a_way_sets_it_going():
    run = Run()
    for k in range(99):
        assert run.tick(xy=(0.05 * k, 0.0), way=False) == DRIVE
    assert run.until(STOP, way=False, limit=40) < 1.0
    for _ in range(50):
        assert run.tick(way=False) == STOP
    assert run.tick(way=True) == DRIVE
    for _ in range(40):  # and what came before is no reason to begin at once
        assert run.tick(way=False) == DRIVE


def test_waiting_is_not_being_stuck():
    run = Run()
    for _ in range(600):
        run.state = recovery.wait(run.state, f32(run.time), jnp.asarray(True))
        assert run.tick(free=False, way=False) == DRIVE
    assert run.until(CLEAR) == pytest.approx(PARAMS.stuck_time, abs=3 * DT), "then the clocks begin"


def test_it_turns_back_before_what_it_takes_for_a_dead_end():
    run = Run()
    for k in range(30):  # risky now and then, as one false alarm makes it: drive on
        assert run.tick(xy=(0.1 * k - 3, 0.0), risky=k % 5 != 4) == DRIVE
    assert not bool(recovery.looking(run.state, f32(run.time - DT))), "calm: nothing to rank"
    run.tick(xy=(0.1, 0.0), risky=True)
    assert bool(recovery.looking(run.state, f32(run.time - DT)))
    assert run.until(RETREAT, xy=(0.1, 0.0), risky=True, ahead=(3.0, 1.0), refuge=(-2.0, 1.0)) < PARAMS.risky_time + 3 * DT
    assert [m for m, _ in run.modes] == [DRIVE, RETREAT], "no clearing: it is not stuck"
    np.testing.assert_allclose(run.state.target, [-2.0, 1.0])
    assert visit(run.state, 3.0, 1.0) == 1.0 and visit(run.state, 0.1, 0.1) < 1.0, "what lies ahead is what is avoided"


def test_without_a_refuge_a_risky_way_is_taken():
    run = Run()
    for k in range(60):
        assert run.tick(xy=(0.1 * k - 3, 0.0), risky=True, has_refuge=False) == DRIVE


def test_one_trace_and_a_batch_equals_single_calls():
    once = jax.jit(chex.assert_max_traces(recovery.update.__wrapped__, n=1), static_argnames="spec")

    def args(k):
        return dict(
            state=recovery.init(SPEC, f32([0, 0])), time=f32(3.0 * k), dt=f32(0.1), xy=f32([0.2 * k, 0]),
            driven=f32(0.1 * k), origin=f32(ORIGIN), candidate_free=jnp.asarray(k == 1), has_way=jnp.asarray(k != 2),
            risky=jnp.asarray(False), ahead=f32([1, 1]), params=PARAMS._replace(stuck_time=f32(4.0 + k)),
        )  # fmt: skip

    one = [once(SPEC, **args(k)) for k in range(3)]
    batch = jax.tree.map(lambda *a: jnp.stack([jnp.asarray(x) for x in a]), *[args(k) for k in range(3)])
    many = jax.vmap(lambda a: update(SPEC, **a))(batch)
    chex.assert_trees_all_close(jax.tree.map(lambda *a: jnp.stack(a), *one), many, atol=1e-6)
    assert [int(s.mode) for s in one] == [DRIVE, DRIVE, CLEAR]
