"""What all pictures share: colours, the dead-end heat, the region that is shown.

The heat follows the paper's Fig. 1: green = navigable, red = dead end. Below the prior p_0 it is green; above, the
colour runs from yellow to red with the risk that planners use, `(P_dead - p_0) / (1 - p_0)`. Where P_dead says nothing
that the prior does not say, it fades out: opacity grows with the distance from the prior in log-odds,
`min(1, |logit P_dead - logit p_0| / FULL_AT)`, times `DEAD_OPACITY` above the prior and `OPEN_OPACITY` below. Lightness
falls from yellow to red, so that the order survives in print and for colour-blind readers.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, SupportsFloat, TypeAlias

import numpy as np
from jaxtyping import Array

Numbers: TypeAlias = np.ndarray | Array | Sequence  # a grid, points or one point, from wherever they come
Number: TypeAlias = SupportsFloat

DPI = 110  # of pages
PRIOR = 0.06  # base rate of dead-end cells; the default of the filter
FULL_AT = 1.5  # [nat] from the prior at which the heat is fully opaque
DEAD_OPACITY, OPEN_OPACITY = 0.75, 0.45  # a warning may shout, the rest is ground
OPEN = "#7fdc8f"
RISK_STOPS = ((0.0, "#fff08a"), (0.2, "#ffd75e"), (0.5, "#fb9a45"), (0.75, "#ee5f3a"), (1.0, "#cf1f3a"))

WALL = "#2b2d33"
UNKNOWN = "#d9dce1"
FREE = "#ffffff"
RECOVERY = "#1565ff"
GOAL = "#ffcc00"


class Stroke(NamedTuple):
    """How one planner's path is drawn."""

    label: str
    colour: str
    dashes: tuple[float, ...]  # on, off, ... in line widths; () = solid


STROKES = {
    "drnav": Stroke("DR. Nav", "#c8102e", ()),
    "mppi": Stroke("MPPI", "#15803d", (4.0, 1.6)),
    "dwb": Stroke("DWB", "#00a5c4", (4.0, 1.3, 1.0, 1.3)),
    "dwa": Stroke("DWA", "#1d3fbf", (1.2, 1.2)),
    "grid": Stroke("grid", "#e57200", (7.0, 2.2)),
}
# For names that are not in the table, in the order of appearance.
OTHERS = (
    ("#7b2cbf", (6.0, 1.4, 1.0, 1.4)),
    ("#8a5a2b", (2.6, 1.2)),
    ("#d6249f", (5.0, 1.2, 2.0, 1.2)),
    ("#55606e", ()),
)


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green, blue 0..255 of "#rrggbb"."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def strokes(names: Sequence[str]) -> dict[str, Stroke]:
    """A stroke for each planner: the paper's colours for those it compares, distinct ones for the rest."""
    found, spare = {}, 0
    for name in names:
        if name in STROKES:
            found[name] = STROKES[name]
        else:
            colour, dashes = OTHERS[spare % len(OTHERS)]
            found[name], spare = Stroke(name, colour, dashes), spare + 1
    return found


def over_white(colours: np.ndarray) -> np.ndarray:
    """What colours with opacity `[..., 4]` look like on free ground: `[..., 3]`, 0..1."""
    return 1.0 - colours[..., 3:] * (1.0 - colours[..., :3])


def heat(p_dead: Numbers | float, prior: float = PRIOR) -> np.ndarray:
    """Colour of the dead-end heat (module docstring).

    Args:
        p_dead: Probability of being a dead end `[...]`, 0..1.
        prior: The probability that means "no evidence".

    Returns:
        Red, green, blue, opacity `[..., 4]` float32, all 0..1.

    Raises:
        ValueError: If the prior is not between 0 and 1.
    """
    if not 0.0 < prior < 1.0:
        raise ValueError(f"prior must be a probability > 0 and < 1, got {prior}.")
    p = np.clip(np.nan_to_num(np.asarray(p_dead, np.float32), nan=prior), 1e-4, 1.0 - 1e-4)
    distance = np.abs(np.log(p / (1.0 - p)) - np.log(prior / (1.0 - prior)))
    risk = (p - prior) / (1.0 - prior)
    at = [stop for stop, _ in RISK_STOPS]
    scale = np.asarray([rgb(colour) for _, colour in RISK_STOPS]).T
    colour = [np.where(risk > 0, np.interp(risk, at, c), g) / 255.0 for c, g in zip(scale, rgb(OPEN), strict=True)]
    opacity = np.minimum(1.0, distance / FULL_AT) * np.where(risk > 0, DEAD_OPACITY, OPEN_OPACITY)
    return np.stack([*colour, opacity], axis=-1).astype(np.float32)


def region(
    points: np.ndarray,
    *,
    margin: float,
    aspect: tuple[float, float],
    bounds: tuple[float, float, float, float] | None = None,
) -> tuple[float, float, float, float]:
    """The rectangle to show: what must be seen, some room around it, no extreme strip.

    Args:
        points: x, y `[N, 2]` [m] that must be inside; rows that are not finite are left out.
        margin: Room around them [m].
        aspect: Smallest and largest width / height; the short side grows until it holds.
        bounds: x_min, y_min, x_max, y_max [m] of what there is to see: the room beyond is spent elsewhere if it can be.

    Returns:
        x_min, y_min, x_max, y_max [m].
    """
    points = np.asarray(points, np.float64).reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    tight_low, tight_high = points.min(axis=0) - 0.25 * margin, points.max(axis=0) + 0.25 * margin
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    if bounds is not None:
        low = np.minimum(np.maximum(low, bounds[:2]), tight_low)
        high = np.maximum(np.minimum(high, bounds[2:]), tight_high)
    size = high - low
    wanted = np.maximum(size, [size[1] * aspect[0], size[0] / aspect[1]])
    grow = 0.5 * (wanted - size)
    low, high = low - grow, high + grow
    if bounds is not None:  # slide what sticks out on one side to the other, as far as there is something to see
        slide = np.clip(bounds[:2] - low, 0.0, grow * 2) - np.clip(high - bounds[2:], 0.0, grow * 2)
        slide = np.clip(slide, tight_high - high, tight_low - low)
        low, high = low + slide, high + slide
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def extent(shape: tuple[int, ...], origin: Numbers, resolution: Number) -> tuple[float, float, float, float]:
    """x_min, y_min, x_max, y_max [m] of a grid `[H, W]`."""
    x, y = (float(v) for v in np.asarray(origin))
    return x, y, x + shape[1] * float(resolution), y + shape[0] * float(resolution)


class MissingExtra(ImportError):
    """An optional dependency of the pictures is not installed."""

    def __init__(self) -> None:
        """Say what to do."""
        super().__init__("pictures need the extra: pip install drnav_jax[viz]")


def page(width: float, height: float, *, dpi: int = DPI, layout: Any = None) -> Any:
    """An empty figure [inch]; `layout` is matplotlib's.

    Raises:
        MissingExtra: If matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra from error
    figure = Figure(figsize=(width, height), dpi=dpi, facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save(figure: Any, file: Path) -> Path:
    """Write a figure without the white around it; folders are made."""
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, bbox_inches="tight")
    return file
