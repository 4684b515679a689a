"""`drnav bench`: all figures are there, and those that do not depend on the machine are right."""

import json

import numpy as np
import pytest
from small_network import SPEC, params_of

from drnav_jax import bench, grids
from drnav_jax.bench import network, planner, scorer
from drnav_jax.models.calibration import Calibration
from drnav_jax.models.weights import Trained
from drnav_jax.planning import scoring


@pytest.fixture(scope="module")
def result():
    with pytest.MonkeyPatch.context() as patch:  # a network that compiles in seconds
        patch.setattr(network, "installed", lambda: Trained(SPEC, params_of(), Calibration(), {}, ""))
        return bench.run(quick=True)


@pytest.mark.slow
def test_every_figure_is_there(result):
    assert set(result) == {
        "tick_lidar_ms", "network_ms", "network", "tick_fusion_ms", "scoring", "scoring_list", "scoring_error", "plan_ms",
        "cost_to_go_ms", "planning", "mppi", "lidar", "camera", "mjx", "labels_ms", "episodes_per_s", "episodes",
        "reference_matmul_ms", "machine",
    }  # fmt: skip
    for tick in ("tick_lidar_ms", "tick_fusion_ms"):
        assert {"median", "p95", "max", "replan_p95"} <= set(result[tick])
    assert set(result["scoring"]) == set(result["scoring_list"]) == set(result["planning"]["threads"]) == {"4096", "65536"}
    assert set(result["planning"]) == {"plan", "cost_to_go", "threads"}
    assert {"rays_per_s", "mujoco_rays_per_s", "ratio", "max_error_m"} <= set(result["lidar"])
    assert set(result["camera"]) == {"images_per_s", "mujoco_images_per_s", "ratio", "no_mujoco", "matmul_ms"}
    assert {"steps_per_s", "kinematic_steps_per_s", "native_steps_per_s", "ratio", "matmul_ms"} <= set(result["mjx"])
    assert {"cores", "cpu", "jax", "platform", "python"} <= set(result["machine"])
    assert json.loads(json.dumps(result, allow_nan=False)) == result


@pytest.mark.slow
def test_figures_fit_together(result):
    tick = result["tick_lidar_ms"]
    assert 0 < tick["median"] <= tick["p95"] <= tick["max"] and tick["replan_median"] <= tick["replan_p95"]
    assert min(*result["scoring"].values(), *result["scoring_list"].values(), result["episodes_per_s"]) > 0
    assert min(result["labels_ms"], result["reference_matmul_ms"]) > 0
    alone, sees = result["network"], result["tick_fusion_ms"]
    assert 0 < result["network_ms"] == alone["median"] <= alone["p95"] <= alone["max"]
    assert sees["ticks"] == tick["ticks"] and 0 < sees["median"] <= sees["max"]
    lidar = result["lidar"]
    assert lidar["ratio"] == pytest.approx(lidar["rays_per_s"] / lidar["mujoco_rays_per_s"])
    assert min(result["mjx"][k] for k in ("steps_per_s", "kinematic_steps_per_s", "native_steps_per_s")) > 0
    assert result["mjx"]["steps_per_s"] == pytest.approx(8 * result["mjx"]["ticks_per_s"])
    camera = result["camera"]
    assert min(camera["images_per_s"], camera["matmul_ms"]) > 0
    if camera["no_mujoco"] is None:
        assert camera["ratio"] == pytest.approx(camera["images_per_s"] / camera["mujoco_images_per_s"])
    else:
        assert "libegl1" in camera["no_mujoco"] and camera["ratio"] is camera["mujoco_images_per_s"] is None
    physics = result["mjx"]
    assert physics["ratio"] == pytest.approx(physics["steps_per_s"] / physics["native_steps_per_s"])
    assert min(physics["kinematic_steps_per_s"], physics["matmul_ms"]) > 0 and physics["deepest_m"] < 0.02
    assert lidar["max_error_m"] < 1e-3 and lidar["mismatches"] == 0


@pytest.mark.slow
def test_parts_of_the_planner_fit_together(result):
    plan, route = (result["planning"][k] for k in ("plan", "cost_to_go"))
    assert result["plan_ms"] == plan["both"] and result["cost_to_go_ms"] == route["full"]
    assert min(*plan.values(), *route.values()) > 0
    assert route["median_error"] < 0.02 and route["p95_error"] < 0.1


def test_a_serpentine_has_one_long_way():
    cost, initial = planner.serpentine(128)
    value = np.asarray(grids.cost_to_go(cost, initial, resolution=0.1))
    assert (value[cost < grids.UNREACHABLE] < grids.UNREACHABLE).all()
    assert value[-1, -1] > 36.0  # as the crow flies: 18 m


@pytest.mark.slow
def test_nobody_arrives_before_the_time_is_up(result):
    assert result["episodes"]["steps"] == 10 * result["episodes"]["batch"]


@pytest.mark.slow
def test_packed_words_score_almost_like_float_layers(result):
    error = result["scoring_error"]
    assert error["median_relative"] < 0.01 and error["p95_relative"] < 0.05
    assert error["blocked_in_one_only"] < 0.02


def test_difference_is_that_of_the_scores():
    free = np.asarray([2.0, 4.0, 3.0])
    one = scorer._difference([(free, free), (np.asarray([1.0, 2.0]), np.asarray([1.5, 1.0]))])
    assert one["candidates"] == 5 and one["blocked_in_one_only"] == one["choices_blocked"] == 0
    assert one["max_regret_m"] == 0.5 and one["median_rank_of_choice"] == 0.5
    blocked = scorer._difference([(free, free), (np.asarray([1.0, 2.0]), np.asarray([scoring.BLOCKED, 1.0]))])
    assert blocked["blocked_in_one_only"] == 0.2 and blocked["choices_blocked"] == 1


@pytest.mark.slow
def test_table_names_every_part(result):
    text = bench.table(result)
    parts = ("tick, 4,096", "tick that replans", "65,536 x 56", "MPPI, ", "LiDAR", "camera 96x96", "MJX, 8 worlds of 20")
    for part in (*parts, "episodes", "matmul"):
        assert part in text
    assert result["machine"]["cpu"] in text
