"""`drnav train`: the user's mistakes come first, in one line, and before a folder is begun."""

import json

import pytest
import yaml
from small_network import LEAST, frames, params_of

from drnav_jax.cli import learn, main
from drnav_jax.dataset.shards import DatasetSpec, write
from drnav_jax.models import network, settings, weights


@pytest.fixture(autouse=True)
def one_device(monkeypatch):
    """The backend runs already, with one device: it cannot be given more."""
    monkeypatch.setattr(learn.process, "use_every_core", lambda: None)


def said(capsys, *argv):
    code = main(["train", *map(str, argv)])
    out, err = capsys.readouterr()
    *_, last = err.splitlines()
    assert code == 2 and out == "" and last.startswith("drnav: error: ") and "Traceback" not in err, (code, err)
    return last


def test_mistakes(capsys, tmp_path):
    out, none = tmp_path / "run", tmp_path / "none"
    assert "give either --data DIR or --stream" in said(capsys, "--out", out, "--validation", none)
    both = ("--out", out, "--validation", none, "--data", none, "--stream")
    assert "give either --data DIR or --stream" in said(capsys, *both)
    with_file = ("--out", out, "--validation", none, "--data", none, "--config")
    assert "none.yaml" in said(capsys, *with_file, tmp_path / "none.yaml")
    (tmp_path / "bad.yaml").write_text("stepz: 5")
    assert "bad.yaml: there is no stepz: choose from" in said(capsys, *with_file, tmp_path / "bad.yaml")
    assert "--validation" in said(capsys, "--out", out, "--data", none)
    for error in (said(capsys, "--out", out, "--validation", none, "--data", none),
                  said(capsys, "--out", out, "--validation", none, "--stream")):  # fmt: skip
        assert str(none) in error
    assert not out.exists(), "nothing was begun"


def gathered(folder, count, seed):
    spec = DatasetSpec(count, "train", seed, ("t", "u", "l"), num_worlds=8, per_world=-(-count // 8))
    held = {"frames": {"bev": settings.plain(LEAST.bev)}}
    write(folder, spec, held, lambda shard: frames(spec.shard_size, seed + shard))
    return folder


def test_sets_on_another_grid(capsys, tmp_path):
    data, held_out, out = gathered(tmp_path / "data", 32, 0), gathered(tmp_path / "val", 64, 1), tmp_path / "run"
    config = {"network": settings.plain(LEAST) | {"bev": settings.plain(LEAST.bev) | {"ahead": 0.3}}}
    file = other(tmp_path, config)
    error = said(capsys, "--out", out, "--data", data, "--validation", held_out, "--config", file)
    assert f"{data} was gathered on the grid" in error and "'ahead': 0.3" in error
    error = said(capsys, "--out", out, "--stream", "--validation", held_out, "--config", file)
    assert f"{held_out} was gathered on the grid" in error
    assert not out.exists(), "nothing was begun"


def test_sets_that_are_too_small(capsys, tmp_path):
    out, few, many = tmp_path / "run", gathered(tmp_path / "few", 8, 0), gathered(tmp_path / "many", 64, 1)
    error = said(capsys, "--out", out, "--data", many, "--validation", few)
    assert f"{few} holds 8 frames: validation needs at least 64" in error
    error = said(capsys, "--out", out, "--data", few, "--validation", many)
    assert f"{few} holds 8 frames: a batch has 32" in error
    assert not out.exists(), "nothing was begun"


@pytest.mark.long
@pytest.mark.relaxed  # flax
def test_a_short_training(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(network, "init", lambda key, spec: params_of(spec))  # which compiles for longer than all this takes
    config = {"network": settings.plain(LEAST), "steps": 2, "batch_size": 4, "warmup": 1}
    (tmp_path / "run.yaml").write_text(yaml.safe_dump(config))
    data, held_out = gathered(tmp_path / "data", 16, 0), gathered(tmp_path / "val", 64, 1)
    argv = ["train", "--out", tmp_path / "run", "--data", data, "--validation", held_out, "--config", tmp_path / "run.yaml"]
    assert main([*map(str, argv), "--json"]) == 0
    out, err = capsys.readouterr()
    figures = json.loads(out)
    assert figures["step"] == 2 and 0 <= figures["accuracy"] <= 1 and {"samples_per_s", "interior_auroc"} <= set(figures)
    assert f"wrote {tmp_path / 'run' / 'weights.safetensors'}" in err
    trained = weights.load(tmp_path / "run" / "weights.safetensors", LEAST)
    assert trained.notes["figures"]["accuracy"] == pytest.approx(figures["accuracy"])
    assert trained.notes["data"]["train"]["num_frames"] == 16 and trained.notes["data"]["validation"]["seed"] == 1
    assert "give --resume to go on with it" in said(capsys, *argv[1:])
    assert "begun with another seed" in said(capsys, *argv[1:-1], other(tmp_path, config | {"seed": 3}), "--resume")
    assert main([*map(str, argv), "--resume"]) == 0  # there is nothing left to do
    table = dict(line.split() for line in capsys.readouterr().out.splitlines())
    assert float(table["step"]) == 2 and float(table["accuracy"]) == pytest.approx(figures["accuracy"], rel=1e-3)


def other(folder, config):
    (folder / "other.yaml").write_text(yaml.safe_dump(config))
    return folder / "other.yaml"
