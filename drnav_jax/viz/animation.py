"""Moving pictures: what the robot believes while it drives.

Arrays are looked up per pixel with NumPy and strokes drawn with Pillow at twice the size, then halved: milliseconds a
frame, with smooth edges. All frames of a GIF share one palette without dithering, so nothing flickers.
"""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from drnav_jax.types import GridMap
from drnav_jax.viz import look, marks
from drnav_jax.viz.look import Number, Numbers

SUFFIXES = (".gif", ".mp4")
WIDTH, HEADER = 640, 36  # [pixel]
ASPECT = (1.0, 1.85)  # width / height of the map
LEVELS = 1024  # of the heat
HOLD = 1.5  # [s] the last frame stays, before the film begins again
MODES = {"drive": "#1a7f37", "recover": "#b45309", "stop": "#c8102e"}
OTHER_MODE = "#55606e"
# Colours of small things, which a palette made from frequent colours alone would bend.
KEY_COLOURS = (look.WALL, look.FREE, look.UNKNOWN, look.RECOVERY, look.GOAL, *MODES.values(), OTHER_MODE)
KEY_COLOURS += (marks.ROBOT, marks.LOCAL_GOAL, marks.INK, marks.UNSEEN_WALL)


class Frame(NamedTuple):
    """What one picture of the film shows; numpy, frame `odom`."""

    pose: np.ndarray  # [3] x, y, yaw [m, rad]
    path: np.ndarray  # [T, 2] driven so far [m]
    occupancy: GridMap  # [H, W] -1 = unknown, else probability 0..1
    p_dead: GridMap  # [H, W] probability 0..1; drawn over known free cells
    recovery_points: np.ndarray  # [M, 2] x, y [m]
    local_goal: np.ndarray  # [2] g* x, y [m]
    mode: str  # "drive", "recover", "stop"
    time: float  # [s] since the start


class View(NamedTuple):
    """How the plane maps to the picture."""

    low: tuple[float, float]  # x, y [m] of the lower left corner
    high: tuple[float, float]  # x, y [m] of the upper right corner
    scale: float  # [pixel / m]
    size: tuple[int, int]  # width, height [pixel] of the map


def belief(
    file: str | Path,
    frames: Sequence[Frame],
    *,
    goal: Numbers,
    goal_tolerance: Number,
    radius: Number,
    true_occupied: Numbers | None = None,
    true_origin: Numbers = (0.0, 0.0),
    true_resolution: Number = 0.1,
    fps: Number = 10.0,
    max_frames: int = 150,
    prior: Number = look.PRIOR,
) -> Path:
    """Film the belief of one robot, in a window that holds the whole trip and does not move.

    Args:
        file: Where to write, .gif or .mp4.
        frames: In the order of time; more than `max_frames` are thinned out evenly, first and last are kept.
        goal: x, y [m].
        goal_tolerance: Radius around the goal that counts as arrived [m].
        radius: Radius of the robot [m].
        true_occupied: True map `[H, W]` bool, shown faintly where the robot has not seen yet, or None.
        true_origin: World x, y of the outer corner of its cell (0, 0) [m].
        true_resolution: Edge of its cells [m].
        fps: Frames per second of the film.
        max_frames: At most so many frames.
        prior: P_dead that means "no evidence": left white.

    Returns:
        The file.

    Raises:
        ValueError: If the suffix is unknown, there are no frames, or a number is out of range.
        MissingExtra: For .mp4, if imageio with ffmpeg is not installed.
    """
    file = Path(file)
    if file.suffix.lower() not in SUFFIXES:
        raise ValueError(f'a film is written as {", ".join(SUFFIXES)}, got "{file.name}".')
    if not len(frames):
        raise ValueError("a film needs at least one frame.")
    fps, prior, true_resolution = float(fps), float(prior), float(true_resolution)
    if max_frames < 1 or not 0 < fps <= 50:
        raise ValueError(f"max_frames must be >= 1 and fps > 0 and <= 50 Hz, got {max_frames} and {fps}.")
    picked = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), max_frames)).round().astype(int))
    picked[-1] = len(frames) - 1  # of one frame alone, linspace keeps the first
    frames = [frames[k] for k in picked]
    goal, goal_tolerance, radius = np.asarray(goal, np.float64), float(goal_tolerance), float(radius)
    whole = None
    if true_occupied is not None:
        true_occupied, true_origin = np.asarray(true_occupied, bool), np.asarray(true_origin, np.float64)
        whole = look.extent(true_occupied.shape, true_origin, true_resolution)
    view = _view(frames, goal, goal_tolerance, whole)
    backdrop = _backdrop(view, true_occupied, true_origin, true_resolution)
    legend = marks.legend(WIDTH, prior, hint=true_occupied is not None)
    pictures = (_picture(frame, view, backdrop, legend, goal, goal_tolerance, radius, prior) for frame in frames)
    file.parent.mkdir(parents=True, exist_ok=True)
    (_write_gif if file.suffix.lower() == ".gif" else _write_mp4)(file, pictures, fps)
    return file


def _view(frames: list[Frame], goal, goal_tolerance: float, whole) -> View:
    """The region that holds all that is drawn in any frame."""
    goal = np.asarray(goal, np.float64)
    must = [goal[None] - goal_tolerance, goal[None] + goal_tolerance, np.asarray(frames[-1].path).reshape(-1, 2)]
    must += [np.asarray(f.pose, np.float64)[None, :2] for f in frames]
    must = np.concatenate(must)
    margin = max(3.0, 0.1 * np.ptp(must, axis=0).max())
    x0, y0, x1, y1 = look.region(must, margin=margin, aspect=ASPECT, bounds=whole)
    scale = WIDTH / (x1 - x0)
    height = 2 * round((y1 - y0) * scale / 2)  # video codecs want even sizes
    return View(low=(x0, y1 - height / scale), high=(x1, y1), scale=scale, size=(WIDTH, height))


def _lookup(values: Numbers, origin, resolution: float, view: View, fill: float) -> np.ndarray:
    """Value under each pixel `[height, width]`, row 0 at the top; the largest one if a pixel holds several cells."""
    values = np.asarray(values, np.float32)
    h, w = values.shape
    parts = max(1, int(np.ceil(0.999 / (view.scale * resolution))))
    offset = (np.arange(parts) + 0.5) / parts
    x = view.low[0] + (np.arange(view.size[0])[:, None] + offset) / view.scale
    y = view.high[1] - (np.arange(view.size[1])[:, None] + offset) / view.scale
    col = np.floor((x - float(origin[0])) / resolution).astype(np.int64)
    row = np.floor((y - float(origin[1])) / resolution).astype(np.int64)
    padded = np.pad(values, 1, constant_values=fill)
    col, row = np.clip(col + 1, 0, w + 1), np.clip(row + 1, 0, h + 1)
    found = padded[row[:, 0]][:, col[:, 0]]
    for a in range(parts):
        for b in range(parts):
            if a or b:
                found = np.maximum(found, padded[row[:, a]][:, col[:, b]])
    return found


def _backdrop(view: View, true_occupied, true_origin, true_resolution: float) -> np.ndarray:
    """What lies under the belief `[height, width, 3]` uint8: unknown ground, with the true walls as a hint."""
    ground = np.empty((view.size[1], view.size[0], 3), np.uint8)
    ground[:] = look.rgb(look.UNKNOWN)
    if true_occupied is not None:
        hint = _lookup(true_occupied, true_origin, true_resolution, view, 0.0) > 0.5
        ground[hint] = look.rgb(marks.UNSEEN_WALL)
    return ground


def _ground(frame: Frame, view: View, backdrop: np.ndarray, prior: float) -> np.ndarray:
    """Belief as colours `[height, width, 3]` uint8."""
    occupancy, dead = frame.occupancy, frame.p_dead
    p = _lookup(occupancy.values, np.asarray(occupancy.origin), float(occupancy.resolution), view, -1.0)
    known = p >= 0.0
    dark = np.clip((p - 0.25) / 0.5, 0.0, 1.0)[..., None]
    table = look.over_white(look.heat(np.linspace(0.0, 1.0, LEVELS), prior))  # no logarithm per pixel
    q = _lookup(dead.values, np.asarray(dead.origin), float(dead.resolution), view, prior)
    colour = 255.0 * table[np.clip(np.round(q * (LEVELS - 1)), 0, LEVELS - 1).astype(np.int32)]
    surface = colour * (1.0 - dark) + np.asarray(look.rgb(look.WALL), np.float32) * dark
    return np.where(known[..., None], surface.round().astype(np.uint8), backdrop)


def _picture(frame: Frame, view: View, backdrop, legend, goal, goal_tolerance, radius, prior) -> Image.Image:
    """One frame of the film, RGB."""
    width, height = view.size
    ground = Image.fromarray(_ground(frame, view, backdrop, prior))
    canvas = ground.resize((width * marks.FINE, height * marks.FINE), Image.Resampling.NEAREST)
    draw = ImageDraw.Draw(canvas)

    def at(xy) -> marks.Pixel:
        metres = float(xy[0]) - view.low[0], view.high[1] - float(xy[1])
        return metres[0] * view.scale * marks.FINE, metres[1] * view.scale * marks.FINE

    marks.circle(draw, at(goal), goal_tolerance * view.scale)
    marks.star(draw, at(goal), 9)
    marks.path(draw, [at(xy) for xy in _finite(frame.path)])
    for xy in _finite(frame.recovery_points):
        marks.dot(draw, at(xy), 5, look.RECOVERY)
    for xy in _finite(frame.local_goal):
        marks.dashed(draw, at(frame.pose), at(xy))
        marks.diamond(draw, at(xy), 6.5)
    marks.robot(draw, at(frame.pose), float(frame.pose[2]), max(radius * view.scale, 6.0))

    film = Image.new("RGB", (width, HEADER + height + marks.LEGEND_HEIGHT), "white")
    film.paste(canvas.reduce(marks.FINE), (0, HEADER))
    film.paste(legend, (0, HEADER + height))
    draw = ImageDraw.Draw(film)
    clock = f"t = {float(frame.time):.1f} s"
    draw.text((marks.MARGIN, HEADER / 2), clock, fill=marks.INK, font=marks.font(17), anchor="lm")
    marks.chip(draw, 118, HEADER / 2, str(frame.mode), MODES.get(str(frame.mode), OTHER_MODE))
    marks.scale_bar(draw, WIDTH - marks.MARGIN, HEADER - 11, view.scale, 0.25 * width)
    return film


def _finite(points: np.ndarray) -> np.ndarray:
    """The finite rows of `[N, 2]` (or of one point)."""
    points = np.asarray(points, np.float64).reshape(-1, 2)
    return points[np.isfinite(points).all(axis=1)]


def _write_gif(file: Path, pictures, fps: float) -> None:
    """One palette for all frames: what each frame needs, spread over the film, and no dithering."""
    pictures = list(pictures)
    samples = [pictures[k] for k in sorted(set(np.linspace(0, len(pictures) - 1, 8).astype(int).tolist()))]
    sheet = np.concatenate([np.asarray(p) for p in samples])
    keys = np.asarray([look.rgb(colour) for colour in KEY_COLOURS])
    common = Image.fromarray(sheet).quantize(255 - len(keys), method=Image.Quantize.MEDIANCUT).getpalette() or []
    common = np.asarray(common).reshape(-1, 3)
    # Pillow finds the nearest colour to within a few levels: next to a key colour there may be no other.
    common = common[np.abs(common[:, None] - keys).max(axis=2).min(axis=1) > 8]
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate([keys, common]).ravel().tolist())
    small = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    duration = [max(20, round(1000 / fps))] * len(small)
    duration[-1] = round(1000 * HOLD)
    small[0].save(file, save_all=True, append_images=small[1:], duration=duration, loop=0, optimize=False)


def _write_mp4(file: Path, pictures, fps: float) -> None:
    """H.264 that every browser plays."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise look.MissingExtra from error
    pictures = list(pictures)
    film = imageio_ffmpeg.write_frames(
        str(file),
        pictures[0].size,
        fps=fps,  # pyright: ignore[reportArgumentType] # it takes fractions
        codec="libx264",
        quality=8,
        macro_block_size=2,
        ffmpeg_log_level="error",
    )
    with contextlib.closing(film):
        film.send(None)
        for picture in [*pictures, *[pictures[-1]] * round(HOLD * fps)]:
            film.send(picture.tobytes())
