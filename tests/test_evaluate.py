import dataclasses
import os
import signal

import numpy as np
import pytest

from drnav_jax import evaluate, worlds
from drnav_jax.sim.episode import EpisodeSpec

SPEC = EpisodeSpec(chunk_ticks=10)  # as the command line has it: one compiled program for both


def value(grid, xy):
    column, row = ((np.asarray(xy) - grid.origin) / grid.resolution).astype(int)
    return grid.values[row, column]


@pytest.mark.parametrize(
    "wrong",
    [
        {"planner": "nobody"}, {"predictor": "gut"}, {"robot_radius": 0.0}, {"max_speed": float("nan")},
        {"lidar_range": 50.0}, {"goal_tolerance": -1.0}, {"time_limit": 0.0}, {"horizon": 9.0},
        {"risk_weight": -1.0}, {"num_candidates": 10},
    ],
)  # fmt: skip
def test_setup_names_what_is_wrong(wrong):
    (name,) = wrong
    with pytest.raises(ValueError, match=name):
        evaluate.Setup(**wrong)


def test_the_risk_weight_reaches_all_who_price_risk():
    params = evaluate.params_of(evaluate.Setup(predictor="geometric", risk_weight=0.5))
    assert [params.score.risk_weight, params.route.risk_weight, params.follower.critics.exposure.weight] == [0.5] * 3


@pytest.mark.parametrize("predictor", ["none", "oracle"])
def test_parameters_of_another_predictor_are_refused(predictor):
    (trip,) = evaluate.prepare([worlds.sample("u", 0)], evaluate.Setup())
    setup = evaluate.Setup(predictor=predictor)
    with pytest.raises(ValueError, match=f"GeometricParams, {predictor} needs"):
        evaluate.episode_params([trip], setup, evaluate.NavParams())


def test_the_simulation_keeps_the_robots_time():
    (trip,) = evaluate.prepare([worlds.sample("u", 0)], evaluate.Setup())
    with pytest.raises(ValueError, match="must be the robot's"):
        evaluate.evaluate([trip], evaluate.Setup(), spec=EpisodeSpec(dt=0.05))


def test_time_limit_rule():
    scene = worlds.sample("u", 0)
    (trip,) = evaluate.prepare([scene], evaluate.Setup())
    assert trip.time_limit == pytest.approx(6 * trip.shortest) and trip.time_limit > 60
    (fast,) = evaluate.prepare([scene], evaluate.Setup(max_speed=2.5))
    assert fast.time_limit == 60.0 > 6 * fast.shortest / 2.5
    own = dataclasses.replace(scene, time_limit=100.0, goal_tolerance=1.0)
    (barn,) = evaluate.prepare([own], evaluate.Setup())
    assert (barn.time_limit, barn.goal_tolerance) == (100.0, 1.0)
    (asked,) = evaluate.prepare([own], evaluate.Setup(time_limit=7.0, goal_tolerance=0.3))
    assert (asked.time_limit, asked.goal_tolerance) == (7.0, 0.3)
    assert trip.goal_tolerance == 0.75


def test_prepare_refuses_what_cannot_be_driven():
    scene = worlds.sample("u", 0)
    a, b = np.asarray(scene.start[:2]), np.asarray(scene.goal)
    line = a + np.linspace(0, 1, 2000)[:, None] * (b - a)
    wall = line[np.argmax(worlds.signed_distance(scene.world, line) <= 0)]
    blocked = dataclasses.replace(scene, start=(float(wall[0]), float(wall[1]), 0.0))
    with pytest.raises(ValueError, match="the start .* nearest place"):
        evaluate.prepare([blocked], evaluate.Setup())


@pytest.mark.parametrize("seed", [0, 2, 5])
def test_labels_fill_the_pocket_and_leave_the_way_through(seed):
    scene = worlds.sample("u", seed)
    (trip,) = evaluate.prepare([scene], evaluate.Setup())
    labels = evaluate.label_map(trip, 0.25)
    a, b = np.asarray(scene.start[:2]), np.asarray(scene.goal)
    ahead = (b - a) / np.linalg.norm(b - a)
    line = a + np.linspace(0, 1, 2000)[:, None] * (b - a)
    wall = line[np.argmax(worlds.signed_distance(scene.world, line) <= 0)]  # the back of the pocket
    assert [value(labels, wall - d * ahead) for d in (0.4, 1.0, 2.0)] == [1, 1, 1]
    assert value(labels, a) == value(labels, b) == 0
    way = worlds.trip_cells(trip.path, scene.origin, float(labels.resolution))
    assert labels.values[way[:, 0], way[:, 1]].max() == 0
    opened = worlds.sample("u-open", seed)
    (through,) = evaluate.prepare([opened], evaluate.Setup())
    assert value(evaluate.label_map(through, 0.25), wall - 1.0 * ahead) == 0


def test_labels_on_a_finer_map_come_on_their_own_grid():
    occupied = np.ones((300, 300), bool)
    occupied[20:280, 20:280] = False
    occupied[130:150, 20:240] = True  # a wall; the way leads around its end
    scene = dataclasses.replace(
        worlds.sample("u", 0), name="room", occupied=occupied, origin=(-1.0, 2.0), resolution=0.05,
        world=worlds.from_grid(occupied, (-1.0, 2.0), 0.05), start=(1.0, 5.0, 0.0), goal=(1.0, 13.0),
        outside_is_free=False,
    )  # fmt: skip
    (trip,) = evaluate.prepare([scene], evaluate.Setup())
    labels = evaluate.label_map(trip, 0.25)
    assert float(labels.resolution) == pytest.approx(evaluate.LABEL_RESOLUTION)
    assert value(labels, scene.start[:2]) == value(labels, scene.goal) == 0


@pytest.mark.long
@pytest.mark.usefixtures("ctrl_c")
def test_an_interrupt_keeps_what_is_finished():
    trips = evaluate.prepare([worlds.sample("u", k) for k in (0, 1)], evaluate.Setup())
    trips = [trips[0]._replace(time_limit=1e4), trips[1]._replace(time_limit=1.0)]
    seen = []

    def progress(done):
        if done and 1 not in seen:
            os.kill(os.getpid(), signal.SIGINT)  # as Ctrl-C does it, once
        seen.append(done)

    setup = evaluate.Setup(planner="dwa")
    found = evaluate.evaluate(trips, setup, progress=progress, spec=SPEC)
    assert found.interrupted and found.kept == [1] and seen[-1] == 1
    assert [r["world"] for r in found.records] == ["u:1"] and found.summary["episodes"] == 1
    assert found.records[0]["timeout"] and found.records[0]["time_s"] == 1.0
    assert evaluate.times_to_goal(found) == {1: (1.0, False)}
    path = evaluate.path_driven(found.result, 1, trips[1].scene.start)
    assert path.shape == (11, 2) and np.allclose(path[0], trips[1].scene.start[:2])
    driven = np.hypot(*np.diff(path, axis=0).T).sum()
    assert driven == pytest.approx(found.records[0]["distance_m"], abs=1e-3)


def test_nothing_to_drive():
    with pytest.raises(ValueError, match="no trip"):
        evaluate.evaluate([], evaluate.Setup())


def nearer(scene, length):
    """The scene with its goal moved to where so much of the shortest way is driven [m]."""
    (trip,) = evaluate.prepare([scene], evaluate.Setup())
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(trip.path, axis=0), axis=1)))
    return dataclasses.replace(scene, goal=tuple(float(np.interp(length, along, trip.path[:, k])) for k in (0, 1)))


def whole_episodes(families, seeds, lanes, length=None):
    scenes = [worlds.sample(family, seed) for family in families for seed in seeds]
    if length is not None:
        scenes = [nearer(scene, length) for scene in scenes]
    trips = evaluate.prepare(scenes, evaluate.Setup())
    found = evaluate.evaluate(trips, evaluate.Setup(), spec=dataclasses.replace(SPEC, lanes=lanes))
    assert not found.interrupted and len(found.records) == len(scenes)
    return found.records


def agree(singles, batched, share):
    """Outcomes agree in all episodes, times within 2 % in `share` of them (a tie of floats may fall either way)."""
    for name in ("world", "success", "collision"):
        assert [r[name] for r in singles] == [r[name] for r in batched]
    assert all(r["success"] for r in singles)
    a, b = (np.array([r["time_s"] for r in records]) for records in (singles, batched))
    assert np.mean(np.abs(a - b) <= 0.02 * a) >= share


@pytest.mark.long
def test_an_episode_in_a_batch_goes_as_it_goes_alone():
    agree(whole_episodes(["u", "t"], [3], 1, length=4.5), whole_episodes(["u", "t"], [3], 2, length=4.5), 1.0)


@pytest.mark.slow
def test_many_episodes_in_a_batch_go_as_they_go_alone():
    families, seeds = ["u", "t", "l", "corridor", "open"], range(8)
    agree(whole_episodes(families, seeds, 1), whole_episodes(families, seeds, 8), 0.95)
