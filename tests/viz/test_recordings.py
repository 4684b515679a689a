"""The page of recorded frames: where forward and left are, and what is drawn where nothing is known."""

import numpy as np
import pytest
from PIL import Image

from drnav_jax.viz import Predicted, look, predictions, recordings


def frame(**changes):
    h, w = 8, 12
    known = np.ones((h, w), int)
    known[:, -2:] = 0  # unknown far ahead
    known[-1] = 2  # a wall to the left
    fields = {
        "title": "1", "photos": [np.full((20, 60, 3), (0, 0, 255), np.uint8)],
        "cloud": np.zeros((0, 3)), "points": np.zeros((0, 3)), "local_map": known, "judged": known == 1,
        "p_dead": np.full((h, w), look.PRIOR), "traversable": np.ones((h, w)), "p_open": np.full(3, 0.5), "p_flag": 0.25,
    } | changes  # fmt: skip
    return Predicted(**fields)


def test_forward_is_up_and_left_is_left():
    dead = np.full((8, 12), look.PRIOR)
    dead[6, 9] = 0.99  # ahead and to the left
    given = frame(p_dead=dead)
    shown = recordings.cells(given, look.over_white(look.heat(dead)))
    assert shown.shape == (12, 8, 3)
    row, column = np.unravel_index(np.argmax(shown[..., 0] - shown[..., 1]), shown.shape[:2])
    assert (row, column) == (12 - 1 - 9, 8 - 1 - 6)
    np.testing.assert_allclose(shown[:, 0], recordings.KNOWN[2] * np.ones((12, 3)))  # the wall
    np.testing.assert_allclose(shown[0, 1:], recordings.KNOWN[0] * np.ones((7, 3)))  # nothing is known there


def test_pages_hold_every_frame(tmp_path):
    cloud = np.random.default_rng(0).normal(size=(100, 3))
    some = [frame(), frame(photos=[]), frame(cloud=cloud, points=cloud)]
    sizes = []
    for columns in (1, 2, 3):
        file = predictions(tmp_path / "new" / f"{columns}.png", some, (0.0, 0.0), 0.2, columns=columns, note="whose")
        with Image.open(file) as page:
            sizes.append(page.size)
            blue = np.abs(np.asarray(page.convert("RGB"), int).reshape(-1, 3) - (0, 0, 255)) < 12
            assert blue.all(axis=1).sum() > 5000  # two photos
    assert sizes[0][0] < sizes[1][0] < sizes[2][0] and sizes[0][1] > sizes[1][1] > sizes[2][1]
    with pytest.raises(ValueError, match="no frame"):
        predictions(tmp_path / "a.png", [], (0.0, 0.0), 0.2)
