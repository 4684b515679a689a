"""Dead-end labels: the case table, invariances, trips, and equality with brute force."""

import jaxtyping
import numpy as np
import pytest
import reference_labels as reference
from PIL import Image

from drnav_jax import worlds
from drnav_jax.worlds.families import MANY
from drnav_jax.worlds.labels import LabelSpec, dead_ends

# Under the suite's shape checks a wrong shape or dtype is refused before our own check sees it.
REFUSED = (ValueError, jaxtyping.TypeCheckError)
SYMMETRY = 0.998  # agreement in cells; the method itself has no preferred direction
RESAMPLED = 0.9  # IoU between 0.1 m and 0.05 m: mouths move by up to a cell


def draw(*walls, holes=(), size=(20.0, 20.0), resolution=0.1):
    """Grid of a plan: walls, then holes, each (y0, x0, y1, x1) [m]."""
    grid = np.zeros([round(s / resolution) for s in size], bool)
    for boxes, value in ((walls, True), (holes, False)):
        for box in boxes:
            y0, x0, y1, x1 = (round(v / resolution) for v in box)
            grid[y0:y1, x0:x1] = value
    return grid


def at(grid, *points, resolution=0.1):
    """Values at (y, x) points [m]."""
    return [grid[int(y / resolution), int(x / resolution)].item() for y, x in points]


def line(*points, resolution=0.1):
    """Cells of a polyline through (y, x) points [m]."""
    cells = np.array(points) / resolution
    pieces = [np.linspace(a, b, int(np.abs(b - a).max()) * 2 + 2) for a, b in zip(cells[:-1], cells[1:], strict=True)]
    return np.concatenate(pieces).astype(int)


TUBE = ((5, 5, 5.3, 15), (8, 5, 8.3, 15))  # a corridor along x, open at both ends
U = ((5, 8, 5.3, 12.6), (5, 8, 11, 8.3), (5, 12.3, 11, 12.6))  # open towards +y, 4 m wide
T_WALLS = ((8, 0, 8.3, 20), (11, 0, 11.3, 8.7), (11, 11.3, 11.3, 20))
T_STEM = ((11, 8.7, 18, 9), (11, 11, 18, 11.3), (17.7, 8.7, 18, 11.3))
SHELL = ((0.5, 0.5, 0.8, 19.5), (19.2, 0.5, 19.5, 19.5), (0.5, 0.5, 19.5, 0.8), (0.5, 19.2, 19.5, 19.5))
ROOM = ((10, 0.5, 10.3, 19.5), (10, 6, 19.5, 6.3), (10, 13, 19.5, 13.3))
FOREST = tuple((y, x, y + 0.5, x + 0.5) for y in range(2, 18, 2) for x in range(2 + y % 4 // 2, 18, 2))

# name: (walls, holes, points that are dead ends, points that are not), points as (y, x) [m]
CASES = {
    "two walls": (TUBE, (), (), ((6.6, 10), (6.6, 6))),
    "corridor with an end": (
        (*TUBE, (5, 14.7, 8.3, 15)),
        (),
        ((6.6, 13), (6.6, 9)),
        ((6.6, 3), (10, 10), (6.6, 17)),
    ),
    "end gap of 0.6 m": ((*TUBE, (5.9, 14.7, 8.3, 15)), (), (), ((6.6, 13), (6.6, 10))),
    "end gap of 0.4 m": ((*TUBE, (5.7, 14.7, 8.3, 15)), (), ((6.6, 13), (6.6, 10)), ((6.6, 3),)),
    "U of 4 m x 6 m": (U, (), ((7, 10.3), (9, 10.3)), ((14, 10), (3, 10))),
    "U with a pillar inside": (
        (*U, (7.5, 10, 8.1, 10.6)),
        (),
        ((6.5, 10.3), (9.5, 10.3), (7.8, 9)),
        ((14, 10),),
    ),
    "U with a pillar in its mouth": ((*U, (10.5, 10, 11, 10.6)), (), (), ((14, 10),)),
    "U that faces the edge": (
        ((5, 0, 5.3, 8), (8, 0, 8.3, 8), (5, 7.7, 8.3, 8)),
        (),
        ((6.6, 6), (6.6, 4)),
        ((6.6, 10),),
    ),
    "open at the edge and inside": (
        ((5, 0, 5.3, 8), (8, 0, 8.3, 8)),
        (),
        (),
        ((6.6, 4), (6.6, 1)),
    ),
    "bay of 0.7 m": (
        ((5, 8, 5.3, 12.6), (5, 8, 6, 8.3), (5, 12.3, 6, 12.6)),
        (),
        (),
        ((5.7, 10), (5.9, 10)),
    ),
    "L shape": (
        (
            (3, 3, 3.3, 15),
            (3, 14.7, 15, 15),
            (6, 3, 6.3, 12),
            (6, 11.7, 15, 12),
            (14.7, 11.7, 15, 15),
        ),
        (),
        ((13, 13.3), (4.6, 8), (8, 13.3)),
        ((4.6, 1), (16, 13)),
    ),
    "T": (
        (*T_WALLS, *T_STEM),
        (),
        ((15, 10), (13, 10)),
        ((9.6, 4), (9.6, 10), (9.6, 16)),
    ),
    "loop": ((*SHELL, (3, 3, 17, 17)), (), (), ((2, 10), (10, 2), (18, 18))),
    "loop around a sealed hall": (
        (*SHELL, (3, 3, 17, 17)),
        ((3.3, 3.3, 16.7, 16.7),),
        (),
        ((2, 10), (10, 10)),
    ),
    "room with a door": (
        (*SHELL, *ROOM),
        ((10, 9, 10.3, 10.2),),
        ((15, 9.6), (12, 7)),
        ((5, 10), (2, 2)),
    ),
    "room with two doors": (
        (*SHELL, *ROOM),
        ((10, 7, 10.3, 8.2), (10, 11, 10.3, 12.2)),
        (),
        ((5, 10), (15, 9.6)),
    ),
    "forest": (FOREST, (), (), ((3.3, 3.3), (9, 9), (10, 14))),
}


@pytest.mark.parametrize("name", CASES)
def test_case_table(name):
    walls, holes, dead, open_ = CASES[name]
    label = dead_ends(draw(*walls, holes=holes), 0.1).label
    assert at(label, *dead) == [True] * len(dead)
    assert at(label, *open_) == [False] * len(open_)
    if not dead:
        assert not label.any() or name == "U with a pillar in its mouth"


@pytest.mark.parametrize("name", ["L shape", "T", "U with a pillar inside", "room with a door"])
def test_rotation_and_mirror(name):
    walls, holes, *_ = CASES[name]
    occupied = draw(*walls, holes=holes, size=(20.0, 22.0))
    straight = dead_ends(occupied, 0.1)
    assert straight.label.any()
    for turn in (np.rot90, np.fliplr, np.flipud, np.transpose):
        turned = dead_ends(np.ascontiguousarray(turn(occupied)), 0.1)
        for there, here in zip(turned, straight, strict=True):
            if there.shape == turned.label.shape and there.dtype != np.int32:  # pockets are numbered in the order of rows
                assert np.mean(there == turn(here)) >= SYMMETRY


@pytest.mark.parametrize("name", ["corridor with an end", "L shape", "T", "U of 4 m x 6 m", "room with a door"])
def test_resolution(name):
    walls, holes, *_ = CASES[name]
    coarse = dead_ends(draw(*walls, holes=holes), 0.1).label
    fine = dead_ends(draw(*walls, holes=holes, resolution=0.05), 0.05).label
    coarse = coarse.repeat(2, axis=0).repeat(2, axis=1)
    assert (coarse & fine).sum() / (coarse | fine).sum() >= RESAMPLED


def test_depth_gap_and_pocket():
    """A tube of 2.7 m x 9.7 m; its narrowest gate is as wide as it, up to a cell."""
    occupied = draw(*CASES["corridor with an end"][0])
    labels = dead_ends(occupied, 0.1)
    assert [f.dtype for f in labels] == [bool, np.float32, np.float32, np.int32, np.int32, np.float32]
    assert at(labels.gap, (6.6, 10)) == pytest.approx([2.7], abs=0.11)
    near, far = at(labels.depth, (6.6, 10), (6.6, 14))
    assert far - near == pytest.approx(4.0, abs=1e-4)
    assert labels.depth.max() == pytest.approx(9.7, abs=1.0)  # less R and the disc in the mouth
    assert set(np.unique(labels.pocket)) == {0, 1}
    for outside, value in ((labels.depth, 0), (labels.gap, np.inf), (labels.pocket, 0)):
        assert (outside[~labels.label] == value).all()


def test_depth_goes_around_corners():
    occupied = draw(*CASES["L shape"][0])
    labels = dead_ends(occupied, 0.1)
    far, near, inside = at(labels.depth, (14, 13.3), (9, 13.3), (4.6, 9))
    assert far - near == pytest.approx(5.0, abs=0.01)
    assert near - inside > 5.5, "the straight distances to the mouth differ by less"
    assert len(np.unique(labels.pocket)) == 2, "arm and stem of the L are one pocket"


def test_pockets_are_told_apart():
    """Nested pockets count as the outermost one; separate ones each have their own number."""
    alcove = ((5, 8.5, 5.3, 10.2), (2, 8.5, 5.3, 8.8), (2, 10, 5.3, 10.3), (2, 8.5, 2.3, 10.3))
    nested = draw(*CASES["corridor with an end"][0], *alcove, holes=((5, 8.8, 5.3, 10.0),))
    labels = dead_ends(nested, 0.1)
    assert at(labels.pocket, (3, 9.4), (6.6, 13)) == [1, 1]
    assert at(labels.gap, (3, 9.4))[0] < at(labels.gap, (6.6, 13))[0]
    twice = np.concatenate([nested, nested])
    assert set(np.unique(dead_ends(twice, 0.1).pocket)) == {0, 1, 2}


def test_goal_in_a_pocket_is_no_trap():
    occupied = draw(*CASES["L shape"][0])
    path = line((4.6, 1), (4.6, 13.3), (13, 13.3))
    assert not dead_ends(occupied, 0.1, trip_path=path).label.any()
    short = dead_ends(occupied, 0.1, trip_path=line((4.6, 1), (4.6, 8))).label
    assert at(short, (4.6, 5), (4.6, 8), (8, 13.3), (13, 13.3)) == [False, False, True, True]


def test_through_arm_of_a_t_is_open():
    occupied = draw(*CASES["T"][0])
    path = line((9.6, 0), (9.6, 19.9))
    labels = dead_ends(occupied, 0.1, trip_path=path)
    assert not labels.label[80:110].any(), "the whole bar of the T is the way"
    assert at(labels.label, (13, 10), (15, 10)) == [True, True]


def test_turn_at_a_t():
    """Up the stem and off to the right: the blocked left arm is the trap, the stem is none."""
    occupied = draw(*T_WALLS, (8, 0, 11.3, 0.3), *T_STEM[:2])
    path = line((18.5, 10), (9.6, 10), (9.6, 19.9))
    for labels in (dead_ends(occupied, 0.1), dead_ends(occupied, 0.1, trip_path=path)):
        assert at(labels.label, (9.6, 2), (9.6, 6), (9.6, 14), (15, 10)) == [True, True, False, False]


def test_anchors_open_a_closed_world():
    """Goal-free, the larger half of a closed plan is open; on a trip, what the trip needs is."""
    occupied = draw(*SHELL, *ROOM, holes=((10, 9, 10.3, 10.2),))
    assert at(dead_ends(occupied, 0.1).label, (5, 10), (15, 9.6)) == [False, True]
    path = line((18, 8), (12, 9.6))
    assert at(dead_ends(occupied, 0.1, trip_path=path).label, (15, 9.6)) == [False]


@pytest.mark.parametrize("pillar", [(6.0, 12.5, 6.5, 13.0), (6.9, 9.0, 7.4, 9.5)])
def test_an_obstacle_inside_opens_no_cell(pillar):
    """It leaves the gate and the depth as they are, so what stays free stays a dead end."""
    empty = draw(*CASES["corridor with an end"][0])
    filled = empty | draw(pillar)
    before, after = dead_ends(empty, 0.1).label, dead_ends(filled, 0.1).label
    may_stand = reference.clearance(filled, 0.1) > 0.25
    deep = np.arange(200) > 70  # past the gate, which the mouth at x = 5 m sets
    assert may_stand[before].any() and not (before & may_stand & ~after)[:, deep].any()


def random_plan(rng):
    """Walls and clutter of a few cells each, now and then enclosed."""
    grid = rng.random(rng.integers(12, 40, 2)) < rng.choice([0.0, 0.02, 0.06, 0.2])
    for _ in range(rng.integers(2, 12)):
        i, j = rng.integers(0, grid.shape)
        long, thick = rng.integers(3, 30), rng.integers(1, 3)
        size = (long, thick) if rng.random() < 0.5 else (thick, long)
        grid[i : i + size[0], j : j + size[1]] = True
    if rng.random() < 0.4:
        grid[[0, -1]] = grid[:, [0, -1]] = True
    return grid


def agrees(seed):
    """Compares one random plan with brute force; whether it has a dead end."""
    rng = np.random.default_rng(seed)
    occupied = random_plan(rng)
    # With 0.5 m cells few cells make a depth, which shows what happens at single cells.
    resolution = (0.1, 0.5)[seed % 2]
    radii, mouths = (((0.06, 0.15, 0.25), (1.2, 2, 3)), ((0.04, 0.3), (4, 8)))[seed % 2]
    spec = LabelSpec(
        radius=float(rng.choice(radii)),
        mouth=float(rng.choice(mouths)),
        depth_ratio=float(rng.choice([0.75, 0.3])),
        max_share=float(rng.choice([0.5, 0.3, 0.9])),
    )
    free = reference.clearance(occupied, resolution) > spec.radius
    path = reference.any_path(free, rng) if rng.random() < 0.5 else None
    return compare(occupied, resolution, spec, path)


def compare(occupied, resolution, spec, path=None):
    """Asserts that all outputs equal brute force; whether there is a dead end."""
    free = reference.clearance(occupied, resolution) > spec.radius
    label, gap = reference.dead_ends(occupied, resolution, spec, path)
    got = dead_ends(occupied, resolution, spec, trip_path=path)
    np.testing.assert_array_equal(got.label, label)
    np.testing.assert_array_equal(got.gap, gap.astype(np.float32))
    way = reference.way_out(label, free) * resolution
    way[np.isinf(way)] = 0.0
    np.testing.assert_allclose(got.depth, way, rtol=1e-6)  # float32
    assert ((got.pocket > 0) == label).all()
    return label.any()


def test_disc_that_is_not_connected():
    """A gate here covers a cell that hangs on to the rest of F outside of the disc only."""
    rows = ("..#.##", ".#.#..", "..#...", "#.#.#.", "#....#", ".##.#.", "...#..")
    occupied = np.array([[cell == "#" for cell in row] for row in rows])
    assert compare(occupied, 0.5, LabelSpec(radius=0.04, mouth=2.0, depth_ratio=0.3, max_share=0.9))


@pytest.mark.parametrize("block", range(4))
def test_equals_brute_force(block):
    assert sum(agrees(seed) for seed in range(block * 15, block * 15 + 15)) >= 3


@pytest.mark.slow
def test_equals_brute_force_at_length():
    assert sum(agrees(seed) for seed in range(100, 1100)) >= 200


def test_given_clearance_changes_nothing():
    occupied = draw(*CASES["U with a pillar inside"][0])
    given = reference.clearance(occupied, 0.1).astype(np.float32)
    plain, other = dead_ends(occupied, 0.1), dead_ends(occupied, 0.1, clearance=given)
    for a, b in zip(plain, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_given_clearance_counts():
    """Walls that only the clearance knows (glass, say) are walls."""
    occupied = draw(*CASES["corridor with an end"][0])
    given = reference.clearance(occupied, 0.1)
    assert dead_ends(draw(*TUBE), 0.1, clearance=given).label[66, 130]


def test_spacing_only_loses_cells():
    occupied = draw(*CASES["L shape"][0])
    every, few = dead_ends(occupied, 0.1).label, dead_ends(occupied, 0.1, spacing=0.4).label
    assert few.any() and not (few & ~every).any()


def test_office_floor(shared_data):
    """A real floor of 61 m x 57 m: its loop of corridors is open, what leads off it is not."""
    image = np.array(Image.open(shared_data / "maps/willow/willow-2010-02-18-0.10.pgm"))
    occupied = np.flipud(image) < 250  # what was never seen counts as occupied
    label = dead_ends(occupied, 0.1, LabelSpec(mouth=2.5)).label
    corridors, ends = [(500, 170), (420, 112), (530, 350)], [(225, 55), (575, 324), (70, 315)]
    assert [label[cell].item() for cell in corridors + ends] == [False] * 3 + [True] * 3


@pytest.mark.parametrize("value", [False, True])
def test_uniform_grids_have_no_dead_end(value):
    labels = dead_ends(np.full((7, 12), value), 0.1)
    assert not labels.label.any() and not labels.depth.any() and not labels.pocket.any()
    assert np.isinf(labels.gap).all() and labels.label.shape == (7, 12)


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"radius": 0.0}, "radius must be > 0 m"),
        ({"mouth": 0.5}, "mouth must be > 2 radius = 0.5 m"),
        ({"mouth": np.inf}, "mouth"),
        ({"depth_ratio": -0.1}, "depth_ratio must be >= 0"),
        ({"max_share": 0.0}, "max_share must lie in"),
        ({"max_share": 1.1}, "max_share must lie in"),
        ({"radius": np.nan}, "radius"),
    ],
)
def test_spec_refuses(changes, rule):
    with pytest.raises(ValueError, match=rule):
        LabelSpec(**changes)


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"resolution": 0.0}, "resolution must be > 0 m"),
        ({"resolution": float("nan")}, "resolution must be > 0 m"),
        ({"occupied": np.zeros((0, 4), bool)}, "occupied"),
        ({"spacing": -1.0}, "spacing must be >= 0 m"),
        ({"trip_path": np.zeros((0, 2), int)}, "trip_path must be"),
        ({"trip_path": np.array([[0, 0], [8, 3]])}, "trip_path must stay"),
        ({"trip_path": np.array([[-1, 0]])}, "trip_path must stay"),
        ({"clearance": np.full((8, 9), np.nan)}, "clearance must be"),
    ],
)
def test_input_is_refused(changes, rule):
    with pytest.raises(ValueError, match=rule):
        dead_ends(**{"occupied": np.zeros((8, 9), bool), "resolution": 0.1, **changes})


@pytest.mark.parametrize(
    "changes",
    [
        {"occupied": np.zeros((8, 9))},
        {"occupied": np.zeros(9, bool)},
        {"trip_path": np.zeros((2, 3), int)},
        {"clearance": np.ones((9, 8))},
    ],
)
def test_shape_or_dtype_is_refused(changes):
    with pytest.raises(REFUSED):
        dead_ends(**{"occupied": np.zeros((8, 9), bool), "resolution": 0.1, **changes})


CLOSED = sorted(set(worlds.FAMILIES.values()) - {"open"})
SMALL = [family for family in CLOSED if family not in MANY]  # the others are several times as large


@pytest.mark.parametrize("family", CLOSED)
def test_families_turned_and_mirrored(family):
    """Whatever a family draws; all turns and mirror images are made of these two."""
    for seed, turn in ((0, np.rot90), (1, np.transpose)):
        occupied = worlds.sample(family, seed).occupied
        label = dead_ends(occupied, 0.1).label
        assert label.any()
        turned = dead_ends(np.ascontiguousarray(turn(occupied)), 0.1).label
        assert np.mean(turned == turn(label)) >= SYMMETRY


@pytest.mark.parametrize(
    "families",
    [pytest.param(SMALL, marks=pytest.mark.long, id="small"), pytest.param(CLOSED, marks=pytest.mark.slow, id="all")],
)
def test_families_at_half_the_resolution(families):
    """All families together: one bay that is just deep enough on one of the grids says nothing."""
    both = either = 0
    for family in families:
        scene = worlds.sample(family, 1)
        shape = tuple(2 * n for n in scene.occupied.shape)
        fine = dead_ends(worlds.rasterise(scene.world, scene.origin, shape, 0.05), 0.05).label
        coarse = dead_ends(scene.occupied, 0.1).label.repeat(2, axis=0).repeat(2, axis=1)
        both, either = both + (coarse & fine).sum(), either + (coarse | fine).sum()
    assert both / either >= RESAMPLED


@pytest.mark.parametrize("seed", range(3))
def test_no_obstacle_inside_opens_a_cell(seed):
    """Pillars and boxes at random, in tubes of random width: while the gate is as wide, the label stays."""
    rng = np.random.default_rng(seed)
    for _ in range(8):
        width = rng.uniform(1.4, 3.4)
        walls = ((5, 5, 5.3, 15), (5.3 + width, 5, 5.6 + width, 15), (5, 14.7, 5.6 + width, 15))
        empty = draw(*walls)
        y, x = rng.uniform((5.3, 6.2 + width), (5.2 + width, 14.2))
        filled = empty | draw((y, x, y + rng.uniform(0.1, 0.8), x + rng.uniform(0.1, 0.5)))
        before, after = dead_ends(empty, 0.1), dead_ends(filled, 0.1)
        np.testing.assert_array_equal(before.mouth[0], after.mouth[0])
        may_stand = reference.clearance(filled, 0.1) > 0.25
        assert before.label.any() and not (before.label & may_stand & ~after.label).any()


@pytest.mark.slow
def test_real_floor_turned_and_mirrored(shared_data):
    scene = worlds.load_map_server(shared_data / "maps/willow/willow-2010-02-18-0.10.yaml")
    label = dead_ends(scene.occupied, 0.1, LabelSpec(mouth=2.5)).label
    for turn in (np.rot90, np.fliplr, np.flipud, np.transpose):
        turned = dead_ends(np.ascontiguousarray(turn(scene.occupied)), 0.1, LabelSpec(mouth=2.5)).label
        assert np.mean(turned == turn(label)) >= SYMMETRY
