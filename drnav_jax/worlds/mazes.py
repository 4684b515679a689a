"""Mazes: a grid of cells between walls, one way through, some loops, and dead ends of all sizes.

The maze is a spanning tree of the grid with a few more walls taken out (`networks`). Its open twin has some of the dead
ends opened, at least one of which makes the way through shorter by `SAVING` cells or more. A maze is drawn again until
the trip meets `decisions` side branches that lead nowhere and one of them can be such a shortcut.

Walls are walls, or hedges: then plants and grass close and cross the passages. Elsewhere it is panes and frames, doors,
crates, drops and paint. All of these also stand where both twins are open, or both closed.
"""

from typing import NamedTuple

import numpy as np

from drnav_jax.worlds import networks
from drnav_jax.worlds.closures import close, fits
from drnav_jax.worlds.covering import cover
from drnav_jax.worlds.networks import Edge
from drnav_jax.worlds.solids import WAY, Draw, Layout, Point, Rect, Solid, box, post

WING = 100.0  # [m] of wall to either side: nobody walks around a maze
SAVING = 4.0  # [cells] by which a shortcut is shorter
TRIES = 300  # mazes drawn until one is as it should
HEDGES = 0.3  # share of the mazes whose walls are hedges
HEDGE_KINDS = ("hedge", "hedge", "crates", "drop")
WALL_KINDS = ("glass", "door", "crates", "drop", "wall", "glass")


class _Grid(NamedTuple):
    """Cells of a maze: cell (i, j) is node i + columns j."""

    columns: int
    rows: int
    pitch: float
    thickness: float

    @property
    def edges(self) -> list[Edge]:
        return networks.grid_edges(self.columns, self.rows)

    def centre(self, node: int) -> Point:
        j, i = divmod(node, self.columns)
        return ((i + 0.5) * self.pitch, (j + 0.5) * self.pitch)

    def gap(self, edge: Edge) -> tuple[Point, Point]:
        """Jambs of the passage between two cells, between the posts of the grid."""
        (ax, ay), (bx, by) = self.centre(edge[0]), self.centre(edge[1])
        x, y, h = (ax + bx) / 2, (ay + by) / 2, (self.pitch - self.thickness) / 2
        return ((x, y - h), (x, y + h)) if ay == by else ((x - h, y), (x + h, y))

    def wall(self, edge: Edge) -> Rect:
        """The wall between two cells, posts included."""
        (x0, y0), (x1, y1) = self.gap(edge)
        h, t = self.thickness / 2, self.thickness
        return (x0 - h, y0 - t, x1 + h, y1 + t) if x0 == x1 else (x0 - t, y0 - h, x1 + t, y1 + h)


def maze(draw: Draw, rng: np.random.Generator) -> Layout:
    """A maze between a stem in which the robot starts and an exit on the far side, beyond which the goal lies."""
    hedges = rng.random() < HEDGES
    width = draw("width")
    thickness = rng.uniform(0.5, 0.7) if hedges else rng.uniform(0.15, 0.3)
    columns, rows = int(draw("columns")), int(draw("rows"))
    grid = _Grid(columns, rows, width + thickness, thickness)
    ways, opened, entry, out, trip = _ways(grid, draw, rng)
    shut = [e for e in grid.edges if e not in ways and e not in opened]

    role = "hedge" if hedges else "wall"
    solids, plugs, doorposts = [], [], []
    rects = [grid.wall(e) for e in shut]
    depth = thickness + width - WAY  # to either side of the wall half of what WAY leaves; the other half is clutter's
    kinds = [k for k in (HEDGE_KINDS if hedges else WALL_KINDS) if fits(k, width, depth)]

    def kind() -> str:
        return kinds[rng.integers(len(kinds))]

    busy: set[int] = set()  # cells beside something
    for k, e in enumerate(opened):
        busy |= set(e)
        made = close(kind(), *grid.gap(e), thickness, depth, rng, number=k, wall=role)
        solids, plugs, doorposts = solids + made.both, plugs + made.closed, doorposts + made.opened
    # The same things where both twins are open, and where both are closed.
    for k in range(int(draw("decoys"))):
        left = [e for e in (shut if k % 2 else sorted(ways)) if not busy & set(e)]
        if not left:
            continue
        e = left[int(rng.integers(len(left)))]
        if e in shut:
            rects.remove(grid.wall(e))
        busy |= set(e)
        made = close(kind(), *grid.gap(e), thickness, depth, rng, number=100 + k, wall=role)
        solids += made.fixed(is_open=e in ways)

    stem = draw("stem")
    hull = (0.0, 0.0, columns * grid.pitch, rows * grid.pitch)
    solids += [box(r, role) for r in cover([*rects, *_outside(grid, hull, entry, out, stem), *_posts(grid)])]
    h, far = thickness / 2, hull[2]
    for y0, y1 in ((-WING, -h), (hull[3] + h, hull[3] + WING)):
        solids.append(box((-h, y0, h, y1), role))
    (_, y), (_, goal_y) = grid.centre(entry), grid.centre(out)
    start = (-stem + rng.uniform(0.8, 1.5), y)
    goal = (far + draw("behind"), goal_y + rng.uniform(-1.5, 1.5))
    solids += _corner_posts(grid, busy, width, rng)
    line = np.array([start, *(grid.centre(n) for n in trip), (far, goal_y), goal])
    return Layout(
        solids=solids,
        plugs=plugs,
        doorposts=doorposts,
        ways=[line],
        hull=(-stem, -h, far + h, hull[3] + h),
        start=start,
        goal=goal,
    )


def _ways(grid: _Grid, draw: Draw, rng: np.random.Generator) -> tuple[set[Edge], list[Edge], int, int, list[int]]:
    """Passages of both twins, those only of the open one, the cells at entry and exit, and the closed twin's way."""
    winding, share, wanted, more = draw("winding"), draw("loops"), int(draw("decisions")), int(draw("more"))
    length = dict.fromkeys(grid.edges, 1.0)
    best: tuple | None = None
    for _ in range(TRIES):
        entry = grid.columns * int(rng.integers(grid.rows))
        out = grid.columns * int(rng.integers(grid.rows)) + grid.columns - 1
        tree = networks.grow(grid.edges, int(rng.integers(grid.columns * grid.rows)), winding, rng)
        ways = networks.braid(grid.edges, tree, share, rng)
        trip = networks.route(ways, length, entry, out).nodes
        branches = networks.side_branches(ways, trip)
        leads = set().union(*branches.values()) if branches else set()
        shut = [e for e in grid.edges if e not in ways and (e[0] in leads) != (e[1] in leads)]
        short = networks.shortcuts(shut, ways, length, entry, out, SAVING)
        if short and (best is None or len(branches) > best[0]):
            best = (len(branches), ways, short, leads, entry, out, trip)
        if best is not None and best[0] >= wanted:
            break
    if best is None:
        raise RuntimeError(f"{TRIES} mazes of {grid.columns} x {grid.rows} cells had no shortcut.")  # none ever did
    _, ways, short, leads, entry, out, trip = best
    opened = [short[int(rng.integers(min(3, len(short))))]]
    others = [e for e in grid.edges if e not in ways and e not in opened and (e[0] in leads) != (e[1] in leads)]
    for k in rng.permutation(len(others))[:more]:
        opened.append(others[k])
    return ways, opened, entry, out, trip


def _outside(grid: _Grid, hull: Rect, entry: int, out: int, stem: float) -> list[Rect]:
    """The outer walls with a way in and a way out, and the two sides of the stem."""
    h, (x0, y0, x1, y1) = grid.thickness / 2, hull
    half = (grid.pitch - grid.thickness) / 2
    rects = [(x0 - h, y0 - h, x1 + h, y0 + h), (x0 - h, y1 - h, x1 + h, y1 + h)]
    for x, node in ((x0, entry), (x1, out)):
        _, y = grid.centre(node)
        rects += [(x - h, y0 - h, x + h, y - half), (x - h, y + half, x + h, y1 + h)]
    _, y = grid.centre(entry)
    return [*rects, (-stem, y - half - 2 * h, h, y - half), (-stem, y + half, h, y + half + 2 * h)]


def _posts(grid: _Grid) -> list[Rect]:
    """Posts of the grid: what passages are jambed by where no wall ends."""
    h = grid.thickness / 2
    return [
        (i * grid.pitch - h, j * grid.pitch - h, i * grid.pitch + h, j * grid.pitch + h)
        for i in range(1, grid.columns)
        for j in range(1, grid.rows)
    ]


def _corner_posts(grid: _Grid, busy: set[int], width: float, rng: np.random.Generator) -> list[Solid]:
    """Bollards and crates in corners of cells, where the passages are wide enough to leave WAY."""
    size = (width - WAY) / 2
    if size < 0.3:
        return []
    solids = []
    count = grid.columns * grid.rows
    for k, node in enumerate(rng.permutation(count)[: count // 6].tolist()):
        if node in busy:
            continue
        (x, y), reach = grid.centre(node), rng.uniform(0.12, min(size / 2, 0.35))
        sx, sy = rng.choice([-1.0, 1.0], 2)
        x, y = x + sx * (width / 2 - reach), y + sy * (width / 2 - reach)
        if rng.random() < 0.5:
            solids.append(post(x, y, reach, f"barrel:{k}", rng.uniform(0.7, 1.4)))
        else:
            rect = (x - reach, y - reach, x + reach, y + reach)
            solids.append(box(rect, f"crate:{k}", 0.0, rng.uniform(0.6, 1.4)))
    return solids
