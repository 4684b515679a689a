"""What a training run is: from a file, checked before anything runs."""

from pathlib import Path

import pytest

from drnav_jax.models.network import NetworkSpec
from drnav_jax.train import TrainSpec, read


def test_a_file_changes_what_it_names(tmp_path):
    file = tmp_path / "run.yaml"
    text = "steps: 12\nnetwork:\n  head: tokens\n  encoder: {width: 0.5}\nloss: {gamma: 2}\naugment: {mirror: 0}\n"
    file.write_text(text)
    spec = read(file)
    assert (spec.steps, spec.network.head, spec.network.encoder.width, spec.loss.gamma) == (12, "tokens", 0.5, 2)
    assert spec.augment.mirror == 0 and spec.batch_size == TrainSpec().batch_size
    assert read(None) == TrainSpec()
    file.write_text("")
    assert read(file) == TrainSpec()
    file.write_text('{"steps": 3, "network": {"point_widths": [16, 32]}}')  # JSON is YAML
    assert read(file).network.point_widths == (16, 32)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("steps: [1", "is no YAML"), ("- 1\n- 2", "must be a mapping"), ("speed: 3", "no speed: choose from"),
        ("learning_rate: 1e-3", "learning_rate must be a number, got '1e-3'"), ("steps: 0", "steps must be >= 1"),
        ("network: {heads: 3}", r"no network\.heads"), ("network: tokens", "network must be a mapping"),
        ("loss: {gamma: none}", r"loss\.gamma must be a number"),
    ],
)  # fmt: skip
def test_mistakes_name_the_file_and_the_setting(tmp_path, text, says):
    file = tmp_path / "run.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=rf"run\.yaml.*{says}"):
        read(file)
    with pytest.raises(OSError):
        read(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"batch_size": 0}, "batch_size must be >= 1"), ({"keep": 0, "steps": 0}, "steps, keep must be >= 1"),
        ({"warmup": -1}, "warmup and seed must be >= 0"), ({"seed": -1}, "warmup and seed"), ({"ema": 1.0}, "ema"),
        ({"learning_rate": 0.0}, "learning_rate"), ({"clip": 0.0}, "clip"), ({"weight_decay": -0.1}, "weight_decay"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(changes, says):
    with pytest.raises(ValueError, match=says):
        TrainSpec(**changes)


CONFIGS = sorted((Path(__file__).resolve().parents[2] / "experiments").rglob("*.yaml"))


@pytest.mark.parametrize("file", CONFIGS, ids=lambda file: file.stem)
def test_runs_that_come_with_the_repository(file):
    changed = {k for k, v in vars(read(file).network).items() if v != getattr(NetworkSpec(), k)}
    wanted = {"image_only": {"sensors"}, "lidar_only": {"sensors"}, "no_attention": {"attention_layers"},
              "no_lift": {"lift"}, "tokens": {"head"}, "fusion": set()}  # fmt: skip
    assert changed == wanted[file.stem]
    assert len(CONFIGS) == len(wanted)
