"""Routes, behaviours and `collect.drive`: does the robot that gathers frames go where it should?"""

import dataclasses
import functools
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax import worlds
from drnav_jax.dataset import behaviours, collect, routes
from drnav_jax.dataset.behaviours import KINDS
from drnav_jax.sim import mjx
from drnav_jax.sim.kinematic import FaultParams
from drnav_jax.sim.mjx import MjxParams
from drnav_jax.types import RobotParams
from drnav_jax.worlds.labels import dead_ends

FAMILIES = ("u", "t-open")
SEEDS = range(4)
TICKS = 240


@functools.cache
def scene_of(family, seed):
    scene = worlds.sample(family, seed, "train")
    closed = worlds.sample(family.removesuffix("-open"), seed, "train")
    return scene, dead_ends(closed.occupied, closed.resolution).label


def plan_from_the_start(family, kind, seed):
    """The first of the plans from `seed` on that begins where the scene does, as about half of them do."""
    scene, pocket = scene_of(family, seed)
    plans = (routes.draw(scene, pocket, kind, k) for k in itertools.count(100 * seed))
    return next(p for p in plans if kind in ("errand", "wall") or np.allclose(p.start[:2], scene.start[:2], atol=1e-5))


def drive(scenes, plans, seed):
    every = [scene.world for scene in scenes]
    body, faults = (jax.tree.map(lambda a: np.full(len(scenes), a, np.float32), p) for p in (MjxParams(), FaultParams()))
    return collect.drive(
        TICKS, KINDS, RobotParams(), worlds.stack_worlds(every), mjx.solids_of(every), plans, body, faults,
        jax.random.key(seed),
    )  # fmt: skip


@functools.cache
def everything():
    """Scenes and plans of all behaviours in four worlds of each family, one behaviour after the other."""
    what = [(family, kind, seed) for kind in KINDS for family in FAMILIES for seed in SEEDS]
    plans = [plan_from_the_start(*one) for one in what]
    return [scene_of(family, seed)[0] for family, _, seed in what], jax.tree.map(lambda *a: np.stack(a), *plans)


@functools.cache
def all_poses():
    scenes, plans = everything()
    poses = np.asarray(drive(scenes, plans, 0))
    assert np.isfinite(poses).all()
    return poses


def driven(family):
    """Poses `[kind, seed, T, 3]` in the worlds of a family, and gaps `[kind, seed]`."""
    f, shape = FAMILIES.index(family), (len(KINDS), len(FAMILIES), len(SEEDS))
    return all_poses().reshape(*shape, TICKS, 3)[:, f], everything()[1].gap.reshape(shape)[:, f]


def in_pocket(family, seed, poses):
    scene, pocket = scene_of(family, seed)
    cell = np.floor((poses[:, :2] - np.asarray(scene.origin)) / scene.resolution).astype(int)[:, ::-1]
    inside = np.all((cell >= 0) & (cell < np.asarray(pocket.shape)), axis=1)
    cell = np.clip(cell, 0, np.asarray(pocket.shape) - 1)
    return inside & pocket[cell[:, 0], cell[:, 1]]


@pytest.mark.long
@pytest.mark.parametrize("family", FAMILIES)
def test_a_tour_looks_into_dead_ends_and_comes_out_again(family):
    poses, _ = driven(family)
    been = [in_pocket(family, seed, poses[KINDS.index("tour"), seed]) for seed in SEEDS]
    assert sum(b.any() for b in been) >= 3
    assert sum(b.any() and not b[np.flatnonzero(b)[0] :].all() for b in been) >= 2


@pytest.mark.long
def test_reaching_for_the_goal_leads_into_the_trap():
    poses, _ = driven("u")
    been = [in_pocket("u", seed, poses[KINDS.index("reach"), seed]) for seed in SEEDS]
    assert sum(b.sum() > 20 for b in been) >= 3


@pytest.mark.long
def test_a_wall_is_followed_at_its_distance():
    poses, gaps = driven("t-open")
    k = KINDS.index("wall")
    for seed in SEEDS:
        scene, _ = scene_of("t-open", seed)
        gap = float(gaps[k, seed])
        path = poses[k, seed, 60:]
        assert abs(np.median(worlds.signed_distance(scene.world, path[:, :2])) - gap) < 0.2
        assert np.hypot(*np.diff(path[:, :2], axis=0).T).sum() > 6


@pytest.mark.long
@pytest.mark.parametrize("kind", ["tour", "errand", "wall"])
def test_they_keep_off_the_walls(kind):
    for family in FAMILIES:
        poses, _ = driven(family)
        for seed in SEEDS:
            room = worlds.signed_distance(scene_of(family, seed)[0].world, poses[KINDS.index(kind), seed, :, :2])
            assert room.min() > 0.25 - 0.02  # physics keeps them out


@pytest.mark.long
def test_the_same_key_is_the_same_drive_and_worlds_do_not_mind_each_other():
    scenes, plans = everything()
    np.testing.assert_array_equal(drive(scenes, plans, 0), all_poses())
    assert np.abs(np.asarray(drive(scenes, plans, 1)) - all_poses()).max() > 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_commands_are_within_the_limits(kind):
    robot = RobotParams()
    scene, pocket = scene_of("u", 0)
    plan = jax.tree.map(jnp.asarray, routes.draw(scene, pocket, kind, 1))
    world = jax.tree.map(jnp.asarray, scene.world)
    chex.clear_trace_counter()  # it counts by name, and this one is defined for each kind

    @jax.jit
    @chex.assert_max_traces(n=1)
    def step(memory, pose, twist, key):
        return behaviours.step(kind, robot, world, plan, memory, pose, twist, key)

    rng = np.random.default_rng(0)
    memory = jax.tree.map(jnp.asarray, jax.device_get(behaviours.begin(plan)))
    for k in range(60):
        pose = jnp.asarray([*rng.uniform(-8, 8, 2), rng.uniform(-3, 3)], jnp.float32)
        twist = jnp.asarray([rng.uniform(-0.2, 1.0), rng.uniform(-1.5, 1.5)], jnp.float32)
        memory, command = step(memory, pose, twist, jax.random.key(k))
        assert np.isfinite([command.v, command.omega]).all()
        assert robot.v_min - 1e-6 <= float(command.v) <= robot.v_max + 1e-6
        assert abs(float(command.omega)) <= robot.w_max + 1e-6
        assert 0 <= int(memory.at) < plan.points.shape[0]


@pytest.mark.parametrize("kind", KINDS)
def test_a_plan_is_drawn_by_its_seed(kind):
    scene, pocket = scene_of("t-open", 1)
    plan = routes.draw(scene, pocket, kind, 5)
    chex.assert_trees_all_equal(plan, routes.draw(scene, pocket, kind, 5))
    assert not np.array_equal(plan.speed, routes.draw(scene, pocket, kind, 6).speed)
    assert plan.points.shape == (routes.NUM_POINTS, 2) and plan.points.dtype == np.float32
    if kind in ("tour", "errand"):
        room = worlds.signed_distance(scene.world, plan.points)
        assert room.min() >= routes.CLEARANCE - 0.02
        assert np.hypot(*np.diff(plan.points, axis=0).T).max() < 2 * routes.SPACING


def test_half_of_the_drives_begin_elsewhere_not_far_from_a_dead_end():
    scene, pocket = scene_of("u", 0)
    starts = np.stack([routes.draw(scene, pocket, "reach", k).start for k in range(24)])
    elsewhere = np.abs(starts - np.asarray(scene.start)).max(axis=1) > 1e-5
    assert 6 <= elsewhere.sum() <= 18
    assert worlds.signed_distance(scene.world, starts[elsewhere, :2]).min() >= routes.CLEARANCE - 0.02
    dead = np.asarray(scene.origin) + (np.argwhere(pocket)[:, ::-1] + 0.5) * scene.resolution
    away = np.linalg.norm(starts[elsewhere, None, :2] - dead, axis=-1).min(axis=1)
    assert away.max() <= routes.AROUND and away.min() < 1.0 < away.max()


def test_what_cannot_be_planned_is_refused():
    scene, pocket = scene_of("u", 0)
    with pytest.raises(ValueError, match='no behaviour "dance".*tour, errand'):
        routes.draw(scene, pocket, "dance", 0)
    with pytest.raises(ValueError, match="start and a goal"):
        routes.draw(dataclasses.replace(scene, goal=None), pocket, "tour", 0)
