"""Pictures of worlds: what stands where, what is a dead end, what the sensors see; and sheets of many.

A top view draws every solid in its own colour; what one sensor alone cannot judge is hatched (`HATCHES`).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drnav_jax.viz import look
from drnav_jax.viz.look import Numbers

# Name of a material -> (edge colour, hatch) in top views; others are drawn without.
HATCHES: dict[str, tuple[str, str]] = {
    "GLASS": ("#0077b6", "////"), "BUSH": ("#1b5e20", "xxx"), "GRASS": ("#7cb342", "..."), "DROP": ("#000000", "\\\\\\\\"),
    "STRIPE": ("#b8860b", "||"), "METAL": ("#37474f", ""), "CAR": ("#5d4037", ""),
}  # fmt: skip
KNOWN = ((0.62, 0.64, 0.68), (1.0, 1.0, 1.0), (0.17, 0.18, 0.2))  # of cells that are unknown, free, occupied
DEPTHS = "YlOrRd"


class TopView(NamedTuple):
    """A world from above; arrays on the host."""

    title: str
    outlines: Sequence[np.ndarray]  # [n, 2] corners of each solid [m]
    colours: Numbers  # [N, 3] of the solids, 0..1
    materials: Sequence[str]  # N names
    passable: Numbers  # [N] bool: does not stop a robot
    occupied: Numbers  # [H, W] bool, true map
    origin: Numbers  # [2] of the outer corner of cell (0, 0) [m]
    resolution: float  # [m]
    ground: Numbers  # [3] colour, 0..1
    start: Numbers | None = None  # [3]
    goal: Numbers | None = None  # [2]
    path: Numbers | None = None  # [L, 2] shortest way


class Truth(NamedTuple):
    """What is true of the cells of a `TopView`'s map."""

    depth: Numbers  # [H, W] beyond the mouth, 0 where it is no dead end [m]
    gates: Numbers  # [G, 3] x, y, radius [m]
    recovery_points: Numbers  # [M, 2] [m]


def _region(view: TopView) -> tuple[float, float, float, float]:
    """x_min, x_max, y_min, y_max of what is worth showing: the map."""
    x, y = (float(v) for v in np.asarray(view.origin))
    h, w = np.shape(view.occupied)
    return x, x + w * view.resolution, y, y + h * view.resolution


def _draw_top(axes: Any, view: TopView, *, map_only: bool = False, ticks: bool = True) -> None:
    """Solids in their colours (or the true map), the trip, and the frame."""
    from matplotlib.patches import Polygon

    axes.set_facecolor(np.clip(np.asarray(view.ground, float) * 0.5 + 0.5, 0, 1))
    extent = _region(view)
    if map_only or not len(view.outlines):
        wall = np.asarray(view.occupied, bool)[..., None] * np.array([*_rgb(look.WALL), 1.0])
        axes.set_facecolor("white")
        axes.imshow(wall, origin="lower", extent=extent, interpolation="nearest", zorder=1)
    else:
        solids = zip(view.outlines, np.asarray(view.colours), view.materials, np.asarray(view.passable), strict=True)
        for outline, colour, material, passable in solids:
            edge, hatch = HATCHES.get(material, ("#202020", ""))
            face, order = (*np.clip(colour, 0, 1), 0.45 if passable else 0.95), 1 if passable else 2
            style = {"facecolor": face, "edgecolor": edge, "hatch": hatch or None, "linewidth": 0.5}
            axes.add_patch(Polygon(outline, closed=True, zorder=order, **style))
    if view.path is not None:
        axes.plot(*np.asarray(view.path).T, color="#1d3fbf", linewidth=1.2, linestyle=(0, (4, 2)), zorder=5)
    if view.start is not None:
        x, y, yaw = np.asarray(view.start, float)
        axes.plot(x, y, "o", color="#1d3fbf", markersize=5, zorder=6)
        axes.annotate("", (x + 1.2 * np.cos(yaw), y + 1.2 * np.sin(yaw)), (x, y), zorder=6,
                      arrowprops={"arrowstyle": "-|>", "color": "#1d3fbf"})  # fmt: skip
    if view.goal is not None:
        axes.plot(*np.asarray(view.goal, float), "*", color=look.GOAL, markeredgecolor="black", markersize=12, zorder=6)
    axes.set_xlim(extent[:2])
    axes.set_ylim(extent[2:])
    axes.set_aspect("equal")
    axes.set_title(view.title, fontsize=9)
    axes.tick_params(labelsize=7)
    if not ticks:
        axes.set_xticks([])
        axes.set_yticks([])


def _rgb(colour: str) -> tuple[float, ...]:
    return tuple(c / 255 for c in look.rgb(colour))


def _draw_truth(figure: Any, axes: Any, view: TopView, truth: Truth) -> None:
    from matplotlib.patches import Circle

    _draw_top(axes, view, map_only=True)
    depth = np.ma.masked_less_equal(np.asarray(truth.depth, float), 0.0)
    shown = axes.imshow(depth, origin="lower", extent=_region(view), cmap=DEPTHS, vmin=0, interpolation="nearest", zorder=2)
    for x, y, radius in np.asarray(truth.gates, float).reshape(-1, 3):
        axes.add_patch(Circle((x, y), radius, fill=False, edgecolor="#7b2cbf", linewidth=1.0, zorder=4))
    points = np.asarray(truth.recovery_points, float).reshape(-1, 2)
    axes.plot(*points.T, "D", color=look.RECOVERY, markersize=5, linestyle="none", zorder=6)
    axes.set_title("dead ends: depth beyond the mouth [m], gates (rings), recovery points", fontsize=9)
    if depth.count():
        figure.colorbar(shown, ax=axes, shrink=0.7).ax.tick_params(labelsize=7)


def world(
    file: str | Path, view: TopView, truth: Truth, images: Mapping[str, np.ndarray], sweep: Numbers, pose: Numbers
) -> Path:
    """One world: from above, its dead ends, what the cameras see at `pose`, and one LiDAR sweep from there.

    Args:
        file: PNG to write.
        view: The world from above.
        truth: Its dead ends.
        images: Name of each camera -> `[h, w, 3]` in 0..1.
        sweep: Points that met something `[P, 3]` in the world [m].
        pose: Where the cameras and the LiDAR are (x, y, yaw).

    Raises:
        MissingExtra: If matplotlib is not installed.
    """
    figure = look.page(15.0, 10.0)
    grid = figure.add_gridspec(2, 6, height_ratios=(1.7, 1.0), hspace=0.16, wspace=0.25)
    _draw_top(figure.add_subplot(grid[0, :3]), view)
    _draw_truth(figure, figure.add_subplot(grid[0, 3:]), view, truth)
    shown = figure.add_gridspec(2, 4, height_ratios=(1.7, 1.0), hspace=0.16, wspace=0.08)
    for k, (name, image) in enumerate(list(images.items())[:3]):
        axes = figure.add_subplot(shown[1, k])
        axes.imshow(np.clip(image, 0, 1), interpolation="nearest")
        axes.set_title(name, fontsize=9)
        axes.set_axis_off()
    axes = figure.add_subplot(shown[1, 3])
    points = np.asarray(sweep, float).reshape(-1, 3)
    axes.scatter(points[:, 0], points[:, 1], s=1.0, c=points[:, 2], cmap="viridis", vmin=-1.2, vmax=2.5, linewidths=0)
    axes.plot(float(np.asarray(pose)[0]), float(np.asarray(pose)[1]), "o", color=look.RECOVERY, markersize=5)
    axes.set_aspect("equal")
    axes.set_title("LiDAR sweep (colour: height)", fontsize=9)
    axes.tick_params(labelsize=7)
    return look.save(figure, Path(file))


def gallery(file: str | Path, rows: Sequence[Sequence[tuple[TopView, np.ndarray]]]) -> Path:
    """A contact sheet: a row per family; beside each top view what a camera sees where the variants differ.

    Args:
        file: PNG to write.
        rows: Families, each with its variants: top view and image `[h, w, 3]` in 0..1.

    Raises:
        ValueError: If there is nothing to draw.
        MissingExtra: If matplotlib is not installed.
    """
    columns = max((len(row) for row in rows), default=0)
    if not columns:
        raise ValueError("there is no world to draw: rows is empty.")
    figure = look.page(4.6 * columns, 2.5 * len(rows))
    grid = figure.add_gridspec(len(rows), 2 * columns, wspace=0.04, hspace=0.18)
    for i, row in enumerate(rows):
        for j, (view, image) in enumerate(row):
            _draw_top(figure.add_subplot(grid[i, 2 * j]), view, ticks=False)
            axes = figure.add_subplot(grid[i, 2 * j + 1])
            axes.imshow(np.clip(image, 0, 1), interpolation="nearest")
            axes.set_axis_off()
    return look.save(figure, Path(file))


def samples(file: str | Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """A page of frames: cameras, known map, truth, visibility, and what was predicted.

    Args:
        file: PNG to write.
        rows: Frames as mappings: `title`, `images` `[N, h, w, 3]` uint8, `local_map`, `dead_end`, `valid`, `visibility`,
            `inside` and `interior` `[h, w]` (`dataset.frames`), `path` `[3]`; and, if all have a prediction, `p_dead`
            `[h, w]`, `p_open` `[3]` and `p_flag`.

    Raises:
        MissingExtra: If matplotlib is not installed.
    """
    cameras, predicted = max(len(row["images"]) for row in rows), all("p_dead" in row for row in rows)
    columns = cameras + 3 + predicted
    figure = look.page(1.7 * columns, 1.95 * len(rows))
    grid = figure.add_gridspec(len(rows), columns, wspace=0.04, hspace=0.22)
    for i, row in enumerate(rows):
        for k, image in enumerate(row["images"]):
            axes = figure.add_subplot(grid[i, k])
            axes.imshow(image, interpolation="nearest")
            axes.set_axis_off()
            if k == 0:
                axes.set_title(row["title"], fontsize=6, loc="left")
        for k, (name, picture) in enumerate(_grids(row, predicted)):
            axes = figure.add_subplot(grid[i, cameras + k])
            axes.imshow(np.rot90(picture)[:, ::-1], interpolation="nearest")  # forward is up, left is left
            axes.set_title(name, fontsize=6)
            axes.set_axis_off()
    return look.save(figure, Path(file))


def _grids(row: Mapping[str, Any], predicted: bool) -> list[tuple[str, np.ndarray]]:
    """Titles and colours `[h, w, 3]` of a frame's grids."""
    valid = np.asarray(row["valid"], bool)
    known = np.array(KNOWN)[np.asarray(row["local_map"])]
    truth = np.where(valid[..., None], np.array([0.82, 0.95, 0.84]), np.array([0.2, 0.2, 0.22]))
    truth[~np.asarray(row["inside"], bool)] = KNOWN[0]
    truth[valid & np.asarray(row["dead_end"], bool)] = (0.85, 0.25, 0.2)
    truth[valid & np.asarray(row["interior"], bool)] *= 0.72
    seen = np.array([[0.2, 0.55, 0.9], [0.65, 0.8, 0.95], [0.25, 0.25, 0.28]])[np.asarray(row["visibility"])]
    marked = lambda ways: "".join(mark if ok else "-" for mark, ok in zip("FLR", ways, strict=True))  # noqa: E731
    out = [(f"map, open: {marked(row['path'])}", known), ("truth", truth), ("seen", seen)]
    if predicted:
        said = look.over_white(look.heat(row["p_dead"]))
        said[np.asarray(row["local_map"]) == len(KNOWN) - 1] = KNOWN[-1]
        out.append((f"said: {marked(np.asarray(row['p_open']) >= 0.5)}, dead end {row['p_flag']:.2f}", said))
    return out
