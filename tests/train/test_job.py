"""A whole training run: killed and resumed it ends in the same bits, and it refuses what is not its own."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from small_network import LEAST, batch, frames, params_of

from drnav_jax.models import network, weights
from drnav_jax.models.calibration import Temperature
from drnav_jax.train import train
from drnav_jax.train.checkpoints import Checkpoints
from drnav_jax.train.spec import TrainSpec
from drnav_jax.train.step import init

pytestmark = pytest.mark.relaxed  # flax
STEPS = 6
TRAIN = TrainSpec(network=LEAST, steps=STEPS, batch_size=2, warmup=1, validate_every=2, save_every=3, keep=2)


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Random parameters in place of `network.init`, which takes far longer to compile than all steps to run."""
    before = network.init
    network.init = lambda key, spec: params_of(spec)
    yield
    network.init = before


@pytest.fixture(scope="module")
def validation():
    return [batch(8, seed=50), batch(8, seed=51)]


def source(first, stop=None):
    """Batch s is a function of s; reading batch `stop` is interrupted."""
    number = first
    while True:
        if number == stop:
            raise KeyboardInterrupt
        yield frames(2, seed=100 + number)
        number += 1


def run(out, validation, *, stop=None, resume=False, spec=TRAIN, **how):
    return train(spec, lambda first: source(first, stop), validation, out, resume=resume, devices=jax.devices()[:1], **how)


def held(out, best=False):
    kept = Checkpoints(out, TRAIN.keep)
    state = kept.load(init(TRAIN), best=best)
    kept.close()
    return jax.tree.map(np.asarray, state)


def logged(out):
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory, validation):
    """(folder, result, progress) of a run that nobody interrupts."""
    out, said = tmp_path_factory.mktemp("whole") / "run", []
    result = run(out, validation, progress=lambda step, figures: said.append((step, dict(figures))), data={"seed": 7})
    return out, result, said


def test_what_a_run_leaves_behind(whole, validation):
    out, result, said = whole
    trained = weights.load(out / "weights.safetensors", LEAST)
    best = held(out, best=True)
    assert result.step == int(best.step) and result.step in (2, 4, 6)
    jax.tree.map(np.testing.assert_array_equal, jax.tree.map(np.asarray, trained.params), best.average)
    jax.tree.map(np.testing.assert_array_equal, jax.tree.map(np.asarray, trained.params), result.params)
    assert trained.calibration == result.calibration and trained.notes["figures"].keys() == result.figures.keys()
    assert trained.notes["data"] == {"seed": 7} and trained.notes["step"] == result.step
    assert trained.notes["run"]["batch_size"] == 2 and "network" not in trained.notes["run"]
    lines = logged(out)
    assert [(line["step"], line["kind"]) for line in lines] == [
        (2, "validation"), (4, "validation"), (6, "train"), (6, "validation")
    ]  # fmt: skip
    score = lambda line: np.mean([line[n] for n in ("accuracy", "cell_auroc", "interior_auroc", "dead_end_f1")])  # noqa: E731
    scores = {line["step"]: score(line) for line in lines if line["kind"] == "validation"}
    assert scores[result.step] == max(scores.values())
    assert [step for step, _ in said] == [2, 4, 6, 6] and {"loss", "samples_per_s"} <= set(said[-1][1])
    assert list((out / "tensorboard").glob("events.*"))
    assert {p.name for p in (out / "last").iterdir() if p.is_dir()} == {"3", "6"}
    # validation frames were tempered for: less cross-entropy there than with the raw logits
    t = result.calibration
    assert (t.dead.scale, t.dead.offset) != (1.0, 0.0)


@pytest.mark.parametrize("stop", [3, pytest.param(5, marks=pytest.mark.long)])
def test_killed_and_resumed_is_the_same_bit_for_bit(whole, validation, tmp_path, stop):
    """Killed at a checkpoint, and two steps beyond one, when a line of the log was half written."""
    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        run(out, validation, stop=stop)
    assert int(held(out).step) == 3 and not (out / "weights.safetensors").exists()
    with (out / "log.jsonl").open("a") as stream:
        stream.write('{"step": 1, "ki')
    result = run(out, validation, resume=True)
    for best in (False, True):
        jax.tree.map(np.testing.assert_array_equal, held(out, best), held(whole[0], best))
    assert weights.load(out / "weights.safetensors").sha256 == weights.load(whole[0] / "weights.safetensors").sha256
    assert result.figures == pytest.approx(whole[1].figures, nan_ok=True) and result.calibration == whole[1].calibration
    without = lambda lines: [{k: v for k, v in line.items() if k != "samples_per_s"} for line in lines]  # noqa: E731
    assert without(logged(out)) == without(logged(whole[0]))


def test_a_finished_run_may_be_resumed_and_changes_nothing(whole, validation):
    before = weights.load(whole[0] / "weights.safetensors").sha256
    result = run(whole[0], validation, resume=True)
    assert weights.load(whole[0] / "weights.safetensors").sha256 == before and result.step == whole[1].step


@pytest.mark.long
def test_it_goes_on_from_weights(validation, tmp_path, whole):
    """They are where it begins; a rate of almost nothing leaves them as they are."""
    file = whole[0] / "weights.safetensors"
    held = weights.load(file)
    still = dataclasses.replace(TRAIN, start_from=str(file), learning_rate=1e-12, steps=1, weight_decay=0.0)
    result = run(tmp_path / "on", validation, spec=still)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), result.params, held.params)
    other = dataclasses.replace(still, network=dataclasses.replace(LEAST, bev=dataclasses.replace(LEAST.bev, ahead=0.3)))
    with pytest.raises(ValueError, match="another bev"):
        run(tmp_path / "other", validation, spec=other)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        run(tmp_path / "none", validation, spec=dataclasses.replace(still, start_from=str(tmp_path / "nowhere")))
    assert not (tmp_path / "other").exists() and not (tmp_path / "none").exists(), "nothing was begun"


def test_an_ablation_goes_on_from_what_it_has_in_common(tmp_path, whole):
    """A network without cameras takes over all but the arrays that read what cameras see."""
    file = whole[0] / "weights.safetensors"
    blind = dataclasses.replace(LEAST, sensors="lidar")
    took, had = weights.begun(file, blind), weights.load(file).params
    fresh = network.init(jax.random.key(0), blind)
    assert jax.tree.map(np.shape, took) == jax.tree.map(np.shape, fresh) and "encoder" not in took
    jax.tree.map(np.testing.assert_array_equal, took, {name: had[name] for name in took})
    other = dataclasses.replace(LEAST, attention_layers=LEAST.attention_layers + 1)
    more = weights.begun(file, other)["fusion"]
    assert set(more) > set(had.get("fusion", {})), "what the file lacks begins at random"


def test_it_refuses_what_is_not_its_own(whole, validation, tmp_path):
    out = whole[0]
    with pytest.raises(ValueError, match="holds a run already: give --resume"):
        run(out, validation)
    other = TrainSpec(**{**TRAIN.__dict__, "learning_rate": 1e-3, "seed": 4})
    with pytest.raises(ValueError, match="begun with another learning_rate, seed:"):
        run(out, validation, resume=True, spec=other)
    with pytest.raises(ValueError, match="begun with another seed data:"):
        run(out, validation, resume=True, data={"seed": 8})
    with pytest.raises(ValueError, match="holds no run to resume"):
        run(tmp_path / "none", validation, resume=True)


@pytest.mark.long
def test_a_run_killed_before_its_first_checkpoint_begins_anew(validation, tmp_path, whole):
    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        run(out, validation, stop=0)
    run(out, validation, resume=True)
    jax.tree.map(np.testing.assert_array_equal, held(out), held(whole[0]))


def test_a_checkpoint_of_another_network_is_refused(whole):
    kept = Checkpoints(whole[0], 2)
    wider = TrainSpec(**{**TRAIN.__dict__, "network": LEAST.__class__(**{**LEAST.__dict__, "joint": 12})})
    with pytest.raises(ValueError, match="checkpoint 6 does not fit this network"):
        kept.load(init(wider))
    kept.close()


def test_no_checkpoint_at_all(tmp_path):
    kept = Checkpoints(tmp_path, 2)
    assert kept.latest is None and kept.best is None
    with pytest.raises(ValueError, match="no checkpoint"):
        kept.load(init(TRAIN))
    kept.close()


@pytest.mark.long
def test_validation_without_both_kinds_still_ends_in_weights(validation, tmp_path):
    """Frames none of which is a dead end: that head keeps its raw logits, and hours of training are not lost."""
    open_ = [b._replace(targets=b.targets._replace(dead_end_flag=np.zeros(8, bool))) for b in validation]
    spec = TrainSpec(**{**TRAIN.__dict__, "steps": 1})
    result = run(tmp_path / "run", open_, spec=spec)
    assert result.calibration.flag == Temperature() and result.calibration.dead.scale != 1.0
    assert (tmp_path / "run" / "weights.safetensors").is_file()
