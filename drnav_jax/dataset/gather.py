"""The frames of one shard, from its number alone: worlds, truth, plans, drives, sensors, labels.

What is random - sensors, mounts, loads, plans - is drawn from (seed of the dataset, number of the shard, number of the
world), so that a shard is the same whatever was made before it.
"""

import dataclasses
import math
import zlib
from typing import Any

import jax
import numpy as np

from drnav_jax import worlds
from drnav_jax.dataset import collect, routes
from drnav_jax.dataset.behaviours import KINDS
from drnav_jax.dataset.collect import Sensors
from drnav_jax.dataset.frames import STRATUM_BITS, Frame, FrameSpec
from drnav_jax.dataset.shards import DatasetSpec, checked, pairs
from drnav_jax.sim import CameraParams, mjx
from drnav_jax.sim.lidar import LidarParams
from drnav_jax.types import Mount, RigSpec, RobotParams, rig_of
from drnav_jax.worlds import Scene, World, strata
from drnav_jax.worlds.frames import frames
from drnav_jax.worlds.litter import charted, littered
from drnav_jax.worlds.truth import GroundTruth, interior, truth

ROWS = 64  # solids of a shard's worlds are padded to a multiple of this, so that shards share programs
CHARTS = (256, 384, 512, 1024)  # cells along an edge that grids are padded to
SHORT = 0.35  # share of worlds whose LiDAR sees less far than 12 m
OTHER = 500_000  # beyond the seeds of `pairs`: the second world of a family that has no twin


def _pair(data: DatasetSpec, family: str, seed: int) -> tuple[list[Scene], list[Scene]]:
    """A closed world and its open twin (of a family without twins two worlds), as driven in and as sensed.

    Grids are driven in as the solids that they were made from: few added cells stand where a robot comes by.
    """
    opened = worlds.twin(family)
    plain = [worlds.sample(family, seed, data.split)]
    plain.append(worlds.sample(opened or family, seed if opened else seed + OTHER, data.split))
    rng = np.random.default_rng(np.random.SeedSequence([data.seed, seed, zlib.crc32(family.encode())]))
    share = rng.random()
    groups = [plain] if opened else [[scene] for scene in plain]
    if share < data.charted:
        return plain, [scene for group in groups for scene in charted(group, rng)]
    if share < data.charted + data.litter:
        plain = [scene for group in groups for scene in littered(group, rng)]
    return plain, plain


def _mount(mount: Mount, rng: np.random.Generator) -> Mount:
    """A camera that was not mounted quite as planned; it stays level, which is what the fast renderer draws."""
    return dataclasses.replace(
        mount,
        x=mount.x + rng.uniform(-0.06, 0.06), y=mount.y + rng.uniform(-0.06, 0.06), z=rng.uniform(0.35, 0.75),
        yaw=mount.yaw + math.radians(rng.uniform(-6, 6)), fov=mount.fov * rng.uniform(0.88, 1.1),
    )  # fmt: skip


def _sensors(spec: FrameSpec, rng: np.random.Generator) -> Sensors:
    rig = RigSpec(tuple(_mount(m, rng) for m in spec.rig.mounts), spec.rig.shape)
    lidar = LidarParams(
        max_range=rng.uniform(5.0, 12.0) if rng.random() < SHORT else 12.0,
        noise_std=rng.uniform(0.01, 0.03), dropout=rng.uniform(0.0, 0.05), height=rng.uniform(0.4, 0.6)
    )  # fmt: skip
    return Sensors(
        lidar=lidar if spec.lost is None else lidar._replace(dropout=spec.lost),
        camera=CameraParams(noise_std=rng.uniform(0.005, 0.03), blur=rng.uniform(0.0, 0.15)),
        rig=rig_of(rig),
    )


def shard(data: DatasetSpec, spec: FrameSpec, number: int) -> Frame:
    """All frames of a shard, world after world.

    Args:
        data: The dataset.
        spec: Sensors and grid.
        number: Of the shard.
    """
    chosen = pairs(data, number)
    made = [_pair(data, family, seed) for family, seed, _ in chosen]
    twins = [sensed for _, sensed in made]
    truths = [(truth(a), truth(b)) for a, b in twins]
    twin_of = [worlds.twin(family) is not None for family, _, _ in chosen]
    scenes = [scene for pair in twins for scene in pair]
    roads = [scene for driven, _ in made for scene in driven]
    rngs = [np.random.default_rng(np.random.SeedSequence([data.seed, number, k])) for k in range(data.num_worlds)]

    plans = []
    for k, scene in enumerate(scenes):
        n = k // 2
        (a, b), kind = truths[n], chosen[n][2]
        pockets = a.label | b.label if twin_of[n] else truths[n][k % 2].label
        plans.append(routes.draw(scene, pockets, kind, int(rngs[k].integers(1 << 31))))
    key = jax.random.fold_in(jax.random.key(data.seed), number)
    drive_key, load_key, sense_key = jax.random.split(key, 3)
    bodies = jax.vmap(lambda k: mjx.uniform(k, *collect.BODIES))(jax.random.split(load_key, data.num_worlds))
    faults = jax.vmap(lambda k: mjx.uniform(k, *collect.FAULTS))(jax.random.split(load_key, data.num_worlds))
    stacked = worlds.stack_worlds([scene.world for scene in roads], multiple_of=ROWS)
    poses = collect.drive(
        data.per_world * data.ticks, KINDS, RobotParams(), stacked, mjx.solids_of([scene.world for scene in roads]),
        jax.tree.map(lambda *a: np.stack(a), *plans), bodies, faults, drive_key,
    )  # fmt: skip
    parts = []
    for k, scene in enumerate(scenes):
        chart = scene.world.field.values.size > 0
        world = _padded(scene.world) if chart else jax.tree.map(lambda a, k=k: a[k], stacked)
        sensed = collect.sense(
            spec, data.ticks, world, _sensors(spec, rngs[k]), poses[k], jax.random.fold_in(sense_key, k)
        )
        family, seed, kind = chosen[k // 2]
        about = {
            "family": data.families.index(family), "behaviour": KINDS.index(kind), "closed": scene.closed,
            "seed": seed if twin_of[k // 2] or k % 2 == 0 else seed + OTHER,
            "strata": sum(bit for name, bit in STRATUM_BITS.items() if name in scene.strata),
        }  # fmt: skip
        a, b = truths[k // 2]
        inner = interior(a, b) if twin_of[k // 2] else None
        seen = strata.in_view(scene, np.asarray(sensed["pose"], np.float64))
        about["strata_seen"] = seen @ np.array(list(STRATUM_BITS.values()))
        parts.append(_joined(spec, jax.device_get(sensed), truths[k // 2][k % 2], inner, about))
    whole = Frame(*(np.concatenate(field) for field in zip(*parts, strict=True)))
    return Frame(**checked(whole, data.shard_size))


def _padded(world: World) -> World:
    """A grid's world on one of few sizes, so that worlds share programs."""
    h, w = world.field.values.shape
    size = min((n for n in CHARTS if n >= max(h, w)), default=max(h, w))
    values = np.pad(world.field.values, ((0, size - h), (0, size - w)), mode="edge")
    return world._replace(field=world.field._replace(values=values))


def _joined(
    spec: FrameSpec, sensed: dict[str, np.ndarray], true: GroundTruth, inner: np.ndarray | None, about: dict[str, Any]
) -> Frame:
    """What was sensed in one world, with what is true there."""
    labels = frames(true, sensed["pose"].astype(np.float64), spec.bev, interior=inner)
    count = len(sensed["pose"])
    constant = {name: np.broadcast_to(value, count) for name, value in about.items()}
    return Frame(
        **sensed, **constant,
        dead_end=labels.label, inside=labels.inside, valid=labels.mask, depth=labels.depth,
        traversable=labels.traversable, recoverability=labels.recoverability, interior=labels.interior & labels.mask,
        path=labels.path, path_stable=labels.path_stable, dead_end_flag=labels.dead_end,
        flag_stable=labels.dead_end_stable,
    )  # fmt: skip


