"""Facts about pockets against brute force, and what they say of plain rooms."""

import numpy as np
import pytest
import reference_labels as reference

from drnav_jax.worlds.labels import LabelSpec, dead_ends
from drnav_jax.worlds.pockets import pockets

RADIUS = 0.25
FLOAT32 = 1e-5  # [m] results are stored in it


def plan(*walls, size=(8.0, 9.0), resolution=0.1):
    """Grid with walls (y0, x0, y1, x1) [m]."""
    grid = np.zeros([round(s / resolution) for s in size], bool)
    for box in walls:
        y0, x0, y1, x1 = (round(v / resolution) for v in box)
        grid[y0:y1, x0:x1] = True
    return grid


TUBE = ((3, 3, 3.2, 7), (5, 3, 5.2, 7), (3, 6.8, 5.2, 7))  # 1.8 m wide, open towards -x, its end at x = 6.8 m


def facts(occupied, origin=(0.0, 0.0), resolution=0.1, room_area=6.0, **spec):
    labels = dead_ends(occupied, resolution, LabelSpec(radius=RADIUS, **spec))
    return labels, pockets(labels, occupied, origin, resolution, radius=RADIUS, room_area=room_area)


def best_recovery(labels, occupied, resolution):
    """Score of the best recovery point of each pocket, and of every cell, by eq. 1's own words."""
    pad = int(1 / resolution) + 2
    d = reference.clearance(np.pad(occupied, pad), resolution)
    pocket = np.pad(labels.pocket, pad)
    free = d > RADIUS
    scores = []
    for k in range(1, len(labels.mouth) + 1):
        target = free & (pocket == 0)
        way = reference.way_out(target, target | (pocket == k)) * resolution
        ok = target & (way <= 1 + 1e-6) & np.isfinite(way)
        scores.append(np.where(ok, np.minimum(d, 2) - 0.25 * way, -np.inf)[pad:-pad, pad:-pad])
    return scores


def test_tube():
    """What a ruler says of a corridor with an end."""
    origin = (10.0, -4.0)
    labels, found = facts(plan(*TUBE), origin)
    assert len(found.area) == 1
    assert found.area[0] == pytest.approx(labels.label.sum() * 0.01)
    assert found.depth[0] == labels.depth.max()
    assert found.gap[0] == pytest.approx(1.8, abs=0.11)  # a cell
    np.testing.assert_allclose(found.gate[0], [13.0, 0.1], atol=0.6)  # the mouth is at x = 3 m; half its width
    x, y = found.recovery[0]
    assert x < found.gate[0, 0] + 0.9 and abs(y - 0.1) < 0.5, "in front of the mouth, in line with it"


@pytest.mark.parametrize(("room_area", "is_room"), [(1.0, True), (4.0, True), (5.0, False)])
def test_room_is_a_matter_of_area(room_area, is_room):
    _, found = facts(plan(*TUBE), room_area=room_area)
    assert 4.0 < found.area[0] < 5.0  # 3.55 m x 1.3 m, less the gate
    assert found.is_room.tolist() == [is_room]


def test_nested_pocket_has_the_outermost_recovery_point():
    closet = ((3, 8.8, 3.2, 12), (5, 8.8, 5.2, 12), (3, 11.8, 5.2, 12), (3, 8.8, 3.6, 9), (4.5, 8.8, 5.2, 9))
    _, outer = facts(plan(*TUBE[:2], (3, 6.8, 3.2, 9), (5, 6.8, 5.2, 9), *closet, size=(8.0, 14.0)))
    assert len(outer.area) == 1 and outer.recovery[0, 0] < 3.9


@pytest.mark.parametrize(("gap", "has_way_out"), [(0.5, False), (1.0, True)])
def test_closed_part_may_have_no_recovery_point(gap, has_way_out):
    """Of two chambers each is the other's pocket. Where gates on both sides cut off all there is, no cell is outside."""
    shell = ((2, 2, 2.2, 6), (4, 2, 4.2, 6), (2, 2, 4.2, 2.2), (2, 5.8, 4.2, 6))
    wall = ((2, 3.9, 3.35 - gap / 2 - 0.25, 4.1), (3.35 + gap / 2 - 0.25 + 0.1, 3.9, 4.2, 4.1))
    labels, found = facts(plan(*shell, *wall))
    assert len(found.area) and (labels.depth.max() > 0) == has_way_out
    assert np.isfinite(found.recovery).all() == has_way_out


def test_no_pocket():
    labels, found = facts(np.zeros((7, 12), bool))
    assert [len(f) for f in found] == [0] * 6 and found.gate.shape == found.recovery.shape == (0, 2)
    assert not labels.label.any()


def random_plan(rng):
    """Tubes with an end, turned and crossing each other at random."""
    grid = np.zeros(rng.integers(40, 60, 2), bool)
    for _ in range(rng.integers(2, 5)):
        tube = np.zeros((rng.integers(12, 22), rng.integers(9, 16)), bool)
        tube[0] = tube[:, 0] = tube[:, -1] = True
        tube = np.rot90(tube, rng.integers(4))
        i, j = (rng.integers(0, n - m) for n, m in zip(grid.shape, tube.shape, strict=True))
        grid[i : i + tube.shape[0], j : j + tube.shape[1]] |= tube
    return grid


@pytest.mark.long
def test_recovery_points_equal_brute_force():
    met = 0
    for seed in range(22):
        occupied = random_plan(np.random.default_rng(seed))
        labels, found = facts(occupied)
        for place, score in zip(found.recovery, best_recovery(labels, occupied, 0.1), strict=True):
            if np.isnan(place).any():
                assert not np.isfinite(score).any()
                continue
            row, column = np.floor(place[::-1] / 0.1 + 1e-3).astype(int)
            if 0 <= row < score.shape[0] and 0 <= column < score.shape[1]:  # else it lies off the grid
                assert score[row, column] == pytest.approx(score.max(), abs=FLOAT32)
                met += 1
    assert met > 20


def test_gate_touches_its_pocket_from_outside():
    met = 0
    for seed in range(40):
        labels, found = facts(random_plan(np.random.default_rng(seed)))
        for k in range(len(found.area)):
            away = np.hypot(*(np.argwhere(labels.pocket == k + 1) - labels.mouth[k]).T).min() * 0.1
            half = found.gap[k] / 2 - RADIUS
            assert 0 < away < half + 0.25, "the disc is one cell wider than the gap, what it cuts off comes next"
            met += 1
    assert met > 40
