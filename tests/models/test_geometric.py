"""Dead ends from geometry alone: pockets behind the robot's back, and nothing else."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from drnav_jax.models import geometric
from drnav_jax.models.geometric import GeometricParams
from drnav_jax.types import LocalMap, empty_observation

SHAPE, RESOLUTION = (64, 96), 0.1
ORIGIN = np.array([0.4, -3.2], np.float32)  # no cell's centre is the robot's place
PARAMS = GeometricParams()
FAR = (50.0, 0.0)

X, Y = np.meshgrid(
    ORIGIN[0] + (np.arange(SHAPE[1]) + 0.5) * RESOLUTION, ORIGIN[1] + (np.arange(SHAPE[0]) + 0.5) * RESOLUTION
)


def f32(values):
    return jnp.asarray(values, jnp.float32)


def believed(free, seen, origin=ORIGIN):
    occupancy = np.where(seen, np.where(free, -2.0, 2.0), 0.0)
    return LocalMap(f32(occupancy), jnp.asarray(seen), f32(origin), f32(RESOLUTION))


def predict(free, seen, pose=(5.0, 0.03, 0.0), goal=FAR, origin=ORIGIN, params=PARAMS):
    observation = empty_observation(0)._replace(pose=f32(pose), goal=f32(goal))
    evidence = geometric.predict(params, observation, believed(free, seen, origin))
    return np.asarray(evidence.p_dead), np.asarray(evidence.confidence)


def corridor(end=8.6):
    """A corridor of 1.4 m, seen from x = 1.6 on up to its end; and the walls beside it."""
    inside = (np.abs(Y) < 0.7) & (X > 1.6) & (X < end)
    seen = (np.abs(Y) < 0.9) & (X > 1.6) & (X < end + 0.2)
    return inside, seen


AHEAD = (np.abs(Y) < 0.3) & (X > 5.8) & (X < 8.1)
BEHIND = (np.abs(Y) < 0.3) & (X > 2.2) & (X < 4.2)


def test_the_end_of_a_corridor_seen_from_inside_is_a_dead_end():
    p, confidence = predict(*corridor())
    assert (p[AHEAD] == np.float32(PARAMS.p_dead)).all() and (confidence[AHEAD] > 0.7).all()
    assert (p[BEHIND] == np.float32(PARAMS.p_open)).all(), "there the known ends, and may go on"
    assert (confidence[BEHIND] <= PARAMS.open_confidence).all() and (confidence[BEHIND] > 0).all()


@pytest.mark.parametrize("way_out", ["unknown", "edge", "side", "goal"])
def test_no_dead_end_where_there_is_a_way_out(way_out):
    free, seen = corridor()
    goal = FAR
    if way_out == "unknown":  # what lies at its end has not been seen
        seen = seen & (X < 8.5)
    elif way_out == "edge":
        free, seen = corridor(end=99.0)
    elif way_out == "side":  # a door to a place not seen
        door = (np.abs(X - 7.5) < 0.6) & (Y > 0) & (Y < 0.9)
        free, seen = free | door, seen | door
    else:
        goal = (8.0, 0.1)
    p, confidence = predict(free, seen, goal=goal)
    assert (p[AHEAD] == np.float32(PARAMS.p_open)).all()
    assert (confidence[AHEAD] <= PARAMS.open_confidence).all()


def test_a_door_too_narrow_is_no_way_out():
    free, seen = corridor()
    door = (np.abs(X - 7.5) < 0.16) & (Y > 0) & (Y < 0.9)
    p, _ = predict(free | door, seen | door)
    assert (p[AHEAD] == np.float32(PARAMS.p_dead)).all()
    thin = PARAMS._replace(radius=0.02, margin=0.02)
    p, _ = predict(free | door, seen | door, params=thin)
    assert (p[AHEAD] == np.float32(PARAMS.p_open)).all()


def test_from_outside_a_pocket_one_can_go_around_it():
    """The robot does not cut off the far end of a hall: beside it there is a way."""
    free = (np.abs(Y) < 2.6) & (X > 1.6) & (X < 8.6)
    seen = (np.abs(Y) < 2.8) & (X > 1.6) & (X < 8.8)
    p, _ = predict(free, seen)
    assert (p[AHEAD] == np.float32(PARAMS.p_open)).all()


def test_where_nothing_is_known_nothing_is_said():
    nothing = np.zeros(SHAPE, bool)
    p, confidence = predict(nothing, nothing)
    assert (confidence == 0).all() and np.isfinite(p).all()
    free, seen = corridor()
    _, confidence = predict(free, seen)
    assert (confidence[~seen] == 0).all() and (confidence[~free] == 0).all()


def test_beyond_its_range_it_says_nothing():
    short = PARAMS._replace(range=2.0)
    free, seen = corridor()
    _, confidence = predict(free, seen, params=short)
    away = np.hypot(X - 5.0, Y - 0.03)
    assert (confidence[away > 2.2] == 0).all() and (confidence[AHEAD & (away < 1.8)] > 0.7).all()
    _, body = predict(free, seen)
    assert (body[away < PARAMS.body - 0.15] == 0).all(), "nor of the place where it stands"


def test_quarter_turns_turn_the_answer():
    rng = np.random.default_rng(0)
    free, seen = corridor()
    free = free & ~((rng.random(SHAPE) < 0.01) & (X < 4.0))
    seen = seen | (rng.random(SHAPE) < 0.3)
    pose, goal = np.array([5.03, 0.04, 0.3]), np.array([50.0, 7.0])
    p, confidence = predict(free, seen, pose, goal)
    assert len(np.unique(p)) == 2 and (confidence > 0.5).any()
    origin = ORIGIN.astype(np.float64)
    for turns in (1, 2, 3):
        # a quarter turn to the left about the window's corner: (x, y) -> (-y, x), with rows = y and columns = x
        h, w = free.shape
        low = np.array([-(origin[1] + h * RESOLUTION), origin[0]])
        free, seen, p, confidence = (np.rot90(a, -1).copy() for a in (free, seen, p, confidence))
        pose = np.array([-pose[1], pose[0], pose[2] + np.pi / 2])
        goal, origin = np.array([-goal[1], goal[0]]), low
        got_p, got_confidence = predict(free, seen, pose, goal, origin)
        np.testing.assert_array_equal(got_p, p, err_msg=f"{turns} turns")
        np.testing.assert_allclose(got_confidence, confidence, atol=1e-6)  # a share of 49 cells


def test_the_mean_around_a_cell_is_scipys():
    values = np.random.default_rng(0).random((11, 17))
    want = ndimage.uniform_filter(values, 7, mode="constant")
    np.testing.assert_allclose(geometric._box_mean(f32(values), 3), want, atol=1e-5)  # differences of sums up to 190


def test_one_trace_and_a_batch_equals_single_calls():
    once = jax.jit(chex.assert_max_traces(geometric.predict.__wrapped__, n=1))
    held = believed(*corridor())
    observe = lambda x: empty_observation(0)._replace(pose=jnp.stack([x, 0 * x, x]), goal=f32(FAR))  # noqa: E731
    places = f32([4.0, 5.0, 7.0])
    one = [once(PARAMS._replace(body=f32(0.5 + 0.1 * k)), observe(x), held) for k, x in enumerate(places)]
    predict = jax.vmap(lambda body, x: geometric.predict(PARAMS._replace(body=body), observe(x), held))
    many = predict(f32([0.5, 0.6, 0.7]), places)
    chex.assert_trees_all_close(jax.tree.map(lambda *a: jnp.stack(a), *one), many, atol=1e-6)
