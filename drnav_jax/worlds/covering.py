"""Walls as few boxes: ray casters and physics pay for each.

A plan says which rectangles are solid and which of them are hollowed out again.

    (1)  edges of all rectangles cut the plane into an irregular grid of cells, each solid or free,
    (2)  every solid cell not covered yet gets one of two rectangles of solid cells around it, grown along its row
         first or along its column first: that which covers more new area.

Rectangles may overlap: a crossing of two walls is two boxes, not five.
"""

from collections.abc import Sequence

import numpy as np

from drnav_jax.worlds.solids import Rect


def _grown(solid: np.ndarray, i: int, j: int) -> tuple[slice, slice]:
    """Rows and columns of solid cells around a cell: grown along its row, then across."""
    j0, j1, i0, i1 = j, j + 1, i, i + 1
    while j0 > 0 and solid[i, j0 - 1]:
        j0 -= 1
    while j1 < solid.shape[1] and solid[i, j1]:
        j1 += 1
    while i0 > 0 and solid[i0 - 1, j0:j1].all():
        i0 -= 1
    while i1 < solid.shape[0] and solid[i1, j0:j1].all():
        i1 += 1
    return slice(i0, i1), slice(j0, j1)


def cover(solid: Sequence[Rect], free: Sequence[Rect] = ()) -> list[Rect]:
    """Few rectangles, which may overlap, whose union is that of `solid` without that of `free`."""
    if not solid:
        return []
    every = [*solid, *free]
    xs = np.unique(np.round([x for r in every for x in (r[0], r[2])], 9))
    ys = np.unique(np.round([y for r in every for y in (r[1], r[3])], 9))
    x, y = (xs[:-1] + xs[1:]) / 2, (ys[:-1] + ys[1:]) / 2
    filled = np.zeros((len(y), len(x)), bool)
    for rects, value in ((solid, True), (free, False)):
        for x0, y0, x1, y1 in rects:
            filled[np.ix_((y > y0) & (y < y1), (x > x0) & (x < x1))] = value
    area = np.outer(np.diff(ys), np.diff(xs))
    missing, out = filled.copy(), []
    while missing.any():
        i, j = np.unravel_index(np.argmax(missing), missing.shape)
        wide = _grown(filled, int(i), int(j))
        high = _grown(filled.T, int(j), int(i))[::-1]
        best = max((wide, high), key=lambda s: (area[s] * missing[s]).sum())
        missing[best] = False
        rows, cols = best
        out.append((float(xs[cols.start]), float(ys[rows.start]), float(xs[cols.stop]), float(ys[rows.stop])))
    return out
