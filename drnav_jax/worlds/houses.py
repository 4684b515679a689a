"""Houses of a compound: solid but for corridors from the ports to the hub, ends of corridors, rooms, a hall with lifts."""

import numpy as np

from drnav_jax.worlds.cells import DIRECTION, EAST, NORTH, SOUTH, WEST, Cell, clipped, hub, inside, meet
from drnav_jax.worlds.closures import close
from drnav_jax.worlds.clutter import furniture
from drnav_jax.worlds.covering import cover
from drnav_jax.worlds.solids import LINTEL, Point, Rect, Solid, box, portal

HOUSES = ("corridors", "lobby", "rooms")
THIN = 0.2  # [m] inner walls
LEAST = 2.5  # [m] length of a corridor that ends


def _along(p: Point, q: Point, width: float) -> Rect:
    """The corridor between two points on a line along x or y, with square ends."""
    h = width / 2
    return (min(p[0], q[0]) - h, min(p[1], q[1]) - h, max(p[0], q[0]) + h, max(p[1], q[1]) + h)


def house(cell: Cell, kind: str, width: float, rng: np.random.Generator) -> list[Solid]:
    """A house of a kind of `HOUSES`; `width` [m] is that of its corridors."""
    if kind == "lobby":
        hollow, solids = _lobby(cell, width, rng)
    else:
        hollow, solids = _corridors(cell, width, rng)
        if kind == "rooms":
            _add_rooms(cell, hollow, solids, rng)
    free = [clipped(r, cell.rect) for r in hollow]
    return [*(box(r, f"house:{cell.number}") for r in cover([cell.rect], free)), *solids]


def _corridors(cell: Cell, width: float, rng: np.random.Generator) -> tuple[list[Rect], list[Solid]]:
    """Corridors from all ports to the hub, and stubs to the blind sides, some of which turn once more."""
    middle, hollow = hub(cell), []
    for port in cell.ports:
        x, y = cell.point(port, -1.0)
        corner = (middle[0], y) if port.side in (EAST, WEST) else (x, middle[1])
        hollow += [_along((x, y), corner, width), _along(corner, middle, width)]
    x0, y0, x1, y1 = cell.rect
    for side in cell.blind:
        dx, dy = DIRECTION[side]
        far = (x1 - middle[0], y1 - middle[1], middle[0] - x0, middle[1] - y0)[side] - width / 2 - rng.uniform(0.4, 1.2)
        if far < LEAST + width / 2:
            continue
        end = (middle[0] + dx * far, middle[1] + dy * far)
        stub = [_along(middle, end, width)]
        turn = float(rng.choice([-1.0, 1.0]))
        bent = (end[0] - turn * dy * (width + LEAST), end[1] + turn * dx * (width + LEAST))
        arm = _along(end, bent, width)
        if rng.random() < 0.5 and inside(arm, cell.rect, 0.3) and not any(meet(arm, r, THIN) for r in hollow):
            stub.append(arm)
        hollow += stub
    return hollow, []


def _add_rooms(cell: Cell, hollow: list[Rect], solids: list[Solid], rng: np.random.Generator) -> None:
    """Rooms with one door beside the corridors, where there is room; beside them doors that are shut."""
    corridors, number = list(hollow), 0
    for _ in range(40):
        x0, y0, x1, y1 = clipped(corridors[rng.integers(len(corridors))], cell.rect)
        along_x = x1 - x0 > y1 - y0
        lo, hi = (x0, x1) if along_x else (y0, y1)
        wide, deep, half = rng.uniform(2.4, 4.2), rng.uniform(2.4, 4.0), rng.uniform(0.5, 0.6)
        if hi - lo < 2 * half + 1.0 or number >= 4:
            continue
        at = rng.uniform(lo + half + 0.4, hi - half - 0.4)
        start = at - rng.uniform(half + 0.15, wide - half - 0.15)
        up = rng.random() < 0.5
        face = (y1 if up else y0) if along_x else (x1 if up else x0)
        low, high = (face + THIN, face + THIN + deep) if up else (face - THIN - deep, face - THIN)
        room = (start, low, start + wide, high) if along_x else (low, start, high, start + wide)
        near, far = (face, face + THIN) if up else (face - THIN, face)
        hole = (at - half, near, at + half, far) if along_x else (near, at - half, far, at + half)
        if not inside(room, cell.rect, 0.3) or any(meet(room, r, THIN - 1e-6) for r in hollow):
            continue
        number += 1
        a, b = (
            ((at - half, (near + far) / 2), (at + half, (near + far) / 2))
            if along_x
            else (((near + far) / 2, at - half), ((near + far) / 2, at + half))
        )
        inward = (1.0 if up else -1.0) * (1.0 if along_x else -1.0)
        made = close(
            "door", a, b, THIN, 3.0, rng, number=100 * cell.number + number, wall=f"house:{cell.number}", side=inward
        )
        solids += made.fixed(is_open=True)
        middle = ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2)
        into = 1.3 if up else -1.3
        line = np.array([middle, (middle[0], middle[1] + into) if along_x else (middle[0] + into, middle[1])])
        solids += renamed(furniture(room, [line], int(rng.integers(0, 3)), rng), 100 * cell.number + number)
        hollow += [room, hole]


def _lobby(cell: Cell, width: float, rng: np.random.Generator) -> tuple[list[Rect], list[Solid]]:
    """A corridor from the only port to a hall with lifts in its back wall."""
    (port,) = cell.ports
    x0, y0, x1, y1 = cell.rect
    span, across = ((x1 - x0), (y0, y1)) if port.side in (EAST, WEST) else ((y1 - y0), (x0, x1))
    run, deep = rng.uniform(1.5, max(span - 5.5, 1.6)), rng.uniform(2.6, 3.6)
    door, hall = rng.uniform(0.9, 1.2), min(rng.uniform(4.0, 7.0), across[1] - across[0] - 0.8)
    low = min(max(port.at - rng.uniform(0.3, 0.7) * hall, across[0] + 0.4), across[1] - 0.4 - hall)
    sign = 1.0 if port.side in (WEST, SOUTH) else -1.0
    face = {EAST: x1, NORTH: y1, WEST: x0, SOUTH: y0}[port.side]
    at = (face + sign * run, face + sign * (run + deep))  # front and back of the hall

    def placed(a: tuple[float, float], b: tuple[float, float]) -> Rect:
        """A rectangle out of a span in the port's direction and one across it."""
        a, b = (min(a), max(a)), (min(b), max(b))
        return (a[0], b[0], a[1], b[1]) if port.side in (EAST, WEST) else (b[0], a[0], b[1], a[1])

    h = width / 2
    hollow = [placed((face - sign, at[0] + sign * 0.1), (port.at - h, port.at + h)), placed(at, (low, low + hall))]
    solids: list[Solid] = []
    for y in np.linspace(low, low + hall, 2 * max(1, int(hall // (door + 0.8))) + 1)[1::2].tolist():
        leaf = placed((at[1] - 0.05, at[1] + 0.05), (y - door / 2, y + door / 2))
        solids.append(box(leaf, f"lift:{cell.number}", 0.0, LINTEL))
        along_x = port.side in (EAST, WEST)
        centre = (at[1], y) if along_x else (y, at[1])
        solids += portal(*centre, along_x, door, f"frame:{cell.number}", 0.12, 0.14)
    return hollow, solids


def renamed(pieces: list[Solid], number: int) -> list[Solid]:
    """Furniture with colours of its own in each room."""
    return [Solid(s.row, f"crate:{number}.{k}") for k, s in enumerate(pieces)]
