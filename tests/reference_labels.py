"""Dead-end labels by brute force: every gate of the medial axis, every component grown anew."""

import heapq

import numpy as np
from scipy import ndimage


def clearance(occupied: np.ndarray, resolution: float) -> np.ndarray:
    """Distance of each cell to the nearest occupied one, less half a cell [m], from all pairs."""
    squares = np.full(occupied.shape, np.inf)
    rows, columns = np.indices(occupied.shape)
    for i, j in np.argwhere(occupied):
        squares = np.minimum(squares, (rows - i) ** 2 + (columns - j) ** 2)
    return np.sqrt(squares) * resolution - 0.5 * resolution


def dead_ends(occupied, resolution, radius, mouth, depth_ratio, max_share, path=None):
    """Label and width of the narrowest gate for each cell, by the definition's own words."""
    pad = int(np.ceil((mouth / 2 + radius) / resolution)) + 3
    d = clearance(np.pad(occupied, pad), resolution)
    free = d > radius
    reach = d - radius
    anchor = np.zeros(free.shape, bool)
    anchor[0] = anchor[-1] = anchor[:, 0] = anchor[:, -1] = True
    on_path = np.zeros(free.shape, bool)
    if path is not None:
        on_path[tuple((path + pad).T)] = True
    anchor |= on_path
    parts, _ = ndimage.label(free)
    rows, columns = np.indices(free.shape)
    label, gap = np.zeros(free.shape, bool), np.full(free.shape, np.inf)
    for i, j in np.argwhere(free & (reach <= mouth / 2 - radius)):
        if reach[i, j] < reach[i - 1 : i + 2, j - 1 : j + 2].max() - 0.36 * resolution:
            continue  # not on the medial axis
        disc = (rows - i) ** 2 + (columns - j) ** 2 <= (reach[i, j] / resolution + 1) ** 2
        if (disc & on_path).any():
            continue
        width = 2 * (reach[i, j] + radius)
        pieces, count = ndimage.label(free & ~disc)
        touched = np.unique(pieces[ndimage.binary_dilation(disc)])
        for k in touched[touched > 0]:
            piece = pieces == k
            whole = parts == parts[piece][0]
            closed = not anchor[whole].any()
            share = piece.sum() / whole.sum()
            if anchor[piece].any() or share > max_share or (closed and share > 0.5):
                continue
            way = np.hypot(rows[piece] - i, columns[piece] - j).max() * resolution - reach[i, j]
            if way >= max(2 * radius + 0.5, depth_ratio * width):
                label |= piece
                gap[piece] = np.minimum(gap[piece], width)
    inner = (slice(pad, -pad), slice(pad, -pad))
    return label[inner], gap[inner], free[inner]


def way_out(label, free):
    """Shortest 8-connected way, not around corners, from each labelled cell to an unlabelled [cells].

    Outside of the grid lies no label.
    """
    label, free = np.pad(label, 1), np.pad(free, 1, constant_values=True)
    way = np.where(free & ~label, 0.0, np.inf)
    queue = [(0.0, i, j) for i, j in np.argwhere(free & ~label).tolist()]
    while queue:
        length, i, j = heapq.heappop(queue)
        if length > way[i, j]:
            continue
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                a, b = i + di, j + dj
                if not (0 <= a < way.shape[0] and 0 <= b < way.shape[1]):
                    continue
                if free[a, b] and free[a, j] and free[i, b]:
                    longer = length + np.hypot(di, dj)
                    if longer < way[a, b]:
                        way[a, b] = longer
                        heapq.heappush(queue, (longer, a, b))
    return np.where(label, way, 0.0)[1:-1, 1:-1]
