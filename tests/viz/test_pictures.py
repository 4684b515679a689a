import sys

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from drnav_jax.types import GridMap
from drnav_jax.viz import MissingExtra, look, trajectories


def hexed(colour: np.ndarray) -> str:
    return "#" + "".join(f"{round(255 * float(c)):02x}" for c in colour)


DEAD = hexed(look.over_white(look.heat(0.9)))  # what P_dead = 0.9 looks like on free ground
WHERE = {"origin": (-3.0, -10.0), "resolution": 0.1, "start": (0.0, 0.0, 0.0), "goal": (22.5, 0.0)}


@pytest.fixture
def draw(case, tmp_path):
    """Draws the cul-de-sac, with some arguments replaced; the picture `[h, w, 3]`."""

    def run(**changes) -> np.ndarray:
        inputs = {
            "occupied": case.occupied,
            "goal_tolerance": 0.75,
            "paths": {"drnav": case.escape},
            **WHERE,
            **changes,
        }
        with Image.open(trajectories(tmp_path / "picture.png", **inputs)) as picture:
            return np.asarray(picture.convert("RGB"))

    return run


def heat(case) -> GridMap:
    return GridMap(np.where(case.dead, 0.9, look.PRIOR), np.asarray(WHERE["origin"]), 0.1)


def test_a_whole_picture_has_a_sane_size(case, tmp_path):
    file = trajectories(
        tmp_path / "new" / "a.png",
        occupied=case.occupied,
        goal_tolerance=0.75,
        paths={"drnav": case.escape, "dwa": case.trapped},
        outcome={"drnav": "reached in 23.4 s", "dwa": "stuck: time limit"},
        p_dead=heat(case),
        known=case.dead,
        recovery_points=np.asarray([[4.2, 0.2], [4.4, 4.0]]),
        shortest=np.asarray([[0.0, 0.0], [4.9, 3.6], [14.4, 3.6], [22.5, 0.0]]),
        title="cul-de-sac",
        **WHERE,
    )
    with Image.open(file) as picture:
        assert 1000 <= picture.width <= 1400 and 600 <= picture.height <= 1400
    assert 2e4 < file.stat().st_size < 5e5


def test_y_is_up_and_x_is_right(draw, spot):
    occupied = np.zeros((200, 300), bool)
    occupied[150:160, 50:90] = True  # x 2..6 m, y 5..6 m
    p_dead = GridMap(np.where(np.arange(200)[:, None] < 60, 0.9, look.PRIOR) * np.ones(300), np.asarray((-3, -10)), 0.1)
    picture = draw(occupied=occupied, p_dead=p_dead, paths={"drnav": np.asarray([[0.0, -6.0], [20.0, 6.0]])})
    wall, dead, goal = (spot(picture, colour) for colour in (look.WALL, DEAD, look.GOAL))
    assert wall.y < goal.y < dead.y and wall.x < goal.x
    assert abs(wall.width / wall.height - 4.0) < 0.2  # one scale for both axes


def test_the_heat_fills_the_dead_end(draw, case, spot):
    dead = spot(draw(p_dead=heat(case)), DEAD)
    assert dead.width / dead.height == pytest.approx(9 / 6, abs=0.05)


def test_the_beliefs_grid_need_not_be_the_maps(draw, case, spot):
    fine = spot(draw(p_dead=heat(case)), DEAD)
    window = case.dead[::2, ::2][20:, 10:120]
    coarse = GridMap(jnp.asarray(np.where(window, 0.9, look.PRIOR)), jnp.asarray((-1.0, -6.0)), 0.2)
    found = spot(draw(p_dead=coarse), DEAD)
    np.testing.assert_allclose(found[:4], fine[:4], atol=6)  # a pixel is 0.023 m, half a cell 0.1 m


def test_no_heat_where_nothing_is_known(draw, case, spot):
    known = np.zeros_like(case.dead)
    assert spot(draw(p_dead=heat(case), known=known), DEAD).count < 200  # the legend's
    assert spot(draw(p_dead=heat(case), known=~known), DEAD).count > 50_000
    assert spot(draw(), DEAD).count == 0


def test_a_failure_is_marked(draw, case, spot):
    """The cross is larger than the dot: in the map it covers more of the planner's colour."""

    def of_dwa(outcome: str) -> int:
        picture = draw(paths={"dwa": case.trapped[-1:]}, outcome={"dwa": outcome})
        return spot(picture[: int(0.75 * len(picture))], look.STROKES["dwa"].colour, 40).count

    assert of_dwa("stuck: time limit") > 1.5 * of_dwa("reached in 9.0 s") > 0


def test_ends_in_one_corner_are_all_seen(draw, case, spot):
    paths = {name: case.trapped for name in ("dwa", "dwb", "mppi")}
    picture = draw(paths=paths, outcome=dict.fromkeys(paths, "stuck"))[:500]
    corner = picture[:, picture.shape[1] // 2 :]  # beyond the way in
    for name in paths:
        assert spot(corner, look.STROKES[name].colour, 40).count > 15


def test_a_short_trip_fills_the_picture(draw, spot):
    near = draw(goal=(3.0, 0.0), paths={"drnav": np.asarray([[0.0, 0.0], [2.5, 0.0]])})
    far = draw()
    assert spot(near, "#fff4c7", 4).width > 3 * spot(far, "#fff4c7", 4).width  # the tolerance disc


@pytest.mark.parametrize("shape", [(800, 60), (60, 800), (200, 300)])
def test_nothing_is_cut_off(draw, shape):
    """The rim is white whatever the shape, with many planners and long words."""
    ends = np.asarray([[0.5, 0.5], [shape[1] * 0.1 - 0.5, shape[0] * 0.1 - 0.5]]) - 1300.0
    line = np.linspace(*ends, 50)
    names = ["drnav", "mppi", "dwb", "dwa", "grid", "drnav-straight", "grid+ede"]
    picture = draw(
        occupied=np.zeros(shape, bool),
        origin=(-1300.0, -1300.0),
        start=(*line[0].tolist(), 1.0),
        goal=tuple(line[-1].tolist()),
        paths={name: line for name in names},
        outcome=dict.fromkeys(names, "stuck: no way out within the time limit"),
        p_dead=GridMap(np.full((5, 7), 0.9), np.zeros(2), 0.3),
        title="a name",
    )
    assert 1000 <= picture.shape[1] <= 1400
    for rim in (picture[:4], picture[-4:], picture[:, :4], picture[:, -4:]):
        assert (rim == 255).all()


def test_thin_walls_survive_in_a_large_building(draw, spot):
    occupied = np.zeros((1200, 1300), bool)
    occupied[50::100] = True
    line = np.asarray([[-27.0, -28.0], [33.0, 27.0]])
    picture = draw(occupied=occupied, origin=(-30.0, -30.0), resolution=0.05, goal=(33.0, 27.0), paths={"drnav": line})
    dark = (np.abs(picture.astype(int) - look.rgb(look.WALL)) <= 3).all(axis=-1)
    rows = dark[:, : picture.shape[1] // 2].sum(axis=1) > 0.35 * picture.shape[1]
    assert (np.diff(rows.astype(int)) == 1).sum() == 12


def test_one_point_is_a_path(draw, spot):
    picture = draw(paths={"drnav": np.asarray([[10.0, 7.0]])})
    assert spot(picture[:500], look.STROKES["drnav"].colour, 40).count > 60


@pytest.mark.parametrize("suffix", [".pdf", ".svg"])
def test_vector_formats(case, tmp_path, suffix):
    file = trajectories(
        tmp_path / f"a{suffix}", occupied=case.occupied, goal_tolerance=0.75, paths={"grid": case.escape}, **WHERE
    )
    assert file.read_bytes()[:5] == {".pdf": b"%PDF-", ".svg": b"<?xml"}[suffix]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"paths": {}}, "paths is empty"),
        ({"paths": {"dwa": np.zeros((0, 2))}}, '"dwa" has no finite point'),
        ({"paths": {"dwa": np.full((3, 2), np.nan)}}, '"dwa" has no finite point'),
        ({"paths": {"dwa": np.zeros((3, 3))}}, r"must be \[N, 2\]"),
        ({"occupied": np.zeros(5, bool)}, r"must be \[H, W\]"),
        ({"start": (0.0, 0.0)}, "start must be x, y, yaw"),
        ({"p_dead": GridMap(np.zeros((4, 5)), np.zeros(2), 0.1), "known": np.zeros((5, 4), bool)}, "shape of p_dead"),
    ],
)
def test_wrong_inputs_are_named(draw, changes, message):
    with pytest.raises(ValueError, match=message):
        draw(**changes)


def test_an_unknown_suffix_names_the_known_ones(case, tmp_path):
    with pytest.raises(ValueError, match=r"\.png, \.pdf, \.svg"):
        trajectories(tmp_path / "a.bmp", occupied=case.occupied, goal_tolerance=1.0, paths={"d": case.escape}, **WHERE)
    assert not list(tmp_path.iterdir())


def test_the_missing_extra_is_named(draw, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtra, match=r"pip install drnav_jax\[viz\]"):
        draw()
