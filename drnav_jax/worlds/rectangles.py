"""A grid's walls as few upright boxes, for a simulator that knows no grids."""

import numpy as np

from drnav_jax.worlds.world import World


def rectangles(occupied: np.ndarray) -> np.ndarray:
    """Rectangles of cells whose union is the occupied cells, exactly; they may overlap.

    Cells are taken row by row. What is not covered yet begins a rectangle: the one that covers most new cells among all
    with that cell at their smallest row and column, widened to both sides and downwards as far as cells are occupied.

    Args:
        occupied: `[H, W]` bool.

    Returns:
        `[N, 4]` int32: first row, first column, last row, last column; ends are included.
    """
    occupied = np.asarray(occupied, bool)
    h, w = occupied.shape
    # Occupied cells in a row from here on to larger columns, and in a column to larger rows.
    along, below = np.zeros((h, w + 1), np.int32), np.zeros((h + 1, w), np.int32)
    for j in range(w - 1, -1, -1):
        along[:, j] = np.where(occupied[:, j], along[:, j + 1] + 1, 0)
    for i in range(h - 1, -1, -1):
        below[i] = np.where(occupied[i], below[i + 1] + 1, 0)
    left = occupied.copy()
    found = []
    for i in range(h):
        while (open_cells := np.flatnonzero(left[i])).size:
            j = open_cells[0]
            widths = np.minimum.accumulate(along[i : i + below[i, j], j])
            best, gain = (1, 1), 0
            # Only where the width is about to shrink can a rectangle be the best one.
            for n in np.flatnonzero(np.diff(widths, append=0)) + 1:
                new = int(left[i : i + n, j : j + widths[n - 1]].sum())
                if new > gain:
                    best, gain = (int(n), int(widths[n - 1])), new
            rows, columns = best
            first, last = j, j + columns - 1
            while first > 0 and occupied[i : i + rows, first - 1].all():
                first -= 1
            left[i : i + rows, first : last + 1] = False
            found.append((i, first, i + rows - 1, last))
    return np.asarray(found, np.int32).reshape(-1, 4)


def wall_boxes(world: World) -> np.ndarray:
    """The walls of a world's grid as upright boxes.

    Args:
        world: One world (host).

    Returns:
        `[N, 5]` float64: centre x, y, yaw (0), half lengths along x and y [m]; N = 0 without a grid.
    """
    values = np.asarray(world.field.values)
    if not values.size:
        return np.zeros((0, 5))
    corner, cell = np.asarray(world.field.origin, np.float64), float(world.field.resolution)
    i0, j0, i1, j1 = rectangles(values <= 0).astype(np.float64).T
    half_x, half_y = (j1 - j0 + 1) * cell / 2, (i1 - i0 + 1) * cell / 2
    return np.stack([corner[0] + j0 * cell + half_x, corner[1] + i0 * cell + half_y, 0 * i0, half_x, half_y], axis=1)
