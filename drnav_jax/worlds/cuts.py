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
    ties = rng.integers(0, 2**64, 16 * int(np.sqrt(squares.max(initial=0))) + 16, np.uint64)
    for value in np.unique(squares)[::-1]:
        group = np.flatnonzero(squares == value)
        rim = _rim(int(value), shape)
        ring = gates[group, None] + rim.ring
        is_free = tree.part[ring] > 0
        begins = is_free & ~np.roll(is_free, 1, axis=1)
        num_arcs = begins.sum(axis=1)
        kept = (num_arcs > 1) | small[ring].any(axis=1)
        group, ring, is_free, num_arcs = group[kept], ring[kept], is_free[kept], num_arcs[kept]
        arcs = (np.cumsum(begins[kept], axis=1) - 1) % np.maximum(num_arcs, 1)[:, None]
        arcs += np.append(0, np.cumsum(num_arcs))[:-1, None]  # numbered through
        linked = is_free[:, rim.at] & (tree.part[gates[group, None] + rim.inner] > 0)
        which, edge = np.nonzero(linked)
        if not len(which):
            continue
        arc = arcs[which, rim.at[edge]]
        order = np.argsort(arc, kind="stable")
        which, edge, arc = which[order], edge[order], arc[order]
        gate = gates[group[which]]
        inner, outer = gate + rim.inner[edge], ring[which, rim.at[edge]]
        down = tree.parent[outer] == inner
        cut = down | (tree.parent[inner] == outer)
        top = np.where(down, outer, inner)[cut]
        lo, hi, sign = tree.lo[top], tree.hi[top], np.where(down, 1, -1)[cut]
        word = tree.word[gate + rim.edge[edge]]
        word[cut] ^= tree.leaving[hi] ^ tree.leaving[lo] ^ _tied(tree, which, inner, cut, lo, hi, ties[edge])
        first = np.flatnonzero(np.diff(arc, prepend=-1))  # edge of each arc that has some
        words = np.bitwise_xor.reduceat(word, first).tolist()
        at = np.append(0, np.cumsum(cut))[np.append(first, len(arc))].tolist()  # its edges in the tree
        area = np.append(0, np.cumsum(sign * (tree.area[hi] - tree.area[lo]))).tolist()
        bounds = [*np.flatnonzero(np.diff(which[first], prepend=-1)).tolist(), len(first)]
        for a, b in zip(bounds[:-1], bounds[1:], strict=True):
            k, part = group[which[first[a]]], tree.part[outer[first[a:b]]].tolist()
            for found in _relations(words[a:b]):
                here = sum(area[at[a + q + 1]] - area[at[a + q]] for q in found)
                mine = np.concatenate([np.arange(at[a + q], at[a + q + 1]) for q in found])
                yield k, part[found[0]], here, lo[mine], hi[mine], sign[mine]


def _tied(tree, which, inner, cut, lo, hi, ties):
    """What ties add to the words that leave the subtrees cut, by edge across the rim of one disc or another.

    In each part a disc is one node, also where its cells touch only outside of it: a tie, an extra
    edge, joins each to the first one, and no piece may cross it either.
    """
    nodes, hub, node = np.unique(which * (tree.part.max() + 1) + tree.part[inner], return_index=True, return_inverse=True)
    order = np.argsort(node, kind="stable")
    ends = ties.copy()  # of the ties at each cell; the hub has all of them
    ends[hub] ^= np.bitwise_xor.reduceat(ties[order], np.searchsorted(node[order], np.arange(len(nodes))))
    place = which * len(tree.leaving) + tree.lo[inner]
    order = np.argsort(place)
    place, passed = place[order], np.append(np.uint64(0), np.bitwise_xor.accumulate(ends[order]))
    base = which[cut] * len(tree.leaving)
    return passed[np.searchsorted(place, base + hi)] ^ passed[np.searchsorted(place, base + lo)]


def _relations(words: list[int]) -> list[list[int]]:
    """The disjoint least sets of numbers of words whose XOR is 0, by elimination over GF(2)."""
    basis: dict[int, tuple[int, set[int]]] = {}  # by leading bit: a word, and the numbers that make it
    found = []
    for number, word in enumerate(words):
        numbers = {number}
        while word and word.bit_length() in basis:
            other, used = basis[word.bit_length()]
            word, numbers = word ^ other, numbers ^ used
        if word:
            basis[word.bit_length()] = (word, numbers)
        else:
            found.append(list(numbers))
    return found


def spans(lo, hi, sign):
    """What a signed sum of nested intervals leaves, as slices."""
    if len(lo) == 1:
        return [slice(int(lo[0]), int(hi[0]))]
    at = np.append(lo, hi)
    order = np.argsort(at)
    at, depth = at[order], np.cumsum(np.append(sign, -sign)[order])
    kept = np.flatnonzero((depth[:-1] > 0) & (at[1:] > at[:-1]))
    return [slice(a, b) for a, b in zip(at[kept].tolist(), at[kept + 1].tolist(), strict=True)]
