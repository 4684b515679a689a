"""Ground truth: which cells of a known map are dead ends (gate discs; host code, NumPy and SciPy).

With the robot's radius R, the clearance d (distance from a cell's centre to the nearest occupied
cell's centre, less half a cell; outside of the grid counts as free) and the cell size h:

    (1)  F      = {c : d(c) > R}                                  where the robot's centre may be
    (2)  rho(c) = d(c) - R,  gap(c) = 2 d(c)                      half gap in F, gap in the workspace
    (3)  M      = {c in F : gap(c) <= W, rho(c) >= max_3x3 rho - 0.36 h}             medial axis of F
    (4)  D(g)   = {x : |x - g| <= rho(g) + h}                     the gate: it fills the gap at g
    (5)  c is a dead end iff some g in M leaves c in a component P of F without D(g), such that
         (a) no anchor is in P and, for a trip, no cell of its path in D(g),
         (b) max_{x in P} |x - g| - rho(g) >= max(2 R + 0.5 m, kappa gap(g)),
         (c) |P| <= max_share |part of F that P was cut from|.

Components are 4-connected. Anchors: whatever lies outside of the grid and, for a trip, its path from
start to goal. A part of F without an anchor is closed: there (c) allows one half at most, and labels
are relative to the largest piece. Shares count the cells up to W / 2 + R + 3 h off the grid.
Stated limit: a pillar that leaves two passable gaps in a mouth opens the pocket.

How the pieces P are found without growing any: `cuts`.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32
from scipy import ndimage, spatial
from scipy.sparse import csgraph, csr_array

from drnav_jax.worlds.cuts import grow, pieces, spans

_CROSS = ndimage.generate_binary_structure(2, 1)
_BOX = ndimage.generate_binary_structure(2, 2)
_STRAIGHT = ((0, 1), (1, 0), (0, -1), (-1, 0))
_DIAGONAL = ((1, 1), (1, -1), (-1, 1), (-1, -1))


@dataclasses.dataclass(frozen=True)
class LabelSpec:
    """What counts as a dead end, and for which robot."""

    radius: float = 0.25  # [m] robot radius R
    mouth: float = 5.0  # [m] widest mouth of interest W
    depth_ratio: float = 0.75  # [] least depth beyond a gate over its gap, kappa
    max_share: float = 0.5  # [] largest share of a connected part that may be cut off

    def __post_init__(self):
        """Raises ValueError for values that define no gate."""
        if not self.radius > 0:
            raise ValueError(f"radius must be > 0 m, got {self.radius}.")
        if not 2 * self.radius < self.mouth < np.inf:
            raise ValueError(f"mouth must be > 2 radius = {2 * self.radius} m, got {self.mouth}.")
        if not self.depth_ratio >= 0:
            raise ValueError(f"depth_ratio must be >= 0, got {self.depth_ratio}.")
        if not 0 < self.max_share <= 1:
            raise ValueError(f"max_share must lie in (0, 1], got {self.max_share}.")


class DeadEndLabels(NamedTuple):
    """Labels of one map, on its grid, and of its P pockets; cells that are not in F belong to none."""

    label: Bool[np.ndarray, "H W"]  # True = dead end
    depth: Float32[np.ndarray, "H W"]  # [m] beyond the mouth: way in F to a cell without label
    gap: Float32[np.ndarray, "H W"]  # [m] of the narrowest gate that cuts the cell off, else inf
    pocket: Int32[np.ndarray, "H W"]  # id, from 1, of the outermost pocket; 0 = none
    mouth: Int32[np.ndarray, "P 2"]  # (row, column) of each pocket's gate; may lie off the grid
    mouth_gap: Float32[np.ndarray, " P"]  # [m] its gap. Of the gates outside of the pocket it cuts off most


def dead_ends(
    occupied: Bool[np.ndarray, "H W"],
    resolution: float,
    spec: LabelSpec = LabelSpec(),  # noqa: B008  (frozen)
    *,
    trip_path: Int[np.ndarray, "L 2"] | None = None,
    clearance: Float[np.ndarray, "H W"] | None = None,
    spacing: float = 0.0,
) -> DeadEndLabels:
    """Labels the dead ends of a map: goal-free, or for one trip.

    Args:
        occupied: True = obstacle. Unknown cells are the caller's choice; outside is free.
        resolution: Cell size h [m].
        spec: The robot, and what is of interest.
        trip_path: (row, column) of the cells of the shortest path from start to goal, ends included.
        clearance: d of eq. 1 [m], used inside the grid if it is known better than from `occupied`;
            it must not be truncated at or below W / 2.
        spacing: Gates nearer than this [m] to one taken before are skipped; 0 skips none.

    Returns:
        Label, depth, gap and pocket of each cell. A closed part may be labelled as a whole: it has
        no way out, and depth 0.

    Raises:
        ValueError: If an input is malformed.
    """
    _check(occupied, resolution, trip_path, clearance, spacing)
    half = spec.mouth / 2 - spec.radius
    rim = int(np.ceil((spec.mouth / 2 + spec.radius) / resolution)) + 3
    pad = max(rim + 1, int(np.ceil((half + spec.mouth / 2) / resolution)) + 5)  # no disc gets there
    reach = clearance_of(occupied, resolution, clearance, pad) - spec.radius
    free = reach > 0
    free[[0, -1]] = free[:, [0, -1]] = False  # flat offsets never wrap around
    ridge = free & (reach <= half)
    ridge &= reach >= ndimage.maximum_filter(reach, 3) - 0.36 * resolution
    gates = np.argwhere(ridge)
    if spacing > 0:
        gates = _thinned(gates, ridge.shape, max(1, int(spacing / resolution / 2)))
    gates = gates[np.argsort(-reach[tuple(gates.T)], kind="stable")]  # narrow ones paint over wide
    squares = np.floor((reach[tuple(gates.T)] / resolution + 1.0) ** 2).astype(int)
    anchors = np.array([[1, 1]])
    if trip_path is not None:
        path = trip_path.astype(int) + pad
        anchors = np.concatenate([anchors, path[free[tuple(path.T)]]])
        apart = np.rint(spatial.KDTree(path).query(gates)[0] ** 2) > squares
        gates, squares = gates[apart], squares[apart]
    counted = np.zeros(free.shape, bool)
    counted[pad - rim : rim - pad, pad - rim : rim - pad] = True
    gap, cuts = _narrowest(free, anchors, counted, gates, squares, reach, resolution, spec)
    label = np.isfinite(gap)
    inside = (slice(pad, -pad), slice(pad, -pad))
    component = _label(label)
    pocket = component[inside]
    met = np.bincount(pocket.ravel(), minlength=component.max() + 1)[1:] > 0
    number = np.append(0, np.where(met, np.cumsum(met), 0))  # some lie outside
    mouth = np.zeros(number.max() + 1, int)  # gate of each; a later one of the same area is narrower
    outermost = np.lexsort((cuts[:, 0], ~label[tuple(gates[cuts[:, 1]].T)]))  # stable
    for gate, cell in cuts[outermost, 1:].tolist():
        mouth[number[component.flat[cell]]] = gate
    mouth = mouth[1:]
    return DeadEndLabels(
        label=label[inside],
        depth=(way_out(free, label) * resolution)[inside].astype(np.float32),
        gap=gap[inside].astype(np.float32),
        pocket=number[pocket].astype(np.int32),
        mouth=(gates[mouth] - pad).astype(np.int32),
        mouth_gap=(2 * (reach[tuple(gates[mouth].T)] + spec.radius)).astype(np.float32),
    )


def _check(occupied, resolution, trip_path, clearance, spacing):
    shape = occupied.shape
    if occupied.ndim != 2 or occupied.dtype != bool or not occupied.size:
        raise ValueError(f"occupied must be [H, W] of bool, not {shape} of {occupied.dtype}.")
    if not 0 < resolution < np.inf:
        raise ValueError(f"resolution must be > 0 m, got {resolution}.")
    if not 0 <= spacing < np.inf:
        raise ValueError(f"spacing must be >= 0 m, got {spacing}.")
    if clearance is not None and (clearance.shape != shape or np.isnan(clearance).any()):
        raise ValueError(f"clearance must be {shape} in m without NaN, got {clearance.shape}.")
    if trip_path is not None:
        if trip_path.ndim != 2 or trip_path.shape[1] != 2 or not len(trip_path):
            raise ValueError(f"trip_path must be [L, 2] with L > 0, got {trip_path.shape}.")
        for cell in trip_path[((trip_path < 0) | (trip_path >= shape)).any(axis=1)].tolist():
            raise ValueError(f"trip_path must stay in the {shape} cells of the grid, got {cell}.")


def clearance_of(occupied, resolution, known=None, pad=0):
    """Clearance d of eq. 1 [m] on the grid padded by `pad` free cells, inf where nothing is occupied."""
    grid = np.pad(occupied, pad)
    d = np.full(grid.shape, np.inf)
    if occupied.any():
        d = ndimage.distance_transform_edt(~grid) * resolution - 0.5 * resolution
    if known is not None:
        squares = np.clip(known.astype(float) / resolution + 0.5, 0, 1e6) ** 2
        # On a grid they are integers: without float32's noise ties fall as if d were not given.
        whole = np.abs(squares - np.rint(squares)) < 1e-2
        squares[whole] = np.rint(squares[whole])
        d[pad : pad + len(occupied), pad : pad + occupied.shape[1]] = np.sqrt(squares) * resolution - 0.5 * resolution
    return d


def _label(mask):
    """Number of the 4-connected component of each cell, 0 outside the mask."""
    component = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, _CROSS, output=component)
    return component


def _thinned(gates, shape, step):
    """The gates that, in raster order, have none taken before within `step` cells."""
    taken, kept = np.zeros(shape, bool), []
    for k, (i, j) in enumerate(gates):
        if not taken[max(i - step, 0) : i + step + 1, max(j - step, 0) : j + step + 1].any():
            taken[i, j] = True
            kept.append(k)
    return gates[kept]


def _narrowest(free, anchors, counted, gates, squares, reach, resolution, spec):
    """Gap [m] of the narrowest gate that cuts each cell off, inf where none does (eq. 5), and all cuts.

    A cut is (area, number of the gate, flat cell of a cell that is cut off).
    """
    part = _label(free)
    part_area = np.bincount(part[counted], minlength=part.max() + 1)
    closed = np.ones(len(part_area), bool)
    closed[np.append(part[tuple(anchors.T)], 0)] = False
    root = np.zeros(len(part_area), int)
    root[part.ravel()] = np.arange(part.size)  # any cell of each part
    roots = np.append(np.unique(anchors @ (free.shape[1], 1)), root[closed])
    rng = np.random.default_rng(0)
    tree = grow(part.ravel(), free.shape[1], roots, counted.ravel(), rng)
    # A disc that leaves a single arc leaves all of a part but itself: too much, unless this small.
    small = (closed & (part_area <= 8 * squares.max(initial=0) + 8))[part.ravel()]
    row, column = np.divmod(tree.cell, free.shape[1])
    gap, cuts = np.full(len(tree.cell), np.inf), []
    for k, here, area, lo, hi, sign in pieces(tree, free.shape, small, gates, squares, rng):
        if area <= 0 and closed[here]:  # it holds its part's root, so the sum was minus the rest
            area += part_area[here]
            lo, hi = np.append(lo, tree.lo[root[here]]), np.append(hi, tree.hi[root[here]])
            sign = np.append(sign, 1)
        share = min(spec.max_share, 0.5) if closed[here] else spec.max_share
        if not 0 < area <= share * part_area[here]:
            continue
        (i, j), rho = gates[k], reach[tuple(gates[k])]
        width = 2 * (rho + spec.radius)
        need = max(2 * spec.radius + 0.5, spec.depth_ratio * width)
        runs = spans(lo, hi, sign)
        if area <= np.pi * ((need + rho) / resolution + 1) ** 2:  # else some must lie far enough
            square = max(((row[s] - i) ** 2 + (column[s] - j) ** 2).max() for s in runs)
            if np.sqrt(square) * resolution - rho < need:
                continue
        for s in runs:
            gap[s] = width
        cuts.append((area, k, tree.cell[runs[0].start]))
    out = np.full(free.size, np.inf)
    out[tree.cell] = gap
    return out.reshape(free.shape), np.array(cuts, int).reshape(-1, 3)


def way_out(free, label):
    """Length [cells] of the way in F, 8-connected, from each labelled cell to one without label.

    0 where there is none. Cells on the grid's edge must not be labelled.
    """
    width, shape = free.shape[1], free.shape
    near_label = ndimage.binary_dilation(label, _BOX) & free
    free, label, cells = free.ravel(), label.ravel(), np.flatnonzero(near_label)
    number = np.zeros(len(free), np.int32)
    number[cells] = np.arange(len(cells))
    links = []
    for i, j in _STRAIGHT + _DIAGONAL:  # into labelled cells only, and not around a corner
        ok = label[cells + i * width + j] & free[cells + i * width] & free[cells + j]
        a, b = cells[ok], cells[ok] + i * width + j
        links.append((np.full(len(a), np.hypot(i, j)), number[a], number[b]))
    length, a, b = np.concatenate(links, axis=1)
    graph = csr_array((length, (a.astype(int), b.astype(int))), shape=(len(cells), len(cells)))
    way = np.zeros(len(free))
    sources = np.flatnonzero(~label[cells])
    if len(sources):
        way[cells] = csgraph.dijkstra(graph, indices=sources, min_only=True)
    way[np.isinf(way)] = 0  # a closed part that is labelled as a whole
    return way.reshape(shape)
