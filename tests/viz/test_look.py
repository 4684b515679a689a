import numpy as np
import pytest

from drnav_jax.viz import look


def test_the_heat_is_silent_at_the_prior_and_grows_on_both_sides():
    p = np.asarray([0.001, 0.02, 0.06, 0.1, 0.3, 0.9, np.nan], np.float32)
    opacity = look.heat(p, 0.06)[:, 3]
    np.testing.assert_allclose(opacity[[2, 6]], 0.0, atol=1e-6)  # the prior in float32
    assert (np.diff(opacity[:3]) < 0).all() and opacity[0] == np.float32(look.OPEN_OPACITY)
    assert (np.diff(opacity[2:5]) > 0).all() and opacity[5] == np.float32(look.DEAD_OPACITY)


def test_green_means_less_than_the_prior_and_red_more():
    low, high = look.heat(np.asarray([0.01, 0.99]), 0.06)
    assert low[1] > low[0] and high[0] > 3 * high[1]


def test_lightness_falls_with_risk():
    shades = look.over_white(look.heat(np.linspace(0.3, 1.0, 20))) @ np.asarray([0.2126, 0.7152, 0.0722])
    assert (np.diff(shades) < 0).all()


@pytest.mark.parametrize("prior", [0.0, 1.0, -0.1])
def test_a_prior_is_a_probability(prior):
    with pytest.raises(ValueError, match="prior"):
        look.heat(np.zeros(3), prior)


def test_planners_keep_the_papers_colours_and_others_differ():
    names = ["mppi", "drnav", "one", "two", "dwa", "dwb", "grid", "three"]
    found = look.strokes(names)
    assert list(found) == names
    assert found["drnav"] is look.STROKES["drnav"] and found["one"].label == "one"
    assert len({(s.colour, s.dashes) for s in found.values()}) == len(names)


@pytest.mark.parametrize("points", [[[0, 0]], [[0, 0], [20, 1]], [[0, 0], [1, 20]], [[0, 0], [np.nan, 1], [9, 9]]])
@pytest.mark.parametrize("bounds", [None, (-1.0, -4.0, 30.0, 22.0), (2.0, 2.0, 3.0, 3.0)])
def test_the_region_holds_all_points_and_is_no_strip(points, bounds):
    points = np.asarray(points, float)
    x0, y0, x1, y1 = look.region(points, margin=2.0, aspect=(0.6, 2.5), bounds=bounds)
    finite = points[np.isfinite(points).all(axis=1)]
    assert (finite > (x0, y0)).all() and (finite < (x1, y1)).all()
    assert 0.6 - 1e-9 <= (x1 - x0) / (y1 - y0) <= 2.5 + 1e-9


def test_room_beyond_the_map_is_spent_inside_it():
    # A trip along the lower wall: the room that the shape of the picture asks for is taken above.
    x0, y0, x1, y1 = look.region(
        np.asarray([[2.0, 1.0], [28.0, 1.0]]), margin=2.0, aspect=(0.6, 2.0), bounds=(0.0, 0.0, 30.0, 20.0)
    )
    np.testing.assert_allclose((x0, x1, y1 - y0), (0.0, 30.0, 15.0))
    assert y0 >= -1e-9
