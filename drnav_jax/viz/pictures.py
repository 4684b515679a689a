"""Still pictures: what several planners drove in one world."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from drnav_jax.types import GridMap
from drnav_jax.viz import look
from drnav_jax.viz.look import Number, Numbers

SUFFIXES = (".png", ".pdf", ".svg")
DPI = 150
MIN_WIDTH, MAX_WIDTH = 1000 / DPI, 1400 / DPI  # [inch] of the picture
GAP = 0.16  # [inch] between the blocks of the legend
MAP_WIDTH = (5.4, 7.8)  # [inch] with the legend beside the map, and with it below
ASPECT = (0.6, 1.9)  # width / height of the map: a straight trip still shows what it passed
BESIDE = 1.25  # width / height of the map below which the legend stands beside it
MAP_HEIGHT = 7.6  # [inch] at most
ROOM = (0.74, 0.16, 0.46, 0.44)  # [inch] left, right, below and above the map: ticks, labels and title
LINE = 2.3  # [pt]
UNSEEN = "#e9ebee"
CROSS = 11.0  # [pt]


def trajectories(
    file: str | Path,
    *,
    occupied: Numbers,
    origin: Numbers,
    resolution: Number,
    start: Numbers,
    goal: Numbers,
    goal_tolerance: Number,
    paths: Mapping[str, Numbers],
    outcome: Mapping[str, str] | None = None,
    p_dead: GridMap | None = None,
    known: Numbers | None = None,
    recovery_points: Numbers | None = None,
    shortest: Numbers | None = None,
    title: str = "",
    prior: Number = look.PRIOR,
) -> Path:
    """Draw the paths that planners drove, over the world and the dead-end belief of one of them.

    Args:
        file: Where to write; the suffix names the format (.png is 1,000 to 1,400 pixels wide).
        occupied: True map `[H, W]` bool, row 0 at the smallest y.
        origin: World x, y of the outer corner of cell (0, 0) [m].
        resolution: Edge of a cell [m].
        start: x, y, yaw [m, rad].
        goal: x, y [m].
        goal_tolerance: Radius around the goal that counts as arrived [m].
        paths: Name of the planner -> driven path `[T, 2]` [m], T >= 1; rows that are not finite are left out.
        outcome: Name of the planner -> how it ended. Unless it begins with "reached", the end is marked by a cross.
        p_dead: Probability that a cell is a dead end, 0..1 (its grid may differ from the map's), or None.
        known: Cells of `p_dead` that were seen, same shape, or None = all. The heat is drawn there only.
        recovery_points: x, y `[M, 2]` [m], or None.
        shortest: Shortest path in the true map `[L, 2]` [m], or None.
        title: Printed above.
        prior: P_dead that means "no evidence": left white.

    Returns:
        The file.

    Raises:
        ValueError: If the suffix is unknown, a shape does not fit, or there is no path.
        MissingExtra: If matplotlib is not installed.
    """
    file = Path(file)
    if file.suffix.lower() not in SUFFIXES:
        raise ValueError(f'a picture is written as {", ".join(SUFFIXES)}, got "{file.name}".')
    occupied, origin, resolution = np.asarray(occupied, bool), np.asarray(origin, np.float64), float(resolution)
    start, goal, goal_tolerance = np.asarray(start, np.float64), np.asarray(goal, np.float64), float(goal_tolerance)
    prior = float(prior)
    if start.shape != (3,) or goal.shape != (2,):
        raise ValueError(f"start must be x, y, yaw and goal x, y; got shapes {start.shape} and {goal.shape}.")
    if occupied.ndim != 2:
        raise ValueError(f"occupied must be [H, W], got shape {occupied.shape}.")
    if not paths:
        raise ValueError("there is nothing to draw: paths is empty.")
    lines = {name: _points(path, f'the path of "{name}"') for name, path in paths.items()}
    for name, line in lines.items():
        if not len(line):
            raise ValueError(f'the path of "{name}" has no finite point: leave it out.')
    optimum = None if shortest is None else _points(shortest, "shortest")
    points = np.zeros((0, 2)) if recovery_points is None else _points(recovery_points, "recovery_points")
    if p_dead is not None and known is not None and np.shape(known) != np.shape(p_dead.values):
        raise ValueError(f"known {np.shape(known)} must have the shape of p_dead {np.shape(p_dead.values)}.")
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.patches import Circle
        from matplotlib.patheffects import Normal, Stroke
    except ImportError as error:
        raise look.MissingExtra from error

    around = np.asarray([[1, 0], [-1, 0], [0, 1], [0, -1]]) * goal_tolerance + goal
    must = [*lines.values(), around, start[None, :2], *([] if optimum is None else [optimum])]
    span = np.ptp(np.concatenate(must), axis=0).max()
    whole = look.extent(occupied.shape, origin, resolution)
    view = look.region(np.concatenate(must), margin=max(2.0, 0.08 * span), aspect=ASPECT, bounds=whole)

    figure = Figure(dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.1, 0.1, 0.8, 0.8))
    if p_dead is not None:
        seen = np.ones(np.shape(p_dead.values), bool) if known is None else np.asarray(known, bool)
        colours = np.where(seen[..., None], look.over_white(look.heat(p_dead.values, prior)), _rgb(UNSEEN))
        axes.set_facecolor(UNSEEN)  # what lies outside the belief's window is not known either
        _image(axes, colours, np.asarray(p_dead.origin), float(p_dead.resolution), view, zorder=1)
    pixel = (view[2] - view[0]) / (_map_size(view)[0] * DPI)
    cells = max(1, int(np.ceil(1.2 * pixel / resolution)))
    wall = _pooled(occupied, cells)[..., None] * np.asarray((*_rgb(look.WALL), 1.0), np.float32)
    _image(axes, wall, origin, resolution * cells, view, zorder=2)

    shown = look.strokes(list(lines))
    handles = []
    halo = [Stroke(linewidth=LINE + 1.8, foreground="white"), Normal()]
    if optimum is not None and len(optimum):
        axes.plot(*optimum.T, color="#30343b", linewidth=1.1, linestyle=(0, (1.0, 1.8)), zorder=4.5)
    # Solid lines first: where paths coincide, one sees them through the gaps of the dashed ones.
    for name in sorted(lines, key=lambda n: bool(shown[n].dashes)):
        stroke, line = shown[name], lines[name]
        kind = {"color": stroke.colour, "linewidth": LINE, "linestyle": (0, stroke.dashes) if stroke.dashes else "-"}
        if not stroke.dashes:
            kind["path_effects"] = halo
        else:
            axes.plot(*line.T, color="white", linewidth=LINE + 1.8, alpha=0.8, zorder=3.9)
        axes.plot(*line.T, **kind, solid_capstyle="round", dash_capstyle="butt", zorder=4)
    ends = np.stack([line[-1] for line in lines.values()])
    for k, (name, end) in enumerate(zip(lines, ends, strict=True)):
        ended = None if outcome is None else outcome.get(name)
        # Planners get stuck in the same corner: the marks below are larger, so that each is seen.
        covered = int((np.hypot(*(ends[k + 1 :] - end).T) < 0.012 * (view[2] - view[0])).sum())
        handles.append(_ending(axes, end, shown[name], ended, covered))

    disc = {"facecolor": (1.0, 0.8, 0.0, 0.22), "edgecolor": "black", "linewidth": 0.9}
    axes.add_patch(Circle((float(goal[0]), float(goal[1])), goal_tolerance, zorder=3, **disc))
    points = points[((points > view[:2]) & (points < view[2:])).all(axis=1)]
    symbols = _symbols(axes, start, goal, goal_tolerance, points, optimum is not None)
    if p_dead is not None:
        symbols += _surfaces(prior)
    _arrange(figure, axes, view, [handles, symbols], title)
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file)
    return file


def _rgb(colour: str) -> tuple[float, ...]:
    return tuple(c / 255.0 for c in look.rgb(colour))


def _points(values: Numbers, what: str) -> np.ndarray:
    """The finite rows of `[N, 2]`."""
    points = np.asarray(values, np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"{what} must be [N, 2], got shape {points.shape}.")
    return points[np.isfinite(points).all(axis=1)]


def _pooled(occupied: np.ndarray, cells: int) -> np.ndarray:
    """Whether anything is occupied in each block of cells, so that no thin wall falls between two pixels."""
    h, w = occupied.shape
    padded = np.pad(occupied, ((0, -h % cells), (0, -w % cells)))
    return np.any(padded.reshape(-(-h // cells), cells, -(-w // cells), cells), axis=(1, 3))


def _map_size(view: tuple[float, float, float, float]) -> tuple[float, float]:
    """Width and height of the map on paper [inch]."""
    aspect = (view[2] - view[0]) / (view[3] - view[1])
    width = min(MAP_WIDTH[0 if aspect < BESIDE else 1], MAP_HEIGHT * aspect)
    return width, width / aspect


def _image(axes, colours: np.ndarray, origin: np.ndarray, resolution: float, view, zorder: int) -> None:
    """Draw the part of a grid of colours `[H, W, 3 or 4]` that is in view."""
    h, w = colours.shape[:2]
    low = np.clip(np.floor((np.asarray(view[:2]) - origin) / resolution), 0, (w, h)).astype(int)
    high = np.clip(np.ceil((np.asarray(view[2:]) - origin) / resolution), 0, (w, h)).astype(int)
    if (high <= low).any():
        return
    x0, y0, x1, y1 = *(origin + low * resolution), *(origin + high * resolution)
    part = colours[low[1] : high[1], low[0] : high[0]]
    axes.imshow(part, origin="lower", extent=(x0, x1, y0, y1), interpolation="nearest", zorder=zorder)


def _ending(axes, end: np.ndarray, stroke: look.Stroke, ended: str | None, covered: int):
    """Mark where a path ends, a cross if it failed, under `covered` others; the legend's entry for it."""
    from matplotlib.lines import Line2D

    kind = {"color": stroke.colour, "linewidth": LINE, "linestyle": (0, stroke.dashes) if stroke.dashes else "-"}
    label = stroke.label if ended is None else f"{stroke.label} ({ended})"
    mark = {"marker": "o", "markersize": 6.5, "markeredgecolor": "white", "markeredgewidth": 1.0}
    drawn = mark
    if ended is not None and not ended.lower().startswith("reached"):
        mark |= {"marker": "X", "markersize": CROSS}
        drawn = mark | {"markersize": CROSS * (1.0 + 0.55 * covered)}
    axes.plot(*end, color=stroke.colour, linestyle="none", zorder=7, **drawn)
    return Line2D([], [], label=label, **kind, **(mark if ended is not None else {}))


def _symbols(axes, start, goal, goal_tolerance: float, points: np.ndarray, optimum: bool) -> list:
    """Draw start, goal and recovery points; the legend's entries for them."""
    from matplotlib.lines import Line2D
    from matplotlib.markers import MarkerStyle
    from matplotlib.patches import Patch
    from matplotlib.path import Path as Outline
    from matplotlib.transforms import Affine2D

    arrow = Outline([(1.0, 0.0), (-0.8, 0.75), (-0.4, 0.0), (-0.8, -0.75), (1.0, 0.0)], closed=True)
    rim = {"linestyle": "none", "markeredgecolor": "white"}
    turned = MarkerStyle(arrow, transform=Affine2D().rotate(float(start[2])))
    nose = {"color": "black", "markersize": 15, "markeredgewidth": 1.0, **rim}
    star = {"color": look.GOAL, "marker": "*", "markersize": 17, **rim, "markeredgecolor": "black"}
    dot = {"color": look.RECOVERY, "marker": "o", "markersize": 8, "markeredgewidth": 1.5, **rim}
    axes.plot(*start[:2], marker=turned, **nose, zorder=6)
    axes.plot(*goal, **star, zorder=6)
    handles = []
    if optimum:
        handles.append(Line2D([], [], color="#30343b", linewidth=1.1, linestyle=(0, (1.0, 1.8)), label="shortest path"))
    handles.append(Line2D([], [], marker=MarkerStyle(arrow), label="start", **{**nose, "markersize": 11}))
    label = f"goal, within {goal_tolerance:.2f} m"
    handles.append(Line2D([], [], label=label, **{**star, "markersize": 13}))
    if len(points):
        axes.plot(*points.T, **dot, zorder=5)
        handles.append(Line2D([], [], label="recovery point", **dot))
    handles.append(Patch(color=look.WALL, label="obstacle"))
    return handles


class _Strip(tuple):
    """Patches side by side that are one entry of the legend."""

    label = ""

    def get_label(self) -> str:
        return self.label


def _surfaces(prior: float) -> list:
    """The legend's entries for the dead-end belief."""
    from matplotlib.patches import Patch

    colours = look.over_white(look.heat(np.linspace(prior, 1.0, 50), prior))
    strip = _Strip(Patch(facecolor=tuple(c), edgecolor="none", linewidth=0) for c in colours)
    strip.label = f"P(dead end), {prior:g} to 1"
    below = look.over_white(look.heat(0.0, prior))
    return [
        Patch(facecolor=tuple(below), edgecolor="none", label=f"P(dead end) < {prior:g}"),
        strip,
        Patch(facecolor=UNSEEN, edgecolor="#b4b8bf", linewidth=0.6, label="unknown to the robot"),
    ]


def _arrange(figure, axes, view, groups: list[list], title: str) -> None:
    """Axes in metres at one scale; the legend below a wide map, beside a tall one, never over it."""
    from matplotlib.legend_handler import HandlerTuple
    from matplotlib.ticker import MaxNLocator

    left, right, below, above = ROOM if title else (*ROOM[:3], 0.15)
    map_width, map_height = _map_size(view)
    beside = map_width / map_height < BESIDE

    def legend(handles: list, columns: int):
        """A block with as many columns as fit below the map, and its size [inch]."""
        box = figure.legend(
            handles, [handle.get_label() for handle in handles], loc="lower left", ncols=columns, frameon=False,
            fontsize=9, handlelength=3.4, columnspacing=1.8, labelspacing=0.55, borderaxespad=0.0, borderpad=0.0,
            handler_map={_Strip: HandlerTuple(ndivide=None, pad=0.0)},
        )  # fmt: skip
        size = box.get_window_extent(figure.canvas.get_renderer())
        if columns > 1 and size.width / DPI > map_width:
            box.remove()
            return legend(handles, columns - 1)
        return box, size.width / DPI, size.height / DPI

    blocks = [legend(group, 1 if beside else len(group)) for group in groups]
    block_width, block_height = max(b[1] for b in blocks), sum(b[2] for b in blocks) + GAP * (len(blocks) - 1)
    if beside:
        shrink = min(1.0, max(0.6, (MAX_WIDTH - left - 0.2 - block_width - right) / map_width))  # for long words
        map_width, map_height = map_width * shrink, map_height * shrink
        width = max(left + map_width + 0.2 + block_width + right, MIN_WIDTH)
        height = above + max(map_height + below, block_height + right)
        x, top, bottom = left + map_width + 0.2, height - above, height - above - map_height
    else:
        width, height = left + map_width + right, above + map_height + below + GAP + block_height + right
        x, top, bottom = left, right + block_height, height - above - map_height
    figure.set_size_inches(width, height)
    axes.set_position((left / width, bottom / height, map_width / width, map_height / height))
    for box, _, tall in blocks:
        box.set_loc((x / width, (top - tall) / height))
        top -= tall + GAP

    axes.set(xlim=(view[0], view[2]), ylim=(view[1], view[3]), aspect="auto")
    axes.set_xlabel("x [m]", fontsize=9, labelpad=2)
    axes.set_ylabel("y [m]", fontsize=9, labelpad=2)
    axes.tick_params(labelsize=8.5, length=3)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(nbins=8, steps=[1, 2, 5, 10]))
    for spine in axes.spines.values():
        spine.set(color="#8a8f98", linewidth=0.8)
    axes.set_axisbelow(False)
    if title:
        axes.set_title(title, loc="left", fontsize=11.5, fontweight="bold", pad=7)
