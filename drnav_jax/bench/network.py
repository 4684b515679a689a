"""The fusion network: one answer alone, and in the tick of a robot that drives by it, on a recorded drive."""

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax import navigator, worlds
from drnav_jax.bench.drive import FAMILY, Drive, tick_times
from drnav_jax.models import fusion, network, weights
from drnav_jax.models.calibration import Calibration
from drnav_jax.models.network import NetworkSpec
from drnav_jax.models.weights import Trained
from drnav_jax.sim import CameraParams, render
from drnav_jax.types import RigSpec, rig_of

NUM_POINTS = 2880  # of the network's latency: 16 rings x 180


def installed() -> Trained:
    """The shipped network; random weights of the default one, which are as fast, where none is installed."""
    if weights.SHIPPED.is_file():
        return weights.load()
    spec = NetworkSpec()
    return Trained(spec, network.init(jax.random.key(0), spec), Calibration(), {}, "")


def latency(trained: Trained, repeats: int = 100, num_points: int = NUM_POINTS) -> dict[str, float]:
    """Times of one answer [ms]: three cameras, one scan, a batch of one frame.

    Args:
        trained: The network.
        repeats: Answers that are timed, after ten that are not.
        num_points: Of the scan.
    """
    rng = np.random.default_rng(0)
    inputs = network.example(trained.spec, RigSpec(), num_points)
    inputs = jax.device_put(inputs._replace(
        images=rng.random(inputs.images.shape, np.float32), image_valid=np.ones_like(inputs.image_valid),
        points=rng.uniform(-6, 6, inputs.points.shape).astype(np.float32), point_valid=np.ones_like(inputs.point_valid),
        local_map=rng.integers(0, 3, inputs.local_map.shape).astype(np.uint8),
    ))  # fmt: skip
    spent = []
    for _ in range(10 + repeats):
        begin = time.perf_counter()
        jax.block_until_ready(network.infer(trained.spec, trained.params, inputs))
        spent.append(1e3 * (time.perf_counter() - begin))
    counted = spent[10:]
    return {"median": float(np.median(counted)), "p95": float(np.percentile(counted, 95)), "max": float(np.max(counted))}


def fused(drive: Drive, trained: Trained, seed: int = 0) -> Drive:
    """The same drive of a robot that has cameras, and the network as its predictor.

    Args:
        drive: From `drive.record`, of the same seed.
        trained: The network.
        seed: Of the world.
    """
    world, rig = worlds.sample(FAMILY, seed).world, RigSpec()
    spec = dataclasses.replace(drive.spec, predictor=fusion.predictor(trained.spec))
    predictor: Any = fusion.params_of(trained, rule=drive.params.predictor)
    params = drive.params._replace(predictor=jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), predictor))
    observations, shown = [], None
    for k, seen in enumerate(drive.observations):
        if shown is None or k % spec.replan_every == 0:
            shown = render(rig, CameraParams(), world, rig_of(rig), seen.pose, jax.random.fold_in(jax.random.key(seed), k))
        observations.append(seen._replace(
            images=shown, image_valid=jnp.ones(len(rig.mounts), bool), rig=jax.tree.map(jnp.asarray, rig_of(rig))
        ))  # fmt: skip
    return Drive(spec, params, navigator.init(spec, params, observations[0].pose), observations, [])


def network_times(drive: Drive, warm_up: int, repeats: int) -> dict[str, Any]:
    """`network` and `tick_fusion`, times in ms.

    Args:
        drive: From `drive.record`.
        warm_up: First ticks that do not count.
        repeats: Answers of the network alone.
    """
    trained = installed()
    return {"network": latency(trained, repeats), "tick_fusion": tick_times(fused(drive, trained), warm_up)}
