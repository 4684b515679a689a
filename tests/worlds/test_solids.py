import math

import numpy as np
import pytest

from drnav_jax.worlds import Material, make_world, signed_distance, surfaces
from drnav_jax.worlds.solids import LINTEL, leaf, portal, wall


def test_a_wall_covers_its_segment_and_half_its_thickness_beyond():
    row = wall((1.0, 2.0), (4.0, 6.0), 0.2).row
    world = make_world([[*row[:6], 2.5]])
    along, across = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    for end, way in (((1.0, 2.0), -1), ((4.0, 6.0), 1)):
        for offset in (0.0, 0.09, -0.09):
            inner, outer = (end + way * d * along + offset * across for d in (0.095, 0.105))
            assert signed_distance(world, inner[None])[0] < 0 < signed_distance(world, outer[None])[0]


@pytest.mark.parametrize("along_x", [True, False])
def test_a_portal_leaves_its_opening_free(along_x):
    solids = portal(3.0, -1.0, along_x, 1.4, "frame", 0.1, 0.2)
    world = make_world([s.row for s in solids], box_surfaces=surfaces(3, Material.METAL))
    middle = np.array([[3.0, -1.0]])
    assert signed_distance(world, middle)[0] == pytest.approx(0.7, abs=1e-6)
    aside = middle + (np.array([0, 0.71]) if along_x else np.array([0.71, 0]))
    assert signed_distance(world, aside)[0] < 0
    assert [s.row[5] for s in solids] == [0.0, 0.0, LINTEL]


def test_a_leaf_swings_about_its_hinge():
    for angle in (0.0, 1.0, math.pi / 2, -2.5):
        x, y, yaw, half, *_ = leaf((2.0, 1.0), angle, 1.2, "leaf").row
        np.testing.assert_allclose((x - half * math.cos(yaw), y - half * math.sin(yaw)), (2.0, 1.0), atol=1e-12)
