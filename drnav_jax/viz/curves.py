"""How times and memory grow with what a part is given: one panel for each quantity, both axes logarithmic."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drnav_jax.viz import look

DPI = 150
COLUMNS = 4
PANEL = (3.0, 2.6)  # [inch]
TIME, MEMORY = "#c8102e", "#1d3fbf"


class Curve(NamedTuple):
    """One panel."""

    over: str  # what grows
    sizes: Sequence[float]
    ms: Sequence[float]
    mb: Sequence[float]  # working memory; 0 is not drawn


def growth(file: str | Path, curves: Mapping[str, Curve], title: str = "") -> Path:
    """Draw times (and, dashed, working memory) over sizes; a grey line shows what linear would be.

    Args:
        file: Where to write (.png, .pdf or .svg).
        curves: Name of the panel -> its curve.
        title: Printed above.

    Returns:
        The file.

    Raises:
        MissingExtra: If matplotlib is not installed.
    """
    columns = min(COLUMNS, len(curves))
    rows = -(-len(curves) // columns)
    figure = look.page(PANEL[0] * columns, PANEL[1] * rows + 0.4, dpi=DPI, layout="constrained")
    from matplotlib.ticker import NullLocator

    file = Path(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    panels = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for axes, (name, curve) in zip(panels, curves.items(), strict=False):
        sizes, ms, mb = (np.asarray(a, float) for a in curve[1:])
        beside = axes.twinx()
        axes.loglog(sizes, ms[-1] * sizes / sizes[-1], color="#b4b8bf", linewidth=1.0)
        axes.loglog(sizes, ms, color=TIME, marker="o", markersize=3.5)
        if (mb > 0).all():
            beside.loglog(sizes, mb, color=MEMORY, marker="s", markersize=3, dashes=(4.0, 1.6))
            beside.set_ylim(mb.min() / 10, mb.max() * 10)
        axes.set_title(name, loc="left", fontsize=9.5, fontweight="bold")
        axes.set_xlabel(curve.over, fontsize=8.5)
        axes.set_xticks(sizes, [f"{int(n):,}" for n in sizes])
        axes.xaxis.set_minor_locator(NullLocator())
        for side, label, colour in ((axes, "time [ms]", TIME), (beside, "memory [MB]", MEMORY)):
            side.set_ylabel(label, fontsize=8.5, color=colour)
            side.tick_params(which="both", labelsize=7.5)
    for axes in panels[len(curves) :]:
        axes.set_visible(False)
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    figure.savefig(file)
    return file
