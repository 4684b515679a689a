"""Which pieces a gate disc cuts off the free space F, without growing any (for `labels`).

Every cell of M is tried, but no component is grown. Each edge between neighbours in F gets a random
64-bit word. A spanning tree of F, rooted outside, numbers the cells such that a subtree is an
interval [lo, hi); the XOR of the words of all edges that leave it is X[hi] ^ X[lo] for one prefix
array X, and its area S[hi] - S[lo]. Around D runs a ring of cells, which obstacles cut into arcs; what
an arc hides is a signed sum of the subtrees whose tree edge crosses the rim of D there. What a set of
arcs hides is cut off iff no edge leaves it but those into D, that is, but for odds of 2**-64, iff

    (1)  XOR over the arcs of (words leaving the subtrees cut there ^ words of edges into D) = 0.

A gate thus costs a walk around its rim, and elimination over GF(2) tells which arcs belong together.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Int, UInt64
from scipy import ndimage
from scipy.sparse import csgraph, csr_array

_BOX = ndimage.generate_binary_structure(2, 2)
_STRAIGHT = ((0, 1), (1, 0), (0, -1), (-1, 0))


class Tree(NamedTuple):
    """Spanning tree of F below one root outside, by flat cell or by position in preorder."""

    part: Int[np.ndarray, " C"]  # which connected part of F, 0 = not in F
    parent: Int[np.ndarray, " C"]  # flat cell, -1 below the root
    lo: Int[np.ndarray, " C"]  # position of the cell
    hi: Int[np.ndarray, " C"]  # end of the positions of its subtree
    cell: Int[np.ndarray, " N"]  # flat cell at a position; 0, which is not in F, for the root
    word: UInt64[np.ndarray, " 2C"]  # of the edges to the next column, then of those to the next row
    leaving: UInt64[np.ndarray, " M"]  # X, M = N + 1
    area: Int[np.ndarray, " M"]  # S


def grow(part, width, roots, counted, rng):
    """Spanning tree of F, breadth first from all roots (flat cells) at once."""
    free = part > 0
    cells = np.flatnonzero(free)
    node = np.cumsum(free) - 1  # the root is node N - 1
    near = cells[:, None] + np.array([1, width, -1, -width])
    linked = free[near]
    ends = np.concatenate([[0], np.cumsum(linked.sum(axis=1)), [linked.sum() + len(roots)]])
    links = node[np.concatenate([near[linked], roots])].astype(np.int32)
    graph = csr_array((np.ones(len(links)), links, ends), shape=(len(cells) + 1, len(cells) + 1))
    order, above = csgraph.breadth_first_order(graph, len(cells))
    count = len(order)
    rank = np.empty(count, int)
    rank[order] = np.arange(count)
    above = np.append(-1, rank[above[order[1:]]])  # never falls: siblings are neighbours in order
    child = np.searchsorted(above, np.arange(count + 1))  # each one's first
    levels = [0, 1]
    while levels[-1] < count:
        levels.append(int(child[levels[-1]]))
    size = np.ones(count, int)
    for a, b, c in reversed(list(zip(levels, levels[1:], levels[2:], strict=False))):
        below = np.append(0, np.cumsum(size[b:c]))
        size[a:b] += below[child[a + 1 : b + 1] - b] - below[child[a:b] - b]
    below = np.append(0, np.cumsum(size))
    lo = 1 + below[:-1] - below[child[above]]  # behind the parent by this: itself, elder siblings
    lo[0] = 0
    for b, c in zip(levels[1:], levels[2:], strict=False):
        lo[b:c] += lo[above[b:c]]
    flat = np.append(cells, 0)[order]
    cell = np.empty(count, int)
    cell[lo] = flat
    at = np.full((3, len(part)), -1)
    at[:, flat[1:]] = np.where(above > 0, flat[above], -1)[1:], lo[1:], (lo + size)[1:]
    word = rng.integers(0, 2**64, (2, len(part)), np.uint64)
    for plane, step in enumerate((1, width)):
        word[plane, ~(free & np.roll(free, -step))] = 0
    touching = word[0] ^ np.roll(word[0], 1) ^ word[1] ^ np.roll(word[1], width)
    leaving = np.append(np.uint64(0), np.bitwise_xor.accumulate(touching[cell]))
    area = np.append(0, np.cumsum(counted[cell]))
    return Tree(part, *at, cell=cell, word=word.ravel(), leaving=leaving, area=area)


class _Rim(NamedTuple):
    """Offsets, in a flat grid, around a gate disc."""

    ring: Int[np.ndarray, " B"]  # closed curve of cells just outside, each 4-adjacent to the next
    at: Int[np.ndarray, " E"]  # edges across the rim: index in the ring of the cell outside,
    inner: Int[np.ndarray, " E"]  # .. the cell inside,
    edge: Int[np.ndarray, " E"]  # .. and the edge's own index


@functools.lru_cache(maxsize=4096)
def _rim(squares: int, shape: tuple[int, int]) -> _Rim:
    """The rim of the disc y^2 + x^2 <= squares."""
    k = int(np.sqrt(squares)) + 2
    y, x = np.mgrid[-k : k + 1, -k : k + 1]
    flat = y * shape[1] + x
    disc = y**2 + x**2 <= squares
    ring = ndimage.binary_dilation(disc, _BOX) & ~disc
    cells = np.argwhere(ring)[np.argsort(np.arctan2(y[ring], x[ring]))]
    edges = []
    for step in _STRAIGHT:
        (at,) = np.nonzero(disc[tuple((cells + step).T)])
        outer, inner = flat[tuple(cells[at].T)], flat[tuple((cells[at] + step).T)]
        plane = abs(step[0]) * shape[0] * shape[1]
        edges.append((at, inner, plane + np.minimum(inner, outer)))
    return _Rim(flat[tuple(cells.T)], *np.concatenate(edges, axis=1))


def pieces(tree, shape, small, gates, squares, rng):
    """Yields (gate, part, area, lo, hi, sign) of each piece of F at each gate's disc.

    The signed intervals of positions add up to the piece; where it holds its part's root, to minus
    what it does not hold, so that the area is <= 0.
    """
    gates = gates @ (shape[1], 1)
    ties = rng.integers(0, 2**64, 8 * int(np.sqrt(squares.max(initial=0))) + 8, np.uint64)
    for value in np.unique(squares)[::-1]:
        group = np.flatnonzero(squares == value)
        rim = _rim(int(value), shape)
        ring = gates[group, None] + rim.ring
        is_free = tree.part[ring] > 0
        begins = is_free & ~np.roll(is_free, 1, axis=1)
        num_arcs = begins.sum(axis=1)
        arcs = (np.cumsum(begins, axis=1) - 1) % np.maximum(num_arcs, 1)[:, None]
        for k in np.flatnonzero((num_arcs > 1) | small[ring].any(axis=1)):
            gate = gates[group[k]]
            linked = is_free[k, rim.at] & (tree.part[gate + rim.inner] > 0)
            inner, outer = gate + rim.inner[linked], ring[k, rim.at[linked]]
            if not len(inner):
                continue
            arc = arcs[k, rim.at[linked]]
            down = tree.parent[outer] == inner
            cut = down | (tree.parent[inner] == outer)
            top = np.where(down, outer, inner)[cut]
            lo, hi, sign, behind = tree.lo[top], tree.hi[top], np.where(down, 1, -1)[cut], arc[cut]
            area = sign * (tree.area[hi] - tree.area[lo])
            word = tree.word[gate + rim.edge[linked]]
            word[cut] ^= tree.leaving[hi] ^ tree.leaving[lo]
            # In each part the disc is one node, also where its cells touch only outside of it: a
            # tie, an extra edge, joins each to the first one, and no piece may cross it either.
            at = tree.lo[inner][:, None]
            below = (lo <= at) & (at < hi)
            hub = (tree.part[inner][:, None] == tree.part[inner]).argmax(axis=1)
            words = {}
            for q in np.unique(arc).tolist():
                odd = np.count_nonzero(below[:, behind == q], axis=1) % 2
                crossed = ties[: len(odd)][odd != odd[hub]]
                words[q] = int(np.bitwise_xor.reduce(np.append(word[arc == q], crossed)))
            for arcs_of_piece in _relations(words):
                mine = np.zeros(len(is_free[k]), bool)
                mine[arcs_of_piece] = True
                some = outer[mine[arc]][0]
                mine = mine[behind]
                yield group[k], tree.part[some], area[mine].sum(), lo[mine], hi[mine], sign[mine]


def _relations(words: dict[int, int]) -> list[list[int]]:
    """The disjoint least sets of keys whose words XOR to 0, by elimination over GF(2)."""
    basis: dict[int, tuple[int, set[int]]] = {}  # by leading bit: a word, and the keys that make it
    found = []
    for key, word in words.items():
        keys = {key}
        while word and word.bit_length() in basis:
            other, used = basis[word.bit_length()]
            word, keys = word ^ other, keys ^ used
        if word:
            basis[word.bit_length()] = (word, keys)
        else:
            found.append(list(keys))
    return found


def spans(lo, hi, sign):
    """What a signed sum of nested intervals leaves, as slices."""
    at = np.append(lo, hi)
    order = np.argsort(at)
    at, depth = at[order], np.cumsum(np.append(sign, -sign)[order])
    kept = np.flatnonzero((depth[:-1] > 0) & (at[1:] > at[:-1]))
    return [slice(a, b) for a, b in zip(at[kept].tolist(), at[kept + 1].tolist(), strict=True)]
