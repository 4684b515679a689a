"""A maze: corridors of one width on a grid of cells, a tree of them, so that there is one way through.

The tree grows from its newest cell, and now and then from any: a depth-first walk alone makes no two branches that
neighbour each other, and the twin needs that. The open twin lacks one wall: that at the end of a dead end, behind which the
way goes on and which then is on the shortest way.
"""


import numpy as np

from drnav_jax.worlds.solids import Draw, Layout, Solid, wall, wings

BRANCH = 2  # cells; the dead end that the twin opens is at least this long
NEWEST = 0.7  # share of cells that are grown from the newest one
Cell = tuple[int, int]  # column, row


def _grown(nx: int, ny: int, first: Cell, rng: np.random.Generator) -> dict[Cell, Cell | None]:
    """The cell that each cell was reached from, from the first on."""
    parent: dict[Cell, Cell | None] = {first: None}
    growing = [first]
    while growing:
        k = -1 if rng.random() < NEWEST else int(rng.integers(len(growing)))
        i, j = growing[k]
        near = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
        new = [c for c in near if 0 <= c[0] < nx and 0 <= c[1] < ny and c not in parent]
        if not new:
            growing.pop(k)
            continue
        cell = new[rng.integers(len(new))]
        parent[cell] = (i, j)
        growing.append(cell)
    return parent


def _back(parent: dict[Cell, Cell | None], cell: Cell) -> list[Cell]:
    """Cells from one to the root."""
    way: list[Cell] = []
    at: Cell | None = cell
    while at is not None:
        way.append(at)
        at = parent[at]
    return way


def _shortcut(parent: dict[Cell, Cell | None], last: Cell) -> tuple[Cell, Cell] | None:
    """The wall between the end of a branch and what lies behind it that shortens the way to `last` most, if any does."""
    way = _back(parent, last)
    on_way = {cell: k for k, cell in enumerate(way)}  # steps to `last`
    steps = {cell: len(_back(parent, cell)) - 1 for cell in parent}

    def to_last(cell: Cell) -> int:
        back = _back(parent, cell)
        k = next(k for k, c in enumerate(back) if c in on_way)
        return k + on_way[back[k]]

    best, gain = None, 1
    for a in parent:
        branch = next(k for k, c in enumerate(_back(parent, a)) if c in on_way)
        if branch < BRANCH:
            continue
        i, j = a
        for b in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if b in parent and parent[a] != b and parent[b] != a:
                saved = len(way) - 1 - (steps[a] + 1 + to_last(b))
                if saved > gain:
                    best, gain = (a, b), saved
    return best


def _runs(edges: set[tuple[int, int]]) -> list[tuple[int, int, int]]:
    """(line, first, end) of unbroken runs of edges (line, place)."""
    runs: list[tuple[int, int, int]] = []
    for line, place in sorted(edges):
        if runs and runs[-1][0] == line and runs[-1][2] == place:
            runs[-1] = (line, runs[-1][1], place + 1)
        else:
            runs.append((line, place, place + 1))
    return runs


def maze(draw: Draw, rng: np.random.Generator) -> Layout:
    """The layout of `maze`."""
    nx, ny, pitch, behind = round(draw("columns")), round(draw("rows")), draw("pitch"), draw("behind")
    thickness = rng.uniform(0.15, 0.25)
    entry, leave = int(rng.integers(ny)), int(rng.integers(ny))
    first, last = (0, entry), (nx - 1, leave)
    parent = _grown(nx, ny, first, rng)
    while (opened := _shortcut(parent, last)) is None:
        parent = _grown(nx, ny, first, rng)

    def centre(cell: Cell) -> np.ndarray:
        return np.array([cell[0] * pitch, (cell[1] - entry) * pitch])

    left, bottom = -pitch / 2, (-entry - 0.5) * pitch
    right, top = left + nx * pitch, bottom + ny * pitch
    upright = {(i, j) for i in range(nx + 1) for j in range(ny)} - {(0, entry), (nx, leave)}  # (line, row)
    level = {(j, i) for j in range(ny + 1) for i in range(nx)}  # (line, column)
    for (i, j), before in [*((c, p) for c, p in parent.items() if p is not None), opened]:
        if before[1] == j:
            upright.discard((max(i, before[0]), j))
        else:
            level.discard((max(j, before[1]), i))
    (a, b), half = opened, pitch / 2
    middle = (centre(a) + centre(b)) / 2
    across = np.array([0.0, half]) if a[1] == b[1] else np.array([half, 0.0])
    plug = wall((middle[0] - across[0], middle[1] - across[1]), (middle[0] + across[0], middle[1] + across[1]), thickness)

    solids: list[Solid] = []
    for line, begin, end in _runs(upright):
        x = left + line * pitch
        solids.append(wall((x, bottom + begin * pitch), (x, bottom + end * pitch), thickness))
    for line, begin, end in _runs(level):
        y = bottom + line * pitch
        solids.append(wall((left + begin * pitch, y), (left + end * pitch, y), thickness))
    solids += wings(left, bottom, top, thickness)
    way = np.array([centre(c) for c in reversed(_back(parent, last))])
    goal = (right + behind, float(np.clip(centre(last)[1] + rng.uniform(-2, 2), bottom, top)))
    out = np.array([[right + 0.5, centre(last)[1]], goal])
    hull = (left - thickness, bottom - thickness, right + thickness, top + thickness)
    return Layout(
        solids=solids, plugs=[plug], doorposts=[], ways=[np.concatenate([way, out])], hull=hull, start=(0.0, 0.0), goal=goal
    )


LAYOUTS = {"maze": maze}
