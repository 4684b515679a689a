import numpy as np
import pytest
from scipy import ndimage

from drnav_jax.worlds import BLOCKS, Material, make_world, rasterise, surfaces
from drnav_jax.worlds.closures import KINDS, close, fits
from drnav_jax.worlds.dressing import Look, Setting

RESOLUTION = 0.05
CASES = {  # width and depth of the passage
    "wall": [(1.2, 0.2), (4.0, 0.3)],
    "glass": [(1.5, 0.2), (2.5, 0.2), (4.5, 0.3)],
    "door": [(1.0, 2.4), (1.25, 3.0), (2.3, 0.4), (3.5, 0.4)],
    "hedge": [(1.4, 0.7), (3.0, 2.4)],
    "drop": [(1.4, 0.9), (3.4, 2.4)],
    "cars": [(4.3, 5.0), (4.9, 5.0)],
    "crates": [(1.8, 0.7), (3.6, 2.4)],
}


def passage(kind, width, depth, seed, side=0.0):
    """A wall along x at y = 0, the passage around x = 0 in it, and what closes it."""
    rng = np.random.default_rng(seed)
    made = close(kind, (-width / 2, 0.0), (width / 2, 0.0), 0.2, depth, rng, number=1, side=side)
    walls = [[s * (width / 2 + 5), 0, 0, 5, 0.1, 0, 2.5] for s in (-1, 1)]

    def free(is_open):
        look = Look(Setting(), [seed], False)
        world = look.world(made.fixed(is_open))
        stone = surfaces(len(walls), int(Material.WALL))
        both = make_world(
            [*walls, *world.boxes],
            box_surfaces=type(stone)(
                np.concatenate([stone.material, world.box_surfaces.material]),
                np.concatenate([stone.colour, world.box_surfaces.colour]),
            ),
        )
        return ~rasterise(both, (-7.0, -5.0), (200, 280), RESOLUTION)

    return made, free


def joined(free, radius):
    clear = ndimage.distance_transform_edt(np.pad(free, ((0, 0), (1, 1))))[:, 1:-1] * RESOLUTION > radius
    part, _ = ndimage.label(clear, np.ones((3, 3)))
    return part[10, 140] == part[-10, 140] > 0


@pytest.mark.parametrize("kind", KINDS)
def test_closed_no_robot_passes_and_open_one_does(kind):
    for width, depth in CASES[kind]:
        assert fits(kind, width, depth)
        for seed in range(6):
            _, free = passage(kind, width, depth, seed)
            assert not joined(free(False), 0.22), (width, seed)
            # A door's width of 0.9 m at least, elsewhere WAY of 1.2 m; a cell's diagonal is lost on the grid.
            assert joined(free(True), (0.9 if kind == "door" or width < 1.3 else 1.2) / 2 - 0.06), (width, seed)


@pytest.mark.parametrize("kind", KINDS)
def test_what_stands_there_is_as_deep_as_it_may_be(kind):
    for width, depth in CASES[kind]:
        for seed in range(6):
            made, _ = passage(kind, width, depth, seed)
            for solid in [*made.both, *made.closed, *made.opened]:
                x, y, yaw, hx, hy = solid.row[:5]
                reach = abs(y) + abs(np.sin(yaw)) * hx + abs(np.cos(yaw)) * hy
                paint = 0.2 if kind == "drop" else 0.0
                assert reach <= max(depth, 0.2) / 2 + 0.06 + paint, (width, solid)


def test_doors_swing_to_the_side_they_are_told():
    for side in (-1.0, 1.0):
        for seed in range(6):
            made, _ = passage("door", 1.1, 3.0, seed, side)
            (leaf,) = made.opened
            assert np.sign(leaf.row[1]) == side


@pytest.mark.parametrize(("kind", "closed", "opened"), [("hedge", "bush", "grass"), ("glass", "pane", None)])
def test_cameras_tell_what_lidar_does_not(kind, closed, opened):
    made, _ = passage(kind, 1.5, 1.5, 0)
    assert {s.role for s in made.closed} == {closed} and {s.role for s in made.opened} == ({opened} - {None})
    if opened:  # same shape, so that only the look differs
        np.testing.assert_array_equal(made.closed[0].row, made.opened[0].row)


def test_paint_is_no_obstacle_and_a_drop_is():
    made, free = passage("drop", 2.0, 1.5, 3)
    assert {s.role for s in made.both} == {"stripe"} and not BLOCKS[Material.STRIPE]
    assert free(True)[:, 140].all() and not free(False)[:, 140].all()


def test_what_does_not_fit():
    assert not fits("door", 1.6, 3.0) and not fits("door", 1.1, 0.5)
    assert not fits("cars", 3.0, 5.0) and not fits("cars", 4.4, 2.0) and not fits("glass", 1.2, 1.0)
    with pytest.raises(ValueError, match="unknown kind of closure 'gate'; there are wall, glass"):
        close("gate", (0.0, 0.0), (1.0, 0.0), 0.2, 1.0, np.random.default_rng(0), number=0)
