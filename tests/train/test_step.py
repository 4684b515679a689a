"""One step of training: the same on two devices as on one; a broken batch teaches nothing."""

import json
import subprocess
import sys
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec
from small_network import LEAST, batch, params_of

from drnav_jax.models import network
from drnav_jax.train.augment import AugmentParams, trimmed
from drnav_jax.train.spec import TrainSpec
from drnav_jax.train.step import TrainState, mesh_of, optimiser, stepper

ROOT = Path(__file__).resolve().parents[2]
TRAIN = TrainSpec(network=LEAST, steps=40, batch_size=4, warmup=2, learning_rate=1e-2, validate_every=3, save_every=3)
STEADY = TRAIN.__class__(**{**TRAIN.__dict__, "augment": AugmentParams(**dict.fromkeys(AugmentParams._fields, 0.0))})

pytestmark = pytest.mark.relaxed  # flax


def begun(count=1):
    """A state before the first step; each call has buffers of its own, since steps give theirs away."""
    params = params_of(LEAST)
    copy = jax.tree.map(jnp.array, params)
    state = TrainState(jnp.zeros((), jnp.int32), params, copy, optimiser(TRAIN).init(params))
    return jax.device_put(state, NamedSharding(mesh_of(jax.devices()[:count], 4), PartitionSpec()))


def host(tree):
    return jax.tree.map(np.array, tree)


@pytest.fixture(scope="module")
def step():
    """Compiled once for the whole file: a second trace of the network is an error."""
    before = network.apply
    network.apply = chex.assert_max_traces(before, n=1)
    yield stepper(STEADY, mesh_of(jax.devices()[:1], 4))
    network.apply = before


@pytest.mark.long
def test_steps_lower_the_loss_and_the_average_follows(step):
    state, frames, said = begun(), trimmed(batch(4)), []
    history = [host(state.params)]
    for _ in range(25):
        state, figures = step(state, frames)
        said.append({k: float(v) for k, v in figures.items()})
        history.append(host(state.params))
    assert int(state.step) == 25
    assert said[-1]["loss"] < 0.75 * said[0]["loss"]
    assert set(said[0]) == {"loss", "gradient", "dead", "path", "flag", "traversable", "recoverability", "depth"}
    weights = {"dead": 1.0} | {k: v for k, v in STEADY.loss._asdict().items() if k in said[0]}
    assert said[0]["loss"] == pytest.approx(sum(w * said[0][k] for k, w in weights.items()), rel=1e-5)
    average = history[0]
    for t, params in enumerate(history[1:]):
        decay = min(STEADY.ema, (1 + t) / (10 + t))
        average = jax.tree.map(lambda a, p, d=decay: d * np.float64(a) + (1 - d) * p, average, params)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), host(state.average), average)


@pytest.mark.long
def test_the_first_step_of_warm_up_changes_nothing_but_the_optimiser(step):
    state, _ = step(begun(), trimmed(batch(4)))
    jax.tree.map(np.testing.assert_array_equal, host(state.params), host(begun().params))
    moments = [leaf for leaf in jax.tree.leaves(host(state.optimiser)) if leaf.ndim > 1]
    assert any(np.abs(m).max() > 0 for m in moments)


@pytest.mark.long
def test_gradients_are_clipped(step):
    """The first moment after one step is a tenth of the clipped gradient."""
    state, said = step(begun(), trimmed(batch(4)))
    moment = state.optimiser[1][0].mu
    norm = np.sqrt(sum(float(jnp.sum(jnp.square(leaf))) for leaf in jax.tree.leaves(moment)))
    assert norm == pytest.approx(0.1 * min(1.0, float(said["gradient"])), rel=1e-3)


def broken(kind):
    frames = trimmed(batch(4))
    x, t = frames.inputs, frames.targets
    if kind == "points":
        points = np.array(x.points)
        points[1], valid = np.nan, np.ones_like(x.point_valid)
        return frames._replace(inputs=x._replace(points=points, point_valid=valid))
    if kind == "depth":
        return frames._replace(targets=t._replace(depth=np.full_like(t.depth, np.nan)))
    recoverability = np.array(t.recoverability)
    recoverability[2] = np.nan
    return frames._replace(targets=t._replace(recoverability=recoverability))


@pytest.mark.parametrize("kind", ["points", "depth", "labels"])
def test_a_broken_batch_teaches_nothing_and_poisons_nothing(step, kind):
    good = trimmed(batch(4))
    start = lambda: step(step(begun(), good)[0], good)[0]  # noqa: E731
    state, said = step(start(), broken(kind))
    assert not np.isfinite(float(said["gradient"]))
    assert int(state.step) == 3
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(host(state)))
    # nothing of it came in: another broken batch leaves the very same state
    other, _ = step(start(), broken("labels" if kind == "points" else "points"))
    jax.tree.map(np.testing.assert_array_equal, host(state), host(other))
    state, said = step(state, good)
    assert np.isfinite(float(said["loss"])) and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(host(state)))


def test_a_mesh_takes_as_many_devices_as_divide_the_batch():
    class Device:
        pass

    devices = [Device() for _ in range(6)]
    assert [mesh_of(devices, n).devices.size for n in (1, 4, 12, 7, 9, 10)] == [1, 4, 6, 1, 3, 5]


TWO = """
import json, sys
import jax
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
sys.path[:0] = [".", "tests", "tests/train"]
import numpy as np
import test_step as small
from drnav_jax.train.step import mesh_of, stepper

assert jax.device_count() == 2
frames, found = small.trimmed(small.batch(4)), {}
for count in (1, 2):
    take, state, said = small.stepper(small.TRAIN, mesh_of(jax.devices()[:count], 4)), small.begun(count), []
    for _ in range(3):
        state, figures = take(state, frames)
        said.append({k: float(v) for k, v in figures.items()})
        if len(said) == 1:
            first = small.host(state.optimiser[1][0].mu)
    used = {d for leaf in jax.tree.leaves(state.params) for d in leaf.sharding.device_set}
    found[count] = (said, first, small.host(state), len(used))
gap = lambda a, b: max(float(np.abs(np.float64(x) - y).max()) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)))
largest = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(found[1][1]))
print(json.dumps({
    "said": [found[1][0], found[2][0]], "gradient_gap": gap(found[1][1], found[2][1]) / largest,
    "params_gap": gap(found[1][2].params, found[2][2].params), "devices": [found[1][3], found[2][3]],
    "moved": gap(found[1][2].params, small.begun().params),
}))
"""


@pytest.mark.long
def test_two_devices_step_as_one(tmp_path):
    """In a process of its own, where the CPU counts as two devices; with the augmentation that training has."""
    ran = subprocess.run(
        [sys.executable, "-c", TWO, str(ROOT / ".jax_cache")], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    found = json.loads(ran.stdout.splitlines()[-1])
    assert found["devices"] == [1, 2]
    one, two = found["said"]
    for a, b in zip(one, two, strict=True):
        assert a == pytest.approx(b, rel=2e-3)  # float32 sums of 4 frames against twice 2, three steps on
    assert found["gradient_gap"] < 1e-4
    # Adam divides by the size of a gradient: where that is near 0, rounding decides the direction of a step
    assert found["params_gap"] < 0.2 * found["moved"]
