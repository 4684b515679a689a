"""Dead-end labels by brute force: every gate of the medial axis, every component grown anew."""

import collections
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


def dead_ends(occupied, resolution, spec, path=None):
    """Label and gap of the narrowest gate of each cell, by the definition's own words."""
    radius, mouth = spec.radius, spec.mouth
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
            if anchor[piece].any() or share > spec.max_share or (closed and share > 0.5):
                continue
            way = np.hypot(rows[piece] - i, columns[piece] - j).max() * resolution - reach[i, j]
            if way >= max(2 * radius + 0.5, spec.depth_ratio * width):
                label |= piece
                gap[piece] = np.minimum(gap[piece], width)
    inner = (slice(pad, -pad), slice(pad, -pad))
    return label[inner], gap[inner]


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


def any_path(free, rng):
    """Cells of a shortest 4-connected way between two random cells, or None where there is none."""
    cells = [tuple(c) for c in np.argwhere(free).tolist()]
    if not cells:
        return None
    start, goal = (cells[k] for k in rng.integers(len(cells), size=2))
    before, queue = {start: None}, collections.deque([start])
    while queue:
        i, j = queue.popleft()
        for near in ((i, j + 1), (i + 1, j), (i, j - 1), (i - 1, j)):
            inside = 0 <= near[0] < free.shape[0] and 0 <= near[1] < free.shape[1]
            if inside and free[near] and near not in before:
                before[near] = (i, j)
                queue.append(near)
    if goal not in before:
        return None
    path = [goal]
    while before[path[-1]] is not None:
        path.append(before[path[-1]])
    return np.array(path[::-1])
