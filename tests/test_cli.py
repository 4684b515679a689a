import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from drnav_jax import cli, evaluate, report
from drnav_jax.cli import drive, explain
from drnav_jax.cli.terminal import Bar
from drnav_jax.models import weights
from drnav_jax.viz import MissingExtra

ROOT = Path(__file__).resolve().parents[1]
EPISODE = {
    "success", "collision", "timeout", "time_s", "optimal_s", "distance_m", "shortest_m", "straight_m", "efficiency",
    "spl", "mean_speed_mps", "npr", "min_clearance_m", "recoveries", "world",
}  # fmt: skip
SHORT = ["--world", "u:0", "--episodes", "2", "--time-limit", "2"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """In an empty folder, and without the network, which compiles for longer than all this takes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(weights, "SHIPPED", tmp_path / "nothing.safetensors")


def call(capsys, *argv) -> tuple[int, str, str]:
    code = cli.main([str(word) for word in argv])
    out, err = capsys.readouterr()
    return code, out, err


def shell(*argv, **kwargs):
    env = os.environ | {"PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".jax_cache")}
    command = [sys.executable, "-m", "drnav_jax.cli", *argv]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, **kwargs)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("", "run, compare, worlds, dataset, train, bench"),
        ("drive", "Unrecognized options: drive"),
        ("run", "exactly one of"),
        ("run --wurld u:0", "perhaps you meant --world"),
        ("run --world", "--world"),
        ("run --world u", "FAMILY:SEED"),
        ("run --world u:0 --map m.yaml", "got --world and --map"),
        ("run --world u:0 --planner teb", 'no planner "teb": choose from drnav, '),
        ("run --world u:0 --planners drnav", "--planners"),
        ("compare --world u:0 --planners drnav,", 'no planner ""'),
        ("compare --world u:0 --planners dwa,grid,dwa", "names one twice"),
        ("run --world u:0 --predictor gut", "geometric"),
        ("run --world u:0 --episodes 1.5", "--episodes"),
        ("run --world u:0 --robot-radius wide", "--robot-radius"),
        ("run --world u:0 --robot-radius 0", "robot_radius must lie within"),
        ("run --world u:0 --max-speed nan", "max_speed"),
        ("run --world u:0 --risk-weight -1", "risk_weight"),
        ("run --world u:0 --time-limit 0", "time_limit"),
        ("run --world u:0 --physics bullet", "--physics"),
        ("run --world u:0 --physics mjx --mjx-boxes 2", "raise num_boxes (--mjx-boxes on the command line)"),
        ("run --world u:0 --start 1,2", "--start must be X,Y,YAW"),
        ("run --world u:0 --start 900,2,0", "the start (900.00, 2.00) is off the map"),
        ("run --world u:0 --goal -11.9,1.0", "the goal (-11.90, 1.00) is"),
        ("run --map nowhere.yaml", "no such file"),
        ("run --map nowhere.png --resolution 0.05", "no such image"),
        ("run --barn nowhere", "no such file"),
        ("run --world u:0 --out taken/results", "cannot be written to"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(capsys, argv, message):
    Path("taken").write_text("a file, no folder")
    code, out, err = call(capsys, *argv.split())
    assert (code, out) == (2, "")
    assert err.startswith("drnav: error: ") and err.count("\n") == 1
    assert message in err
    assert not Path("results").exists()


def test_unreachable_goal_and_start_in_an_obstacle(capsys):
    rooms = np.zeros((60, 120), np.uint8)
    rooms[5:-5, 5:55] = rooms[5:-5, 65:-5] = 255
    Image.fromarray(rooms).save("rooms.png")
    image = ("run", "--map", "rooms.png", "--resolution", 0.1)
    code, _, err = call(capsys, *image, "--start", "2,2,0", "--goal", "9,2")
    assert code == 2 and "no way from (2.00, 2.00) to (9.00, 2.00)" in err
    code, _, err = call(capsys, *image, "--start", "6,3,0", "--goal", "9,2")
    assert code == 2 and "the start (6.00, 3.00) is in an obstacle" in err
    code, _, err = call(capsys, *image, "--goal", "9,2")
    assert code == 2 and "both --start and --goal" in err


def test_negative_numbers_are_values():
    args = cli.parse(["run", "--start", "-2,3,1.57", "--goal", "-1.5,-3", "--risk-weight", "-1"])
    assert (args.start, args.goal, args.risk_weight) == ("-2,3,1.57", "-1.5,-3", -1.0)
    assert cli.parse(["run", "--start=-2,3,1.57"]).start == "-2,3,1.57"


def test_defaults_are_those_of_the_setup():
    args = cli.parse(["run", "--world", "u:0"])
    assert drive.setups_of(args) == {"drnav": evaluate.Setup()}
    args = cli.parse(
        "compare --planners grid,dwa --predictor oracle --risk-weight 2 --horizon 3 --robot-radius 0.22 --max-speed 2 "
        "--lidar-range 6 --goal-tolerance 1 --time-limit 100 --seed 5".split()
    )
    common = {
        "predictor": "oracle", "risk_weight": 2.0, "horizon": 3.0, "robot_radius": 0.22, "max_speed": 2.0,
        "lidar_range": 6.0, "goal_tolerance": 1.0, "time_limit": 100.0, "seed": 5,
    }  # fmt: skip
    assert drive.setups_of(args) == {name: evaluate.Setup(planner=name, **common) for name in ("grid", "dwa")}


@pytest.mark.parametrize("command", ["", "run", "compare", "bench"])
def test_help(capsys, command):
    code, out, err = call(capsys, *command.split(), "--help")
    assert (code, err) == (0, "")
    for word in {"": ["run", "compare", "bench"], "bench": ["--quick", "--json"]}.get(
        command, ["--world FAMILY:SEED", "Footprint radius [m]", "Fastest speed [m/s]", "Time allowed per episode [s]"]
    ):
        assert word in out
    assert max(map(len, out.splitlines())) <= 100


def test_version(capsys):
    assert call(capsys, "--version") == (0, "drnav 0.1.0\n", "")


@pytest.mark.long
def test_compare_writes_the_same_bytes_again(capsys):
    flags = ("compare", *SHORT, "--planners", "drnav,dwa", "--json", "--out")
    code, out, err = call(capsys, *flags, "a")
    assert code == 0 and "Traceback" not in err
    found = json.loads(out)  # one object, and nothing else
    assert out == Path("a/summary.json").read_text()
    assert list(found["planners"]) == ["drnav", "dwa"]
    for each in found["planners"].values():
        assert [e["world"] for e in each["episodes"]] == ["u:0", "u:1"]
        assert all(EPISODE <= set(e) and e["timeout"] and e["time_s"] == 2.0 for e in each["episodes"])
        assert each["summary"]["time_to_goal_s"] == each["summary"]["time_limit_s"] == 2.0
        assert "barn_score" not in each["summary"]
    assert found["ratios"]["drnav/dwa"] == {"all": {"ratio": 1.0, "low": 1.0, "high": 1.0, "trips": 2},
                                            "both_solve": None}  # fmt: skip
    assert found["config"]["world"] == "u:0" and found["time_limit_rule"] == "2 s, as asked for"
    assert found["interrupted"] is False
    assert set(os.listdir("a")) == {
        "summary.json", "timing.json", "trajectory.png", "trajectory-2.png", "belief.gif",
    }  # fmt: skip
    with Image.open("a/trajectory.png") as picture, Image.open("a/belief.gif") as film:
        assert 1000 <= picture.width <= 1400 and film.n_frames == 3
    timing = json.loads(Path("a/timing.json").read_text())
    assert timing["planners"]["dwa"]["wall_s"] > 0

    code, again, _ = call(capsys, *flags, "b", "--no-pictures")
    assert code == 0 and again == out
    assert Path("a/summary.json").read_bytes() == Path("b/summary.json").read_bytes()
    assert set(os.listdir("b")) == {"summary.json", "timing.json"}


@pytest.mark.long
def test_run_prints_a_table_and_cleans_up_after_itself(capsys, monkeypatch):
    def missing(*_, **__):
        raise MissingExtra

    monkeypatch.setattr(report.viz, "trajectories", missing)
    out = Path("results/run-u-0")
    out.mkdir(parents=True)
    for name in ("trajectory-5.png", "belief.gif"):
        (out / name).write_text("of another run")
    code, text, err = call(capsys, "run", *SHORT, "--planner", "dwa")
    assert code == 0
    assert text.splitlines()[2].split()[:4] == ["dwa", "0", "%", "0"]
    assert "2 episodes each" in text and "mean 2.0 s" in text
    assert "no pictures: pictures need the extra: pip install drnav_jax[viz]" in err
    assert "dwa  2/2 episodes in" in err and "\r" not in err
    assert set(os.listdir(out)) == {"summary.json", "timing.json"}
    found = json.loads((out / "summary.json").read_text())
    assert len(found["episodes"]) == found["summary"]["episodes"] == 2


@pytest.mark.parametrize(
    ("planner", "parts", "term"),
    [
        ("grid", {"goal", "command"}, "progress"),
        pytest.param("dwa", {"command"}, "heading", marks=pytest.mark.slow),
        pytest.param("nav2-dwb", {"command"}, "PathDist", marks=pytest.mark.slow),
    ],
)
@pytest.mark.long
def test_explain_says_which_critic_decided(capsys, planner, parts, term):
    flags = ("run", "--world", "u:0", "--episodes", "2", "--time-limit", "1", "--planner", planner, "--no-pictures")
    code, text, _ = call(capsys, *flags, "--explain", "--out", "x")
    assert code == 0
    ticks = [json.loads(line) for line in Path("x/explain.jsonl").read_text().splitlines()]
    assert [(t["episode"], t["time_s"]) for t in ticks] == [(e, round(0.1 * k, 3)) for e in (0, 1) for k in range(10)]
    moving = 0
    for tick in ticks:
        assert tick["mode"] == "drive" and tick["certified"] and parts == {"goal", "command"} & set(tick)
        for part in parts:
            why = tick[part]
            count = len(why["cost"])
            assert 1 <= count <= 10 and all(len(values) == count for values in why["best"].values())
            assert list(why["best"]) == list(why["chosen"]) and why["cost"] == sorted(why["cost"])
            total = sum(why["chosen"].values())
            assert total == pytest.approx(why["cost"][0], rel=1e-3, abs=1e-3)
            for name in why["chosen"]:
                assert why["chosen"][name] == why["best"][name][0]
        moving += abs(tick["v"]) > 0.05 or abs(tick["omega"]) > 0.05
    assert moving > 5 and any(tick["command"]["chosen"].get(term, 1.0) > 0 for tick in ticks)
    assert term in text and "decided by" in text and ("where to: g*" in text) == ("goal" in parts)
    assert max(map(len, text.splitlines())) <= 160
    code, _, _ = call(capsys, *flags, "--out", "y", "--explain", "--json")
    code, out, _ = call(capsys, *flags, "--out", "y", "--json")  # it is the same drive, and cleans up
    assert code == 0 and out == Path("x/summary.json").read_text() and not Path("y/explain.jsonl").exists()


def test_the_table_says_what_the_runners_up_pay_more():
    def tick(time, mode, near, risk):
        best = {"near": near, "risk": risk}
        chosen = {name: values[0] if values else 0.0 for name, values in best.items()}
        cost = [a + b for a, b in zip(near, risk, strict=True)]
        return {"time_s": time, "mode": mode, "v": 0.5, "omega": 0.0, "g": [1.0, 2.0],
                "command": {"chosen": chosen, "best": best, "cost": cost}}  # fmt: skip

    ticks = [tick(0.1 * k, "drive", [1.0, 0.5, 0.9], [0.2, 2.0, 1.8]) for k in range(100)]
    ticks[57] = tick(5.7, "clear", [1.0, 1.0], [0.2, 0.2])
    ticks[58] = tick(5.8, "drive", [1.0], [0.2])
    ticks[99] = tick(9.9, "drive", [], [])
    assert explain.lead(ticks[0]["command"]) == pytest.approx({"near": -0.3, "risk": 1.7})
    assert {0.0, 5.7, 5.8, 9.9} <= {round(t["time_s"], 1) for t in explain.moments(ticks)}
    assert len(explain.moments(ticks)) <= explain.ROWS + 2 and explain.moments(ticks[:1]) == ticks[:1]
    lines = explain.table(explain.Told([ticks], ["u:0"]), "dwa").splitlines()
    assert "dwa in u:0" in lines[0] and lines[3] == "how: the command"
    assert lines[4].split() == ["time", "mode", "v", "omega", "g*", "near", "risk", "decided", "by"]
    assert lines[5].split() == ["0.0", "s", "drive", "0.50", "0.00", "(1.0,", "2.0)", "1.00", "0.20", "risk", "+1.7"]
    assert [line for line in lines if "clear" in line and line.endswith("a tie")]
    assert lines[-1].endswith("all blocked") and any(line.endswith("no other") for line in lines)


@pytest.mark.long
def test_an_interrupted_compare_keeps_the_planners_that_are_finished(capsys, monkeypatch):
    drive = evaluate.evaluate

    def interrupted(trips, setup, **kwargs):
        if setup.planner == "grid":
            raise KeyboardInterrupt
        return drive(trips, setup, **kwargs)

    monkeypatch.setattr(evaluate, "evaluate", interrupted)
    code, out, err = call(capsys, "compare", *SHORT, "--planners", "dwa,grid,drnav", "--json", "--out", "x")
    found = json.loads(out)
    assert code == 130 and "interrupted; what was finished is in x/" in err
    assert found["interrupted"] is True and list(found["planners"]) == ["dwa"] and found["ratios"] == {}
    assert out == Path("x/summary.json").read_text()
    code, out, err = call(capsys, "compare", *SHORT, "--planners", "grid,dwa", "--json", "--out", "y")
    assert (code, out) == (130, "") and "nothing is written" in err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        pytest.param((), "no weights of the fusion network (train some", marks=pytest.mark.long),
        pytest.param(("--no-cameras",), "the robot has no cameras", marks=pytest.mark.long),
    ],
)
def test_the_rule_stands_in_for_the_network(capsys, flags, message):
    short = ("run", "--world", "u:0", "--time-limit", "1", "--no-pictures", "--json")
    code, out, err = call(capsys, *short, *flags, "--out", "x")
    assert code == 0 and message in err and "the geometric rule predicts dead ends" in err
    assert json.loads(out)["predictor"] == "geometric" and json.loads(out)["config"]["predictor"] == "fusion"
    code, same, err = call(capsys, *short, "--predictor", "geometric", "--out", "y")
    assert code == 0 and "network" not in err
    assert json.loads(out)["episodes"] == json.loads(same)["episodes"]


def test_weights_that_are_named_must_be_there(capsys):
    code, _, err = call(capsys, "run", "--world", "u:0", "--weights", "none.safetensors")
    assert code == 2 and err.count("\n") == 1 and "none.safetensors" in err and not Path("results").exists()


@pytest.mark.long
def test_planners_that_do_not_predict_need_no_predictor(capsys):
    code, _, err = call(capsys, "run", *SHORT, "--planner", "dwa", "--no-pictures")
    assert code == 0 and "network" not in err


def test_progress_bar_on_a_terminal(monkeypatch):
    class Terminal:
        text = ""

        def isatty(self):
            return True

        def write(self, text):
            self.text += text

        def flush(self):
            pass

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    bar = Bar("dwa", 4, "episodes")
    bar(0)
    bar(2)
    bar.close()
    assert "[############............] 2/4 episodes" in terminal.text and "/s" in terminal.text
    assert terminal.text.count("\n") == 1 and terminal.text.endswith(" s\n")


def test_in_a_shell_mistakes_are_exit_code_2_without_traceback():
    done = shell("run", "--world", "nowhere:1", "--json")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("drnav: error: unknown family 'nowhere'") and done.stderr.count("\n") == 1


@pytest.mark.long
def test_in_a_shell_json_is_all_there_is_on_stdout():
    done = shell("run", *SHORT, "--planner", "dwa", "--json", "--no-pictures", "--out", "z")
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["episodes"]) == 2
    assert done.stdout == Path("z/summary.json").read_text()


def test_bench_prints_what_it_measures(capsys, monkeypatch):
    monkeypatch.setattr(cli.bench, "run", lambda quick=False: {"episodes_per_s": 2.5, "machine": {"quick": quick}})
    code, out, _ = call(capsys, "bench", "--quick", "--json")
    assert code == 0 and json.loads(out) == {"episodes_per_s": 2.5, "machine": {"quick": True}}
    monkeypatch.setattr(cli.bench, "table", lambda result: f"{result['episodes_per_s']} /s")
    code, out, _ = call(capsys, "bench")
    assert (code, out) == (0, "2.5 /s\n")


def test_what_is_not_installed_is_said_without_traceback(capsys, monkeypatch):
    def show(args):
        raise MissingExtra

    monkeypatch.setattr(cli.data, "show", show)
    code, out, err = call(capsys, "worlds", "--world", "u:0")
    assert (code, out) == (2, "") and err.startswith("drnav: error: ") and "viz" in err and len(err.splitlines()) == 1


def test_bench_writes_how_things_grow(capsys, monkeypatch):
    curve = {"over": "things", "sizes": [1, 2], "ms": [1.0, 2.0], "mb": [0.5, 0.5], "exponent": 1.0}
    found = {"curves": {"a part": curve}, "machine": {"cores": 2, "cpu": "a processor", "jax": "0.10"}}
    monkeypatch.setattr(cli.growth, "measure", lambda quick=False: found)
    code, out, err = call(capsys, "bench", "--scaling", "grown", "--json")
    assert (code, err) == (0, "drnav: wrote grown/\n") and json.loads(out) == found
    assert "| a part | things |" in Path("grown/scaling.md").read_text() and Path("grown/scaling.png").is_file()


@pytest.mark.slow
def test_both_physics_agree_in_open_space(capsys):
    records = {}
    for physics in ("kinematic", "mjx"):
        code, out, _ = call(
            capsys, "run", "--world", "open:1", "--physics", physics, "--no-pictures", "--json", "--out", physics
        )
        records[physics] = json.loads(out)["episodes"][0]  # and nothing else is on stdout
        assert code == 0 and records[physics]["success"]
    for what in ("time_s", "distance_m"):
        assert records["mjx"][what] == pytest.approx(records["kinematic"][what], rel=0.02)
