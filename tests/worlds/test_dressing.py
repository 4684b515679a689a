import numpy as np
import pytest

from drnav_jax.worlds import FAMILIES, FLOORS, HELD_OUT, Material, make_world, sample, shortest_path, signed_distance, twin
from drnav_jax.worlds.dressing import COLOURS, INDOOR, LIGHT, ROLES, SETTINGS, Look
from drnav_jax.worlds.ranges import RANGES
from drnav_jax.worlds.solids import Solid, box, post
from drnav_jax.worlds.world import WALL_HEIGHT

NEAR = 1.5  # [m] what a robot passes at this distance, it passes by
ROBOT = 0.33


def split_of(family):
    return "test" if family in HELD_OUT else "train"


def described(scene):
    """Each solid as one tuple: its rows, its material and its colour."""
    w = scene.world
    groups = ((w.boxes, w.box_surfaces), (w.cylinders, w.cylinder_surfaces))
    return {
        (*row.tolist(), int(m), *c.tolist()) for rows, s in groups for row, m, c in zip(rows, *s, strict=True)
    }


def test_the_same_seed_looks_the_same_and_others_do_not():
    one, again, other = sample("cars", 3), sample("cars", 3), sample("cars", 4)
    assert described(one) == described(again)
    assert int(one.world.scenery.texture_seed) != int(other.world.scenery.texture_seed)


def test_a_role_looks_the_same_whatever_is_asked_before():
    first, second = (Look(SETTINGS["field"], [1, 2], False) for _ in range(2))
    solids = [box((0.0, 0.0, 1.0, 1.0), role) for role in ("heap:1", "wall", "crate:3", "end")]
    forth, back = first.surfaces(solids), second.surfaces(solids[::-1])
    np.testing.assert_array_equal(forth.material, back.material[::-1])
    np.testing.assert_array_equal(forth.colour, back.colour[::-1])


@pytest.mark.parametrize("test", [False, True])
def test_light_stays_in_the_ranges_of_the_split(test):
    ranges = {name: both[test] for name, both in LIGHT.items()}
    for seed in range(60):
        look = Look(SETTINGS["glass"], [7, seed], test)
        s = look.scenery
        assert np.linalg.norm(s.sun) == pytest.approx(1.0)
        assert ranges["elevation"][0] <= np.degrees(np.arcsin(s.sun[2])) <= ranges["elevation"][1]
        assert ranges["exposure"][0] <= s.exposure <= ranges["exposure"][1]
        assert ranges["ambient"][0] <= s.ambient - (INDOOR if look.indoor else 0) + 1e-9
        assert s.fog <= ranges["fog"][1] and (s.fog == 0 or not look.indoor)
        assert (s.ceiling == look.height and WALL_HEIGHT <= look.height <= 3.0) if look.indoor else np.isinf(s.ceiling)
        assert Material(s.ground_material) in FLOORS
        for colour in (s.ground_colour, s.wall_colour, s.ceiling_colour, s.sky_colour):
            assert np.shape(colour) == (3,) and (np.array(colour) >= 0).all() and (np.array(colour) <= 1).all()


def test_light_of_the_test_split_is_wider():
    for train, test in LIGHT.values():
        assert test[0] <= train[0] <= train[1] <= test[1] and train != test


def test_walls_reach_the_ceiling():
    look = next(found for k in range(99) if (found := Look(SETTINGS["glass"], [3, k], False)).indoor)
    square = (0.0, 0.0, 1.0, 1.0)
    world = look.world([box(square), box(square, "crate:0", 0.0, 1.2), post(0.0, 0.0, 1.0, "trunk", 2.0)])
    np.testing.assert_allclose(world.boxes[:, 6], [look.height, 1.2], rtol=1e-6)
    assert world.cylinders[0, 4] == 2.0


def test_every_family_has_a_setting_and_every_material_a_colour():
    assert set(SETTINGS) == set(RANGES) == set(FAMILIES.values())
    made = {m for choices in ROLES.values() for m in choices}
    made |= {m for s in SETTINGS.values() for m in (*s.walls, *s.inner_walls, *s.grounds, *s.floors)}
    assert made == set(Material) == set(COLOURS)


def test_strata_are_those_of_the_materials():
    look = Look(SETTINGS["dock"], [0, 0], True)
    roles = ("wall", "grass", "drop", "pane", "bush")
    assert look.strata([box((0.0, 0.0, 1.0, 1.0), r) for r in roles]) == ("drop", "glass", "vegetation")
    assert look.strata([box((0.0, 0.0, 1.0, 1.0), "lift")]) == ()


def passed_by(scene, material):
    """Whether the shortest path comes by something of a material."""
    solid = [d for d in described(scene) if d[-4] == material]
    rows = [d[:-4] for d in solid]
    solids = make_world([r for r in rows if len(r) == 7], [r for r in rows if len(r) == 5])
    _, path = shortest_path(scene, scene.start, scene.goal, ROBOT)
    dense = np.concatenate([np.linspace(a, b, 50) for a, b in zip(path[:-1], path[1:], strict=True)])
    return bool(rows) and signed_distance(solids, dense).min() < NEAR


@pytest.mark.parametrize(
    ("family", "closing"),
    [
        ("glass", Material.GLASS),
        ("dock", Material.DROP),
        ("trail", Material.BUSH),
        ("cars", Material.CAR),
        ("lobby", Material.METAL),
        ("room", None),
    ],
)
def test_what_closes_a_way_also_stands_beside_open_ones(family, closing):
    passed = 0
    for seed in range(8):
        closed, opened = (sample(f, seed, split_of(family)) for f in (family, twin(family)))
        plug = {d[-4] for d in described(closed) - described(opened)}
        made = closing if closing is not None else next(iter(plug))
        assert made in plug and (closing is not None or made in (Material.WOOD, Material.METAL))
        passed += passed_by(opened, made)
    assert passed >= 4


@pytest.mark.parametrize(("family", "material"), [("dock", Material.STRIPE), ("trail", Material.GRASS)])
def test_what_one_may_drive_over_lies_on_ways_and_in_dead_ends(family, material):
    crossed = 0
    for seed in range(6):
        closed, opened = (sample(f, seed, split_of(family)) for f in (family, twin(family)))
        crossed += passed_by(opened, material) and passed_by(closed, material)
        assert material in {d[-4] for d in described(closed) & described(opened)}
    assert crossed >= 3


def test_solids_know_whether_they_are_boxes():
    assert box((0.0, 0.0, 1.0, 1.0)).is_box and not post(0.0, 0.0, 1.0, "trunk", 2.0).is_box
    assert Solid(np.zeros(7), "wall").is_box
