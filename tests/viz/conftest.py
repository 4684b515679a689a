"""A cul-de-sac as a robot would meet it: truth, two trips and the belief along one of them."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy import ndimage

from drnav_jax.types import GridMap
from drnav_jax.viz import Frame

RESOLUTION = 0.1
ORIGIN = (-3.0, -10.0)
SHAPE = (200, 300)  # 30 x 20 m


class Case(NamedTuple):
    occupied: np.ndarray
    dead: np.ndarray  # [H, W] bool: the inside of the U
    escape: np.ndarray  # [T, 2]
    trapped: np.ndarray  # [T, 2]


def resample(corners: np.ndarray, step: float = 0.1) -> np.ndarray:
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    at = np.arange(0.0, s[-1], step)
    line = np.stack([np.interp(at, s, corners[:, k]) for k in (0, 1)], axis=-1)
    kernel = np.ones(15) / 15  # round the corners
    padded = np.pad(line, ((7, 7), (0, 0)), mode="edge")
    return np.stack([np.convolve(padded[:, k], kernel, "valid") for k in (0, 1)], axis=-1)


def cul_de_sac() -> Case:
    x = ORIGIN[0] + (np.arange(SHAPE[1]) + 0.5) * RESOLUTION
    y = ORIGIN[1] + (np.arange(SHAPE[0]) + 0.5) * RESOLUTION
    x, y = x[None, :], y[:, None]
    outer = (x > 5) & (x < 14.4) & (np.abs(y) < 3.4)
    inner = (x < 14) & (np.abs(y) < 3)
    occupied = outer & ~inner
    occupied |= (x < -2.7) | (x > 26.7) | (y < -9.7) | (y > 9.7)
    occupied |= np.hypot(x - 18, y - 4) < 0.8
    occupied |= (np.abs(x - 10) < 1) & (np.abs(y + 7) < 0.6)
    dead = (x > 5) & (x < 14) & (np.abs(y) < 3)
    escape = resample(np.asarray([[0, 0], [3.5, 0.4], [5, 4.4], [14.5, 4.6], [19, 1.5], [22.3, 0]]))
    trapped = resample(np.asarray([[0, 0], [5, -0.3], [13, 0], [13.3, 1.5], [12.5, 0.5], [13.4, -0.8]]))
    return Case(occupied, dead, escape, trapped)


def film(case: Case, count: int) -> list[Frame]:
    """Frames along the way out, with what a 7 m sensor has swept (walls not opaque) as the known part."""
    h, w = 160, 160
    frames, seen = [], np.zeros(SHAPE, bool)
    x = ORIGIN[0] + (np.arange(SHAPE[1]) + 0.5) * RESOLUTION
    y = ORIGIN[1] + (np.arange(SHAPE[0]) + 0.5) * RESOLUTION
    rng = np.random.default_rng(0)
    for k in np.linspace(0, len(case.escape) - 1, count).astype(int):
        px, py = case.escape[k]
        ahead = case.escape[min(k + 1, len(case.escape) - 1)] - case.escape[max(k - 1, 0)]
        seen |= np.hypot(x[None] - px, y[:, None] - py) < 7.0
        corner = np.round((np.asarray([px, py]) - ORIGIN) / RESOLUTION / 8).astype(int) * 8 - [w // 2, h // 2]
        truth = np.pad(case.occupied, 200)[corner[1] + 200 :, corner[0] + 200 :][:h, :w]
        dead = np.pad(case.dead, 200)[corner[1] + 200 :, corner[0] + 200 :][:h, :w]
        known = np.pad(seen, 200)[corner[1] + 200 :, corner[0] + 200 :][:h, :w]
        rise = min(1.0, k / 60)
        p = np.where(dead, 0.06 + 0.85 * rise, np.where(known, 0.06 - 0.04 * rise, 0.06))
        p = np.clip(p + 0.02 * rng.standard_normal(p.shape) * dead, 0, 1)
        origin = np.asarray(ORIGIN) + corner * RESOLUTION
        frames.append(
            Frame(
                pose=np.asarray([px, py, np.arctan2(ahead[1], ahead[0])]),
                path=case.escape[: k + 1],
                occupancy=GridMap(np.where(known, np.where(truth, 0.95, 0.04), -1.0), origin, RESOLUTION),
                p_dead=GridMap(p, origin, RESOLUTION),
                recovery_points=np.asarray([[4.2, 0.2], [4.4, 4.0]]) if k > 10 else np.zeros((0, 2)),
                local_goal=case.escape[min(k + 35, len(case.escape) - 1)],
                mode="recover" if 30 < k < 60 else "drive",
                time=k * 0.13,
            )
        )
    return frames


@pytest.fixture(scope="session")
def case() -> Case:
    return cul_de_sac()


@pytest.fixture(scope="session")
def frames(case) -> list[Frame]:
    return film(case, 12)


class Spot(NamedTuple):
    """The largest patch of one colour: its middle and its box, in pixels from the upper left."""

    x: float
    y: float
    width: int
    height: int
    count: int


@pytest.fixture(scope="session")
def spot():
    def find(picture: np.ndarray, colour: str, tolerance: int = 3) -> Spot:
        wanted = np.asarray([int(colour[k : k + 2], 16) for k in (1, 3, 5)])
        near = (np.abs(picture[..., :3].astype(int) - wanted) <= tolerance).all(axis=-1)
        patches, count = ndimage.label(near)
        if not count:
            return Spot(np.nan, np.nan, 0, 0, 0)
        largest = 1 + int(np.argmax(ndimage.sum_labels(near, patches, np.arange(1, count + 1))))
        y, x = np.nonzero(patches == largest)
        return Spot(float(x.mean()), float(y.mean()), int(np.ptp(x)) + 1, int(np.ptp(y)) + 1, len(x))

    return find
