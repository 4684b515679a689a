"""Holds the table of layers against the imports, and the package to the manners of a library.

Imports point down the table and never sideways, except that `sim` uses `worlds`. Files of one
subpackage import each other freely; experiments do not.
"""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "drnav_jax"

# The package's own __init__ re-exports everything below the command line: only rank 4 may use it.
RANKS = {
    "cli": 4,
    "experiments": 4,
    "": 3.5,
    "evaluate": 3,
    "dataset": 3,
    "gallery": 3,
    "train": 3,
    "bench": 3,
    "report": 3,
    "scripts": 3.2,
    "sources": 3,
    "navigator": 2,
    "models": 1,
    "filter": 1,
    "planning": 1,
    "worlds": 1,
    "sim": 1,
    "bags": 1,
    "metrics": 1,
    "viz": 1,
    "types": 0,
    "geometry": 0,
    "grids": 0,
}
SIDEWAYS = {
    ("sim", "worlds"), ("geometry", "types"), ("grids", "types"), ("bench", "evaluate"),
}  # fmt: skip
BANNED_NAMES = {"utils", "helpers", "common", "misc"}
MAX_LINES = 400
# Heavy or talkative, and needed by one subpackage each, which imports them when it is used.
NOT_ON_IMPORT = ("mujoco", "rosbags", "matplotlib", "torch", "numba")


def modules(root: Path) -> dict[str, Path]:
    """Dotted name -> file of every module of the package and the experiments below `root`."""
    found = {}
    for top in (PACKAGE, "experiments"):
        for path in sorted((root / top).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def unit(module: str) -> tuple[str, str]:
    """(row of the table, unit): modules of one unit are free; each experiment is a unit."""
    parts = module.split(".")
    if parts[0] == "experiments":
        return "experiments", module
    row = parts[1] if len(parts) > 1 else ""
    return row, row


def imported(module: str, path: Path, known: set[str]) -> list[tuple[int, str]]:
    """(line, module) of all first-party imports, also those inside functions and TYPE_CHECKING."""
    package = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    found = []
    for node in ast.walk(ast.parse(path.read_text(), filename=str(path))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:  # `from drnav_jax import grids` means the module
                name = f"{base}.{alias.name}"
                is_module = name in known or any(k.startswith(f"{name}.") for k in known)
                found.append((node.lineno, name if is_module else base))
    return [(line, name) for line, name in found if name.split(".")[0] in (PACKAGE, "experiments")]


def violations(root: Path) -> list[str]:
    """One line for each import that the table forbids, and each module that it does not know."""
    known = modules(root)
    found = []
    for module, path in known.items():
        where = path.relative_to(root)
        row, here = unit(module)
        if row not in RANKS:
            found.append(f"{where}: '{row}' is not in the table of layers")
            continue
        for line, name in imported(module, path, set(known)):
            target_row, there = unit(name)
            if here == there or (row, target_row) in SIDEWAYS:
                continue
            if target_row not in RANKS:
                found.append(f"{where}:{line}: {name} is not in the table of layers")
            elif RANKS[target_row] >= RANKS[row]:
                found.append(
                    f"{where}:{line}: rank {RANKS[row]} imports {name} of rank {RANKS[target_row]}"
                )
    return list(dict.fromkeys(found))  # one import of many names is one line


def write_tree(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def test_imports_point_down():
    assert PACKAGE in modules(ROOT), f"{PACKAGE}/__init__.py is missing"
    assert violations(ROOT) == []


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("drnav_jax/grids.py", "import drnav_jax.geometry"),  # a neighbour on rank 0
        ("drnav_jax/grids.py", "from .filter import update"),  # upwards, relative
        ("drnav_jax/filter/update.py", "from drnav_jax.planning import plan"),  # sideways
        ("drnav_jax/filter/update.py", "from drnav_jax import planning"),  # sideways, by submodule
        ("drnav_jax/filter/update.py", "from .. import planning"),
        ("drnav_jax/filter/update.py", "from ..planning.dwa import plan"),
        ("drnav_jax/filter/__init__.py", "from ..planning.dwa import plan"),
        ("drnav_jax/filter/update.py", "def f():\n    from drnav_jax import navigator"),
        ("drnav_jax/filter/update.py", "from drnav_jax import step"),  # the package itself
        ("drnav_jax/worlds/rooms.py", "import drnav_jax.sim.lidar"),  # only sim -> worlds
        ("drnav_jax/sim/episode.py", "import drnav_jax.navigator"),
        ("drnav_jax/train.py", "from drnav_jax import evaluate"),
        ("drnav_jax/__init__.py", "from drnav_jax import cli"),
        ("drnav_jax/cli.py", "import experiments.table_one"),
        ("experiments/table_one.py", "from experiments.table_two import main"),
        ("experiments/table_one.py", "from . import table_two"),
        ("drnav_jax/tools.py", ""),  # not in the table
        ("drnav_jax/cli.py", "import drnav_jax.tools"),
    ],
)
def test_a_forbidden_import_is_found(tmp_path, file, text):
    neighbours = {
        "drnav_jax/planning/dwa.py": "",
        "drnav_jax/navigator.py": "",
        "drnav_jax/evaluate.py": "",
        "drnav_jax/cli.py": "",
        "experiments/table_two.py": "",
    }
    found = violations(write_tree(tmp_path, {**neighbours, file: text}))
    assert len(found) == 1 and found[0].startswith(file)


def test_allowed_imports_pass(tmp_path):
    files = {
        "drnav_jax/__init__.py": "from .navigator import step\nfrom . import grids, planning",
        "drnav_jax/types.py": "import dataclasses",
        "drnav_jax/grids.py": "import jax.numpy as jnp",
        "drnav_jax/planning/__init__.py": "from drnav_jax.planning.dwa import plan",
        "drnav_jax/planning/dwa.py": "from drnav_jax import grids, types\nfrom . import mppi",
        "drnav_jax/planning/mppi.py": "from drnav_jax.types import Observation",
        "drnav_jax/worlds/rooms.py": "",
        "drnav_jax/sim/lidar.py": "from drnav_jax.worlds import rooms",
        "drnav_jax/navigator.py": "from drnav_jax import planning\nimport drnav_jax.grids",
        "drnav_jax/evaluate.py": "from drnav_jax import navigator, sim",
        "drnav_jax/cli.py": "import drnav_jax\nfrom drnav_jax.evaluate import compare",
        "experiments/table_one.py": "import drnav_jax as dr\nfrom drnav_jax import evaluate",
    }
    assert violations(write_tree(tmp_path, files)) == []


def test_no_module_without_a_subject():
    named = [m for m in modules(ROOT) if BANNED_NAMES & set(m.split("."))]
    assert named == [], "a function lives with its subject"


def test_modules_are_short():
    lengths = {m: len(path.read_text().splitlines()) for m, path in modules(ROOT).items()}
    assert {m: n for m, n in lengths.items() if n > MAX_LINES} == {}


def test_importing_the_package_is_silent_and_light():
    program = f"""
import sys, jax
before = dict(jax.config.values)
import {PACKAGE}
after = dict(jax.config.values)
changed = [flag for flag in after if before.get(flag) != after[flag]]
heavy = [name for name in {NOT_ON_IMPORT} if name in sys.modules]
if changed or heavy:
    sys.exit(f"flags set: {{changed}}; imported: {{heavy}}")
"""
    result = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
