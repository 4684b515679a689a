import subprocess
import sys

import numpy as np
import pytest
from PIL import Image, ImageSequence

from drnav_jax.types import GridMap
from drnav_jax.viz import Frame, MissingExtra, belief, look, marks
from drnav_jax.viz.animation import HEADER

TRIP = {"goal": (22.5, 0.0), "goal_tolerance": 0.75, "radius": 0.25}


def pictures(file) -> list[np.ndarray]:
    with Image.open(file) as film:
        return [np.asarray(picture.convert("RGB")) for picture in ImageSequence.Iterator(film)]


@pytest.fixture(scope="module")
def shown(case, frames, tmp_path_factory) -> list[np.ndarray]:
    """The cul-de-sac's film, with the true map."""
    file = tmp_path_factory.mktemp("film") / "a.gif"
    truth = {"true_occupied": case.occupied, "true_origin": (-3.0, -10.0), "true_resolution": 0.1}
    return pictures(belief(file, frames, **TRIP, **truth))


def patch(**changes) -> Frame:
    """A 12 x 8 m belief: left half known, a wall at large y, a dead end at small y."""
    occupancy = np.full((40, 60), -1.0)
    occupancy[:, :30] = 0.02
    occupancy[34:37, 5:25] = 0.98
    dead = np.full((40, 60), look.PRIOR)
    dead[:10] = 0.9
    fields = {
        "pose": np.asarray([3.0, 4.0, 0.0]),
        "path": np.asarray([[1.0, 4.0], [3.0, 4.0]]),
        "occupancy": GridMap(occupancy, np.zeros(2), 0.2),
        "p_dead": GridMap(dead, np.zeros(2), 0.2),
        "recovery_points": np.zeros((0, 2)),
        "local_goal": np.asarray([3.0, 5.5]),
        "mode": "drive",
        "time": 1.0,
    }
    return Frame(**(fields | changes))


def still(tmp_path, frame: Frame, **changes) -> np.ndarray:
    inputs = {"goal": (10.0, 4.0), "goal_tolerance": 0.5, "radius": 0.25, **changes}
    return pictures(belief(tmp_path / "still.gif", [frame], **inputs))[0]


DEAD = "#" + "".join(f"{round(255 * float(c)):02x}" for c in look.over_white(look.heat(0.9)))


def test_a_film_is_small_and_steady(frames, tmp_path):
    file = belief(tmp_path / "new" / "a.gif", frames, **TRIP, fps=5)
    with Image.open(file) as film:
        assert film.n_frames == len(frames) and film.width == 640 and 300 <= film.height <= 720
        assert film.info["duration"] == 200 and film.info["loop"] == 0
        film.seek(film.n_frames - 1)
        assert film.info["duration"] == 1500  # the end is held
    assert file.stat().st_size < 30_000 * len(frames)  # 3 MB for a hundred frames


def test_what_does_not_change_does_not_flicker(shown):
    """Around the goal, before it is seen, and in the legend, every frame is the same to the bit."""
    first = shown[0]
    for picture in shown[1:5]:
        np.testing.assert_array_equal(
            picture[HEADER + 150 : HEADER + 250, 520:], first[HEADER + 150 : HEADER + 250, 520:]
        )
        np.testing.assert_array_equal(picture[-marks.LEGEND_HEIGHT :], first[-marks.LEGEND_HEIGHT :])


def test_colours_are_those_of_the_legend(shown, spot):
    ground = shown[5][HEADER : -marks.LEGEND_HEIGHT]
    for colour in (look.UNKNOWN, look.WALL, look.RECOVERY, marks.UNSEEN_WALL, marks.ROBOT, marks.LOCAL_GOAL):
        assert spot(ground, colour, 0).count > 20, colour


def test_y_is_up_and_heat_and_marks_are_in_place(tmp_path, spot):
    picture = still(tmp_path, patch())
    ground = picture[HEADER : -marks.LEGEND_HEIGHT]
    wall, dead, unknown = (spot(ground, colour, 6) for colour in (look.WALL, DEAD, look.UNKNOWN))
    robot, local = spot(ground, marks.ROBOT), spot(ground, marks.LOCAL_GOAL)
    assert wall.y < local.y < robot.y < dead.y
    assert abs(robot.x - local.x) < 12 and dead.x < unknown.x
    scale = wall.width / 4.0  # 20 cells of 0.2 m
    np.testing.assert_allclose((wall.height, dead.width, dead.height), np.asarray([0.6, 6.0, 2.0]) * scale, atol=2.5)
    assert (robot.y - local.y) / scale == pytest.approx(1.5, abs=0.1)


def test_no_heat_on_walls_nor_on_the_unknown(tmp_path, spot):
    everywhere = GridMap(np.full((40, 60), 0.9), np.zeros(2), 0.2)
    ground = still(tmp_path, patch(p_dead=everywhere))[HEADER : -marks.LEGEND_HEIGHT]
    assert spot(ground, look.WALL, 6).count > 1000 and spot(ground, look.UNKNOWN, 6).count > 50_000


def test_known_ground_without_evidence_is_white(tmp_path, spot):
    nothing = GridMap(np.full((40, 60), look.PRIOR, np.float32), np.zeros(2), 0.2)
    ground = still(tmp_path, patch(p_dead=nothing))[HEADER : -marks.LEGEND_HEIGHT]
    assert spot(ground, "#ffffff", 0).count > 30_000


def test_the_true_map_is_a_hint_in_the_unknown_only(tmp_path, spot):
    truth = np.zeros((80, 120), bool)
    truth[60:64, 70:110] = True  # x 7..11 m, y 6..6.4 m, unknown
    truth[40:44, 10:50] = True  # known to be free
    ground = still(tmp_path, patch(), true_occupied=truth, true_resolution=0.1)[HEADER : -marks.LEGEND_HEIGHT]
    hint, robot = spot(ground, marks.UNSEEN_WALL), spot(ground, marks.ROBOT)
    assert hint.x > robot.x and (robot.y - hint.y) / hint.width == pytest.approx(2.2 / 4.0, abs=0.02)
    assert hint.width / hint.height == pytest.approx(10.0, rel=0.1)
    near = (np.abs(ground[:, : int(robot.x)].astype(int) - look.rgb(marks.UNSEEN_WALL)) <= 2).all(axis=-1)
    assert near.sum() < 20


def test_walls_thinner_than_a_pixel_are_seen(tmp_path, spot):
    truth = np.zeros((3000, 4000), bool)
    truth[1111] = True  # 1 cm of 30 m
    ground = still(tmp_path, patch(), true_occupied=truth, true_resolution=0.01)[HEADER : -marks.LEGEND_HEIGHT]
    far = still(tmp_path, patch(), true_occupied=truth, true_resolution=0.01, goal=(38.0, 25.0))
    assert spot(ground, marks.UNSEEN_WALL).count == 0  # y = 11.1 m is out of this view
    assert spot(far[HEADER : -marks.LEGEND_HEIGHT], marks.UNSEEN_WALL).width > 300


def test_the_path_and_the_robot_advance(shown, spot):
    grounds = [picture[HEADER : -marks.LEGEND_HEIGHT] for picture in shown]
    ink = [(np.abs(g.astype(int) - look.rgb(marks.ROBOT)) <= 30).all(axis=-1).sum() for g in grounds]
    assert (np.diff(ink[:-1]) > 0).all()


def test_missing_things_are_left_out(tmp_path, spot):
    nowhere = patch(path=np.zeros((0, 2)), local_goal=np.full(2, np.nan), recovery_points=np.full((2, 2), np.nan))
    ground = still(tmp_path, nowhere)[HEADER : -marks.LEGEND_HEIGHT]
    assert spot(ground, marks.LOCAL_GOAL).count == 0 and spot(ground, look.RECOVERY).count == 0
    assert spot(ground, marks.ROBOT).count > 50


def test_long_films_are_thinned_to_first_and_last(frames, tmp_path, spot):
    thin = pictures(belief(tmp_path / "a.gif", frames, **TRIP, max_frames=4))
    full = pictures(belief(tmp_path / "b.gif", frames, **TRIP))
    alone = pictures(belief(tmp_path / "c.gif", frames, **TRIP, max_frames=1))
    assert len(thin) == 4 and len(alone) == 1
    for picture in (thin[-1], alone[0]):
        assert np.abs(picture.astype(int) - full[-1].astype(int)).mean() < 2.0  # other palette, same picture


def test_a_video_shows_the_same(frames, tmp_path):
    import imageio_ffmpeg

    still = pictures(belief(tmp_path / "a.gif", frames, **TRIP))
    file = belief(tmp_path / "a.mp4", frames, **TRIP, fps=4)
    # Not through imageio: its reader leaves pipes open.
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(file), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    video = np.frombuffer(raw, np.uint8).reshape(-1, *still[0].shape)
    assert len(video) == len(frames) + 6  # held for 1.5 s
    assert np.abs(video[4].astype(int) - still[4].astype(int)).mean() < 5.0  # lossy


@pytest.mark.parametrize(
    ("file", "changes", "message"),
    [
        ("a.avi", {}, r"\.gif, \.mp4"),
        ("a.gif", {"frames": []}, "at least one frame"),
        ("a.gif", {"max_frames": 0}, "max_frames"),
        ("a.gif", {"fps": 0.0}, "fps"),
    ],
)
def test_wrong_inputs_are_named(frames, tmp_path, file, changes, message):
    with pytest.raises(ValueError, match=message):
        belief(tmp_path / file, **({"frames": frames} | TRIP | changes))
    assert not list(tmp_path.iterdir())


def test_the_missing_extra_is_named(frames, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtra, match=r"pip install drnav_jax\[viz\]"):
        belief(tmp_path / "a.mp4", frames[:1], **TRIP)
