import numpy as np
import pytest
from scipy.sparse import coo_array, csgraph

from drnav_jax.worlds import networks


def graph(edges, count, weight=None):
    a, b = np.array(sorted(edges)).reshape(-1, 2).T
    data = np.ones(len(a)) if weight is None else np.array([weight[e] for e in sorted(edges)])
    return coo_array((np.tile(data, 2), (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(count, count)).tocsr()


def drawn(seed, columns=5, rows=4, share=0.1):
    rng = np.random.default_rng(seed)
    edges = networks.grid_edges(columns, rows)
    length = {e: rng.uniform(1, 3) for e in edges}
    tree = networks.grow(edges, int(rng.integers(columns * rows)), rng.uniform(), rng)
    return edges, length, tree, networks.braid(edges, tree, share, rng), columns * rows


def test_a_grid_has_its_edges():
    edges = networks.grid_edges(3, 2)
    assert sorted(edges) == [(0, 1), (0, 3), (1, 2), (1, 4), (2, 5), (3, 4), (4, 5)]


@pytest.mark.parametrize("seed", range(6))
def test_a_tree_spans_and_has_no_loop(seed):
    edges, _, tree, ways, count = drawn(seed)
    assert len(tree) == count - 1 and tree <= set(edges) and tree <= ways <= set(edges)
    assert csgraph.connected_components(graph(tree, count))[0] == 1


def test_winding_trees_have_fewer_ends():
    def ends(winding):
        total = 0
        for seed in range(20):
            tree = networks.grow(networks.grid_edges(6, 6), 0, winding, np.random.default_rng(seed))
            total += (np.bincount(np.array(sorted(tree)).ravel()) == 1).sum()
        return total

    assert ends(1.0) < 0.6 * ends(0.0)


@pytest.mark.parametrize("seed", range(6))
def test_routes_and_shortcuts_agree_with_scipy(seed):
    edges, length, _, ways, count = drawn(seed)

    def between(some):
        return csgraph.dijkstra(graph(some, count, length), indices=0)[count - 1]

    found = networks.route(ways, length, 0, count - 1)
    np.testing.assert_allclose(found.length, between(ways))
    steps = [networks.edge(a, b) for a, b in zip(found.nodes[:-1], found.nodes[1:], strict=True)]
    assert (found.nodes[0], found.nodes[-1]) == (0, count - 1) and set(steps) <= ways
    np.testing.assert_allclose(sum(length[e] for e in steps), found.length)

    shut = set(edges) - ways
    gains = {e: found.length - between(ways | {e}) for e in shut}
    short = networks.shortcuts(shut, ways, length, 0, count - 1, 0.5)
    assert set(short) == {e for e, gain in gains.items() if gain >= 0.5}
    assert [gains[e] for e in short] == sorted((gains[e] for e in short), reverse=True)


def test_no_way_is_infinitely_long():
    assert networks.route({(0, 1)}, {(0, 1): 1.0}, 0, 2) == (float("inf"), [])


@pytest.mark.parametrize("seed", range(6))
def test_side_branches_are_what_one_node_of_the_trip_leads_to(seed):
    _, length, _, ways, count = drawn(seed, share=0.08)
    trip = networks.route(ways, length, 0, count - 1).nodes
    found = networks.side_branches(ways, trip)
    # Oracle: parts of what is left without the trip, and all edges from each to the trip.
    left = {e for e in ways if not set(e) & set(trip)}
    part = csgraph.connected_components(graph(left, count))[1]
    expected: dict[int, set[int]] = {}
    for p in {part[n] for n in range(count) if n not in trip}:
        nodes = {n for n in range(count) if part[n] == p}
        doors = [e for e in ways if len(set(e) & nodes) == 1]
        if len(doors) == 1:
            (at,) = set(doors[0]) - nodes
            expected.setdefault(at, set()).update(nodes)
    assert found == expected
