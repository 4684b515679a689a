"""Grid algorithms that all layers share, as jitted pure functions over `[H, W]` arrays.

They know cells only; `geometry` knows where cells lie. Distances are in metres through `resolution`.

- `distance_transform`: exact Euclidean distance between cell centres, truncated at a static radius n. Separable
  (Felzenszwalb & Huttenlocher 2012): D(i, j)^2 = min_a [a^2 + min_b (b^2 : mask(i + a, j + b))], minima over |.| <= n.
- `flood_fill`: 4-connected fill on 32 cells per machine word.
- `cost_to_go`: V <- min(V, min_k V(c + k) + |k| cost(c)) over 16 neighbours (queen and knight moves: in the open the
  metric is at most 2.7 % longer than Euclid's) until nothing changes; equals Dijkstra on that graph. Row by row, up and
  down, then column by column (fast sweeping, Zhao 2005): a round settles all paths that do not turn back in x or in y.
- `descend`: the path that follows V downhill.
"""

import functools
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

from drnav_jax.types import Scalar

UNREACHABLE = 1e4  # [m] value of a cell from which no goal can be reached, cost of a cell that cannot be entered

_STRAIGHT = ((0, 1), (0, -1), (1, 0), (-1, 0))
_DIAGONAL = ((1, 1), (1, -1), (-1, 1), (-1, -1))
_KNIGHT = ((1, 2), (1, -2), (-1, 2), (-1, -2), (2, 1), (2, -1), (-2, 1), (-2, -1))


def once(values: Any) -> Any:
    """The values themselves, computed before they are used, and only once.

    On CPU, XLA fuses whatever it can into each of its uses, and computes it there anew for every element that is read:
    a stencil over a mask evaluates what makes the mask once per neighbour. A loop is what it does not look through (of
    `optimization_barrier` nothing is left when it fuses). On accelerators it is the identity.

    Args:
        values: Arrays; a pytree.
    """
    if jax.default_backend() != "cpu":
        return values
    return jax.lax.fori_loop(0, 2, lambda _, pair: pair[::-1], (values, values))[0]


def lesser(a: Array, b: Scalar) -> Array:
    """The lesser of two numbers: one instruction on CPU, where `jnp.minimum`, which must hand on NaN, takes five."""
    return jnp.where(a < b, a, b)


def greater(a: Array, b: Scalar) -> Array:
    """The greater of two numbers; see `lesser`."""
    return jnp.where(a > b, a, b)


def least(values: Float[Array, " K"], num: int) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """The `num` least of K values and where they are, the least first; of equals the first comes first."""
    # behind the barrier, since whoever slices what `top_k` gives makes XLA sort all K instead, at twenty times its cost
    found, index = jax.lax.optimization_barrier(jax.lax.top_k(-values, num))
    return -found, index


def pool(values: Array, by: int, reduce: str) -> Array:
    """Coarser cells: "max", "sum", "mean", "any", "all" over blocks of `by` x `by`."""
    two = {"max": jnp.maximum, "any": jnp.logical_or, "all": jnp.logical_and}.get(reduce, jnp.add)
    # rows, then columns, as whole slices: several times as fast as reducing axes of `[h, by, w, by]`
    rows = functools.reduce(two, [values[k::by] for k in range(by)])
    blocks = functools.reduce(two, [rows[:, k::by] for k in range(by)])
    return blocks * (1.0 / by**2) if reduce == "mean" else blocks


def repeat(values: Array, by: int) -> Array:
    """Finer cells: each cell's value on `by` x `by`."""
    return jnp.repeat(jnp.repeat(values, by, axis=0), by, axis=1)


@partial(jax.jit, static_argnames=("max_distance", "resolution"))
def distance_transform(mask: Bool[Array, "H W"], resolution: float, max_distance: float) -> Float[Array, "H W"]:
    """Distance [m] from each cell's centre to the centre of the nearest True cell, at most `max_distance`.

    Args:
        mask: True where the distance is zero.
        resolution: Edge of a cell [m].
        max_distance: Truncation [m]; the cost grows with it.
    """
    h, w = mask.shape
    n = int(max_distance / resolution + 1e-6)
    far = (n + 1) ** 2
    # in whole cells: XLA vectorises the least of integers far better than that of floats
    kind = jnp.int16 if 2 * far < 2**15 else jnp.int32
    padded = once(jnp.pad(once(jnp.where(mask, kind(0), kind(far))), n, constant_values=far))
    rows = padded[:, n : n + w]
    for k in range(1, n + 1):
        rows = jnp.minimum(rows, jnp.minimum(padded[:, n - k : n - k + w], padded[:, n + k : n + k + w]) + k * k)
    padded = once(rows)
    out = padded[n : n + h]
    for k in range(1, n + 1):
        out = jnp.minimum(out, jnp.minimum(padded[n - k : n - k + h], padded[n + k : n + k + h]) + k * k)
    limit = (max_distance / resolution) ** 2
    return once(jnp.sqrt(jnp.minimum(out.astype(jnp.float32), limit)) * resolution)


def _pack(mask: Bool[Array, "H W"]) -> Array:
    """32 cells per word along x, `[H, ceil(W / 32)]` uint32, lowest bit = lowest column."""
    h, w = mask.shape
    bits = jnp.pad(mask, ((0, 0), (0, -w % 32))).reshape(h, -1, 32).astype(jnp.uint32)
    return jnp.sum(bits << jnp.arange(32, dtype=jnp.uint32)[None, None, :], axis=-1, dtype=jnp.uint32)


def _unpack(words: Array, width: int) -> Bool[Array, "H W"]:
    bits = (words[..., None] >> jnp.arange(32, dtype=jnp.uint32)[None, None, :]) & jnp.uint32(1)
    return bits.reshape(words.shape[0], -1)[:, :width].astype(bool)


@jax.jit
def flood_fill(passable: Bool[Array, "H W"], seeds: Bool[Array, "H W"]) -> Bool[Array, "H W"]:
    """Cells that a 4-connected walk over passable cells reaches from the passable seeds.

    Args:
        passable: Cells one may stand on.
        seeds: Where walks begin; seeds that are not passable are ignored.
    """
    height = passable.shape[0]
    may, one, top = _pack(passable), jnp.uint32(1), jnp.uint32(31)

    def spread(filled: Array) -> Array:
        padded = jnp.pad(filled, ((1, 1), (1, 1)))
        middle = padded[1:-1]
        east = (filled << one) | (middle[:, :-2] >> top)
        west = (filled >> one) | (middle[:, 2:] << top)
        return may & (filled | east | west | padded[:height, 1:-1] | padded[2:, 1:-1])

    def sweep(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        before = carry[0]
        after = before
        for _ in range(4):
            after = spread(after)
        return after, jnp.any(after != before)

    filled, _ = jax.lax.while_loop(lambda c: c[1], sweep, (_pack(seeds) & may, jnp.asarray(True)))
    return once(_unpack(filled, passable.shape[1]))


def _everywhere(mask: Bool[Array, "H W"], rows: tuple[int, int], cols: tuple[int, int]) -> Bool[Array, "H W"]:
    """Whether the mask holds on all cells from (i - rows[0], j - cols[0]) to (i + rows[1], j + cols[1]).

    Beyond the edge it does.
    """
    h, w = mask.shape
    padded = jnp.pad(mask, (rows, cols), constant_values=True)
    along = functools.reduce(jnp.logical_and, [padded[:, k : k + w] for k in range(sum(cols) + 1)])
    return functools.reduce(jnp.logical_and, [along[k : k + h] for k in range(sum(rows) + 1)])


def _step_costs(
    cell_cost: Float[Array, "H W"], resolution: Scalar, east: Array | None, north: Array | None
) -> list[Array]:
    """What each move costs from each cell, straight ones first, knight moves last; `UNREACHABLE` if not allowed."""
    h, w = cell_cost.shape
    enter = cell_cost < UNREACHABLE
    ahead = jnp.pad(enter, ((0, 1), (0, 1)))
    east = (enter & ahead[:h, 1:]) if east is None else (east & enter & ahead[:h, 1:])
    north = (enter & ahead[1:, :w]) if north is None else (north & enter & ahead[1:, :w])
    west, south = jnp.pad(east, ((0, 0), (1, 0)))[:, :w], jnp.pad(north, ((1, 0), (0, 0)))[:h]
    # at the window's edge there is no side to be open: it does not make a cell narrow
    last_row, last_col = (jnp.arange(h) == h - 1)[:, None], (jnp.arange(w) == w - 1)[None, :]

    def roomy(n: int) -> Array:
        sides = _everywhere(east | last_col, (n, n), (n, n - 1)) & _everywhere(north | last_row, (n, n - 1), (n, n))
        return _everywhere(enter, (n, n), (n, n)) & sides

    step = jnp.minimum(cell_cost * resolution, UNREACHABLE)
    gate = lambda allowed, length: jnp.where(allowed, length * step, UNREACHABLE)  # noqa: E731
    diagonal, knight = gate(roomy(1), 2**0.5), gate(roomy(2), 5**0.5)
    return [gate(a, 1.0) for a in (east, west, north, south)] + [diagonal] * 4 + [knight] * 8


def _allowed(costs: list[Array]) -> UInt8[Array, "H W"]:
    """Which of the moves are allowed from each cell, one bit each.

    The sweeps wait for memory more than they compute: with a byte and one cost per cell instead of a cost per move they
    take half the time.
    """
    return functools.reduce(
        jnp.bitwise_or, [(cost < UNREACHABLE).astype(jnp.uint8) << bit for bit, cost in enumerate(costs)]
    )


def _sweep(
    value: Float[Array, "H W"], step: Float[Array, "H W"], allowed: UInt8[Array, "H W"], straight: tuple[int, int]
) -> Float[Array, "H W"]:
    """Settle all paths along which rows only fall, and all along which they only rise.

    Args:
        value: V so far.
        step: Cost of a straight move from each cell.
        allowed: `_allowed` of east, west, north, south, diagonal and knight moves.
        straight: Bits of the straight moves to lower rows, and to higher rows.
    """
    h, w = value.shape
    ahead = jnp.asarray(straight, jnp.uint8)[:, None]

    def both(array: Array, i: Array) -> Array:
        return jnp.concatenate([jax.lax.dynamic_slice(array, (k, 0), (1, w)) for k in (i, h - 1 - i)])

    def settle(i: Array, rows: Array) -> Array:
        two, one = jax.lax.dynamic_slice(rows, (i, 0, 0), (2, 2, w + 4))
        cost, moves = both(step, i), both(allowed, i)
        gate = lambda bit, length: jnp.where((moves & bit) != 0, length * cost, UNREACHABLE)  # noqa: E731
        best = lesser(both(value, i), one[:, 2:-2] + gate(ahead, 1.0))
        best = lesser(best, lesser(one[:, 1:-3], one[:, 3:-1]) + gate(16, 2**0.5))
        jump = lesser(lesser(one[:, :-4], one[:, 4:]), lesser(two[:, 1:-3], two[:, 3:-1]))
        return jax.lax.dynamic_update_slice(rows, lesser(best, jump + gate(32, 5**0.5))[None], (i + 2, 0, 2))

    # both ways at once, the second from the last row on
    rows = jnp.full((h + 2, 2, w + 4), UNREACHABLE, jnp.float32)
    rows = jax.lax.fori_loop(0, h, settle, rows)
    return lesser(rows[2:, 0, 2:-2], rows[2:, 1, 2:-2][::-1])


@partial(jax.jit, static_argnames=("max_iterations",))
def cost_to_go(
    cell_cost: Float[Array, "H W"],
    initial: Float[Array, "H W"],
    *,
    resolution: Scalar,
    east: Bool[Array, "H W"] | None = None,
    north: Bool[Array, "H W"] | None = None,
    max_iterations: int = 2000,
) -> Float[Array, "H W"]:
    """Least cost from every cell to the goal cells; `UNREACHABLE` where there is no way.

    Moves: straight ones through open sides; diagonal ones from cells whose 8 neighbours, knight moves from cells whose
    24 neighbours can all be entered through open sides. So nothing is squeezed through a corner or jumped over.

    Args:
        cell_cost: Cost per metre of leaving each cell, >= 0 (1 = plain distance), `UNREACHABLE` where one cannot be.
        initial: Value of the goal cells (0, or what lies beyond them) [m], `UNREACHABLE` elsewhere.
        resolution: Edge of a cell [m].
        east: Whether one can pass between (i, j) and (i, j + 1); None = wherever both cells can be entered.
        north: Whether one can pass between (i, j) and (i + 1, j); None = likewise.
        max_iterations: Bound on the rounds; the iteration stops by itself when nothing changes.
    """
    cell_cost, value, east, north = once((cell_cost, jnp.minimum(initial, UNREACHABLE), east, north))
    costs = _step_costs(cell_cost, resolution, east, north)
    costs = once([*costs[:4], costs[4], costs[8]])
    step, allowed = once((jnp.minimum(cell_cost * resolution, UNREACHABLE), _allowed(costs)))
    step_t, allowed_t = once((step.T, allowed.T))

    def sweep(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        before, _, count = carry
        after = _sweep(before, step, allowed, (8, 4))
        after = _sweep(after.T, step_t, allowed_t, (2, 1)).T
        return after, jnp.any(after < before), count + 1

    def unfinished(carry: tuple[Array, Array, Array]) -> Array:
        return carry[1] & (carry[2] < max_iterations)

    begin = (value, jnp.asarray(True), jnp.asarray(0, jnp.int32))
    return jnp.minimum(jax.lax.while_loop(unfinished, sweep, begin)[0], UNREACHABLE)


@partial(jax.jit, static_argnames=("num_steps",))
def descend(
    value: Float[Array, "H W"],
    start: Int[Array, "2"],
    cell_cost: Float[Array, "H W"],
    *,
    resolution: Scalar,
    num_steps: int,
    east: Bool[Array, "H W"] | None = None,
    north: Bool[Array, "H W"] | None = None,
) -> tuple[Int[Array, "T 2"], Bool[Array, " T"]]:
    """The shortest path down a cost-to-go: cells visited, and which of them still move.

    Args:
        value: Result of `cost_to_go`.
        start: (row, column) of the first cell.
        cell_cost: As given to `cost_to_go`, > 0.
        resolution: As given to `cost_to_go`.
        num_steps: T, number of moves; once at a minimum the path stays there.
        east: As given to `cost_to_go`.
        north: As given to `cost_to_go`.

    Returns:
        Cells (row, column) after each move, and whether that move went downhill.
    """
    h, w = value.shape
    moves = jnp.asarray(_STRAIGHT + _DIAGONAL + _KNIGHT, jnp.int32)
    costs = jnp.stack(_step_costs(cell_cost, resolution, east, north))

    def move(cell: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        nearby = cell[None, :] + moves
        held = jnp.clip(nearby, 0, jnp.asarray([h - 1, w - 1], jnp.int32)[None, :])
        here, there = value[cell[0], cell[1]], value[held[:, 0], held[:, 1]]
        ahead = jnp.where(jnp.all(held == nearby, axis=-1), there + costs[:, cell[0], cell[1]], UNREACHABLE)
        best = jnp.argmin(ahead)
        # at a goal every move costs more than the value there; elsewhere the best one costs just as much
        downhill = (ahead[best] <= here * (1 + 1e-6)) & (there[best] < here)
        cell = jnp.where(downhill, held[best], cell)
        return cell, (cell, downhill)

    return jax.lax.scan(move, start, None, length=num_steps)[1]
