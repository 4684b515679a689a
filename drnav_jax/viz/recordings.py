"""What was predicted on recorded frames: photos, the cloud from above, dead ends, traversability; no truth is known.

From above forward is up and left is left; the robot stands at the mark. Cells without evidence are grey, occupied ones
dark.
"""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from drnav_jax.viz import look
from drnav_jax.viz.worldview import KNOWN

TRAVERSABLE = ((0.55, 0.16, 0.47), (0.97, 0.95, 0.84), (0.10, 0.50, 0.45))  # 0, 1/2, 1
HEIGHTS = (0.0, 2.5)  # [m] of the colours of points
POINTS = 12000  # drawn of a cloud
COLOURS = 256  # of a page
OCCUPIED = 2  # of `Predicted.local_map`
LEGEND = (
    "open: probability that the way to the front, left, right is. Dead ends: green no, yellow to red yes, dark occupied. "
    "Traversable: green yes, purple no. Grey: no evidence. Points: dark at the ground, yellow from 2.5 m up."
)


class Predicted(NamedTuple):
    """One frame; grids in base_link, row = +y, column = +x."""

    title: str
    photos: Sequence[np.ndarray]  # [rows, columns, 3] uint8, whatever there is
    cloud: np.ndarray  # [n, 3] all points [m]
    points: np.ndarray  # [P, 3] those that the network is given [m]
    local_map: np.ndarray  # [h, w] 0 unknown, 1 free, 2 occupied
    judged: np.ndarray  # [h, w] bool: there is evidence
    p_dead: np.ndarray  # [h, w]
    traversable: np.ndarray  # [h, w]
    p_open: np.ndarray  # [3] front, left, right
    p_flag: float


def _upright(grid: np.ndarray) -> np.ndarray:
    """A grid `[row = y, column = x, ...]` as a picture: x up, y to the left."""
    return grid.swapaxes(0, 1)[::-1, ::-1]


def cells(frame: Predicted, colours: np.ndarray) -> np.ndarray:
    """Colours `[h, w, 3]` where there is evidence, grey elsewhere, walls dark; as a picture, forward up."""
    out = np.where(frame.judged[..., None], colours, KNOWN[0])
    out[frame.local_map == OCCUPIED] = KNOWN[OCCUPIED]
    return _upright(out)


def _above(axes: Any, extent: tuple[float, float, float, float], picture: np.ndarray, title: str) -> None:
    left, right, low, high = extent
    axes.imshow(picture, extent=extent, interpolation="nearest")
    axes.plot(0, 0, "^", color=look.RECOVERY, markersize=4, markeredgecolor="white", markeredgewidth=0.5)
    axes.set_xlim(left, right)
    axes.set_ylim(low, high)
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=6, pad=2)
    axes.set_xticks([])
    axes.set_yticks([])


def _draw(figure: Any, spot: Any, frame: Predicted, origin: tuple[float, float], resolution: float) -> None:
    inner = spot.subgridspec(2, 1, height_ratios=(0.9, 1.0), hspace=0.1)
    shown = list(frame.photos) or [np.full((100, 330, 3), 200, np.uint8)]
    photos = inner[0].subgridspec(1, len(shown), wspace=0.02)
    for k, photo in enumerate(shown):
        axes = figure.add_subplot(photos[k])
        axes.imshow(photo)
        axes.set_axis_off()
        if k == 0:
            ways = "  ".join(f"{name} {p:.2f}" for name, p in zip("FLR", frame.p_open, strict=True))
            said = f"{frame.title}    open {ways}    dead end {frame.p_flag:.2f}"
            axes.set_title(said, fontsize=7, loc="left", pad=2)
    x, y, h, w = *origin, *frame.p_dead.shape
    extent = (y + h * resolution, y, x, x + w * resolution)  # y falls to the right
    below = inner[1].subgridspec(1, 3, wspace=0.06)
    scan = figure.add_subplot(below[0])
    _above(scan, extent, _upright(np.asarray(KNOWN)[frame.local_map]), "LiDAR and map")
    x, y, _ = frame.cloud[:: max(1, len(frame.cloud) // POINTS)].T
    scan.scatter(y, x, s=0.1, color="0.45", alpha=0.5, linewidths=0)
    x, y, z = frame.points.T
    scan.scatter(y, x, s=2.0, c=z, cmap="plasma", vmin=HEIGHTS[0], vmax=HEIGHTS[1], linewidths=0)
    dead, passable = figure.add_subplot(below[1]), figure.add_subplot(below[2])
    heat = look.over_white(look.heat(frame.p_dead))
    _above(dead, extent, cells(frame, heat), "dead ends")
    scale = np.asarray(TRAVERSABLE).T
    t = np.clip(frame.traversable, 0, 1)
    hue = np.stack([np.interp(t, (0.0, 0.5, 1.0), channel) for channel in scale], axis=-1)
    _above(passable, extent, _upright(np.where(frame.judged[..., None] | (frame.local_map == OCCUPIED)[..., None], hue,
                                               KNOWN[0])), "traversable")  # fmt: skip


def predictions(
    file: str | Path, frames: Sequence[Predicted], origin: tuple[float, float], resolution: float, *, columns: int = 1,
    note: str = "",
) -> Path:  # fmt: skip
    """A page of frames.

    Args:
        file: PNG to write.
        frames: What to draw.
        origin: Of the grids: x, y of the outer corner of cell (0, 0) [m].
        resolution: Edge of their cells [m].
        columns: Frames side by side.
        note: A line at the foot, such as whose data they are.

    Raises:
        ValueError: If there is nothing to draw.
        MissingExtra: If matplotlib is not installed.
    """
    if not frames:
        raise ValueError("there is no frame to draw: frames is empty.")
    rows = -(-len(frames) // columns)
    figure = look.page(3.6 * columns, 2.4 * rows)
    grid = figure.add_gridspec(rows, columns, wspace=0.06, hspace=0.12, left=0.01, right=0.99, bottom=0.02, top=0.98)
    for k, frame in enumerate(frames):
        _draw(figure, grid[k // columns, k % columns], frame, origin, resolution)
    lines = [*textwrap.wrap(LEGEND, 95 * columns), *([note] if note else [])]
    figure.text(0.01, 0.015, "\n".join(lines), fontsize=6, va="top")
    look.save(figure, Path(file))
    with Image.open(file) as drawn:  # photos make large files: a palette takes a third
        small = drawn.convert("RGB").quantize(COLOURS)
    small.save(file, optimize=True)
    return Path(file)
