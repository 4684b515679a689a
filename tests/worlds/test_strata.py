"""What is in view: plain scenes, and plain loops over exact lines of sight."""

import math

import numpy as np
import pytest

from drnav_jax import worlds
from drnav_jax.worlds import Material
from drnav_jax.worlds.strata import STRATA, in_view

DROP, GLASS, PLANTS = range(3)


def scene_of(*solids, size=(10.0, 16.0), resolution=0.1):
    """Boxes (x0, y0, x1, y1, material, z_min, z_max) on a grid whose corner is the origin."""
    rows = [[(a + c) / 2, (b + d) / 2, 0, (c - a) / 2, (d - b) / 2, low, high] for a, b, c, d, _, low, high in solids]
    of = worlds.surfaces(len(rows), [int(s[4]) for s in solids])
    world = worlds.make_world(rows, box_surfaces=of)
    shape = tuple(round(s / resolution) for s in size)
    return worlds.Scene(
        "plan", world, worlds.rasterise(world, (0.0, 0.0), shape, resolution), (0.0, 0.0), resolution
    )


PANE = (8, 4, 8.04, 6, Material.GLASS, 0.0, 2.0)
WALL = (6, 2, 6.2, 8, Material.BRICK, 0.0, 2.5)


def test_strata_in_order():
    assert list(STRATA) == ["drop", "glass", "vegetation"]


@pytest.mark.parametrize(
    ("solid", "which"),
    [
        (PANE, GLASS),
        ((8, 4, 9, 6, Material.DROP, -1.0, 0.0), DROP),
        ((8, 4, 9, 6, Material.BUSH, 0.0, 1.2), PLANTS),
        ((8, 4, 9, 6, Material.GRASS, 0.0, 0.6), PLANTS),
        ((8, 4, 9, 6, Material.CAR, 0.0, 1.4), None),
        ((8, 4, 9, 6, Material.GLASS, 2.0, 2.4), None),  # overhead
    ],
)
def test_one_solid(solid, which):
    want = [k == which for k in range(3)]
    ahead, behind, far = (2.0, 5.0, 0.0), (2.0, 5.0, math.pi), (-4.0, 5.0, 0.0)
    seen = in_view(scene_of(solid), np.array([ahead, behind, far]))
    assert seen.tolist() == [want, [False] * 3, [False] * 3]
    assert in_view(scene_of(solid), np.array([behind]), half_angle=math.pi).tolist() == [want]
    assert in_view(scene_of(solid), np.array([far]), reach=13.0).tolist() == [want]
    assert in_view(scene_of(solid), np.array([ahead]), reach=5.0).tolist() == [[False] * 3]


@pytest.mark.parametrize(
    ("material", "low", "high", "hides"),
    [
        (Material.BRICK, 0.0, 2.5, True),
        (Material.BRICK, 0.0, 0.3, False),  # one looks over it
        (Material.BRICK, 2.1, 2.5, False),  # and under it
        (Material.GLASS, 0.0, 2.5, False),
        (Material.GRASS, 0.0, 0.9, False),
    ],
)
def test_what_hides(material, low, high, hides):
    wall = (*WALL[:4], material, low, high)
    drop = (8, 4, 9, 6, Material.DROP, -1.0, 0.0)
    assert in_view(scene_of(drop, wall), np.array([[2.0, 5.0, 0.0]]))[0, DROP] == (not hides)


def test_walls_of_a_map_hide():
    grid = np.zeros((100, 160), bool)
    grid[:, 60] = True
    plain = scene_of(PANE)
    mapped = worlds.from_grid(grid, (0.0, 0.0), 0.1)
    world = plain.world._replace(field=mapped.field)
    scene = worlds.Scene("both", world, plain.occupied | grid, (0.0, 0.0), 0.1)
    poses = np.array([[2.0, 5.0, 0.0], [7.0, 5.0, 0.0]])
    assert in_view(scene, poses)[:, GLASS].tolist() == [False, True]


def test_lines_of_sight_by_hand():
    """Against exact crossings of a fan of lines with boxes; what is seen through a slit may differ."""
    rng = np.random.default_rng(0)
    agree = total = positive = 0
    for _ in range(30):
        walls = [(x, y, x + 0.3, y + 2, Material.WALL, 0, 2) for x, y in rng.uniform((3, 0), (12, 8), (4, 2))]
        x, y = rng.uniform((6, 1), (13, 7))
        scene = scene_of(*walls, (x, y, x + 1.0, y + 1.0, Material.BUSH, 0, 1))
        pose = np.array([1.0, 5.0, rng.uniform(-2.5, 2.5)])
        seen = False
        for angle in np.arange(-0.75 * math.pi, 0.75 * math.pi, 0.01):
            d = np.array([math.cos(pose[2] + angle), math.sin(pose[2] + angle)])
            hits = []
            for a, b, c, e in [w[:4] for w in walls] + [(x, y, x + 1.0, y + 1.0)]:
                with np.errstate(divide="ignore"):
                    t = np.sort((np.array([[a, c], [b, e]]) - pose[:2, None]) / d[:, None], axis=1)
                enter, leave = t[:, 0].max(), t[:, 1].min()
                hits.append(enter if 0 <= enter <= leave else math.inf)
            seen |= hits[-1] <= 10.0 and hits[-1] < min(hits[:-1])
        got = in_view(scene, pose[None])[0]
        assert not got[[DROP, GLASS]].any()
        agree, total, positive = agree + (got[PLANTS] == seen), total + 1, positive + seen
    assert agree >= 0.95 * total and 5 < positive < 25


def test_nothing_there():
    assert in_view(scene_of(WALL), np.zeros((0, 3))).shape == (0, 3)
    assert not in_view(worlds.sample("t", 0), np.zeros((5, 3))).any()


@pytest.mark.parametrize("changes", [{"reach": 0.0}, {"reach": math.inf}, {"half_angle": 4.0}, {"half_angle": 0.0}])
def test_input_is_refused(changes):
    with pytest.raises(ValueError, match="must be > 0 m"):
        in_view(scene_of(WALL), np.zeros((1, 3)), **changes)
