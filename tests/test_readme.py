"""What the front page shows must work."""

import math
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from drnav_jax import cli
from drnav_jax.cli import drive
from drnav_jax.planning import PLANNERS

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def said(script: str) -> str:
    """What a script prints, which must be short and run without a complaint."""
    assert len([line for line in script.splitlines() if line.strip()]) <= 15
    env = os.environ | {"PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".jax_cache")}
    done = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.mark.long
def test_the_robot_arrives_and_the_planner_goes_around():
    drives, plans = blocks("python")
    assert said(drives).startswith("arrived: True, after ")
    cost, x, y, exposure = map(float, re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", said(plans).replace("x, y", "")))
    assert math.hypot(x - 5.0, y - 0.5) < 1.0 and cost < 1.2 and exposure < 0.05  # straight on: 0.5 m


def test_the_commands_are_commands(tmp_path, monkeypatch):
    trained = tmp_path / "runs" / "fusion" / "weights.safetensors"  # what the README's training leaves behind
    trained.parent.mkdir(parents=True)
    trained.touch()
    monkeypatch.chdir(tmp_path)
    lines = [line.split("#")[0].split() for block in blocks("bash") for line in block.splitlines()]
    ours = [words[1:] for words in lines if words and words[0] == "drnav"]
    kinds = []
    for argv in ours:
        args = cli.parse(argv)
        kinds.append(type(args))
        if isinstance(args, cli.Run | cli.Compare):
            assert drive.setups_of(args) and drive.scenes_of(args)
    assert kinds == [cli.Run, cli.Compare, *[cli.Dataset] * 3, cli.Train, cli.Compare]
    targets = {words[1] for words in lines if words and words[0] == "make"}
    assert targets == {"demo", "test"}


def test_what_it_points_to_exists():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", TEXT) if not link.startswith("http")]
    assert len(links) > 10
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_the_picture_is_small():
    file = ROOT / "docs" / "trajectory.png"
    assert file.stat().st_size < 300_000
    with Image.open(file) as picture:
        assert 1000 <= picture.width <= 1400


@pytest.mark.parametrize("name", PLANNERS)
def test_every_planner_is_named(name):
    assert f"`{name}`" in TEXT
