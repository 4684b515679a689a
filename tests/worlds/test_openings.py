"""Path labels against Dijkstra's ways, and what a person would say of plain places."""

import heapq
import math

import numpy as np
import pytest

from drnav_jax import worlds
from drnav_jax.worlds.openings import OpeningSpec, openings
from drnav_jax.worlds.truth import TruthSpec, truth

OCTAGON = 0.04  # relative error of lengths, by the shape of what is reached in the open
WEST = math.pi


def scene_of(occupied, resolution=0.1, origin=(-3.0, 1.5), **fields):
    world = worlds.from_grid(occupied, origin, resolution)
    return worlds.Scene("plan", world, occupied, origin, resolution, **fields)


def plan(*walls, size=(12.0, 20.0), holes=(), **fields):
    """A scene with walls (x0, y0, x1, y1) [m]; its corner is the world's origin."""
    grid = np.zeros([round(s / 0.1) for s in size], bool)
    for boxes, value in ((walls, True), (holes, False)):
        for box in boxes:
            x0, y0, x1, y1 = (round(v / 0.1) for v in box)
            grid[y0:y1, x0:x1] = value
    return scene_of(grid, origin=(0.0, 0.0), **fields)


def at(scene, *poses, spec=OpeningSpec()):  # noqa: B008
    """Open ways of poses as letters: "FLR", "-L-"; and the whole answer."""
    found = openings(truth(scene), np.array(poses, float), spec)
    return ["".join(c if o else "-" for c, o in zip("FLR", row, strict=True)) for row in found.open], found


TUBE = ((4, 4, 16, 4.2), (4, 6, 16, 6.2))  # along x, 1.8 m wide
END = (15.8, 4, 16, 6.2)


def test_corridor():
    ways, found = at(plan(*TUBE), (10, 5.1, 0), (10, 5.1, WEST), (10, 5.1, math.pi / 2), (18, 5.1, 0.3))
    assert ways == ["F--", "F--", "-LR", "FLR"]
    assert found.stable[[0, 1, 3]].all() and not found.dead_end.any()


def test_dead_end_is_one_from_inside_looking_in():
    """Nine metres deep: facing the end nothing is open; facing the mouth the way out is, though it is long."""
    ways, found = at(plan(*TUBE, END), (14, 5.1, 0), (14, 5.1, WEST), (6, 5.1, 0), (2, 7, 0), (14, 5.1, math.pi / 2))
    assert ways == ["---", "F--", "---", "FLR", "-L-"]
    assert found.dead_end.tolist() == [True, False, True, False, False] and found.dead_end_stable[:4].all()


def test_other_side_of_a_room_is_no_way_out():
    """In the middle of a room of 6 m x 6 m with its door to the west, only the door is a way."""
    walls = ((6, 3, 12.4, 3.2), (6, 9.2, 12.4, 9.4), (12.2, 3, 12.4, 9.4), (6, 3, 6.2, 5.6), (6, 6.8, 6.2, 9.4))
    ways, _ = at(plan(*walls), (9.5, 6.2, 0), (9.5, 6.2, WEST), (9.5, 6.2, -math.pi / 2))
    assert ways == ["---", "F--", "--R"]


def test_side_branch():
    """Corner ahead to the left: the way lies to the left, wherever it leads."""
    walls = ((2, 4, 11, 4.2), (2, 6, 9.2, 6.2), (10.8, 4, 11, 11), (9, 6, 9.2, 11))
    scene = plan(*walls)
    ways, _ = at(scene, (9.5, 5.1, 0), (5, 5.1, 0))
    assert ways == ["-L-", "F--"]
    blocked = plan(*walls, (9, 10.8, 11, 11))
    assert at(blocked, (9.5, 5.1, 0))[0] == ["---"]


def test_travel_and_distance_have_limits():
    """A wall ahead that is 4 m wide is gotten around, one that is 20 m wide is not."""
    small, wide = plan((6, 4, 6.2, 8), size=(12.0, 20.0)), plan((6, 0, 6.2, 12), outside_is_free=False)
    pose = (5.0, 6.0, 0.0)
    assert at(small, pose)[0] == ["FLR"] and at(wide, pose)[0] == ["-LR"]
    assert at(small, pose, spec=OpeningSpec(travel=2.6))[0] == ["-LR"]


def test_beyond_the_grid():
    scene = plan(*TUBE, size=(12.0, 17.0))
    assert at(scene, (16.5, 5.1, 0), (40.0, 40.0, 0))[0] == ["FLR", "FLR"]
    closed = plan((0, 0, 17, 0.2), size=(12.0, 17.0), outside_is_free=False)
    assert at(closed, (16.5, 5.1, 0))[0] == ["-LR"]


def test_touching_a_wall_and_in_it():
    """A robot that touches a wall counts as just off it; one inside of an obstacle knows nothing."""
    ways, found = at(plan(*TUBE), (10, 4.4, 0), (10, 4.1, 0), (10, 3.2, 0))
    assert ways[0] == "F--"
    block = plan((4, 2, 16, 8))
    inside, found = at(block, (10, 5, 0))
    assert inside == ["---"] and not found.stable.any() and not found.dead_end_stable.any()


def random_truth(rng):
    grid = np.zeros(rng.integers(25, 34, 2), bool)
    for _ in range(rng.integers(3, 9)):
        i, j = rng.integers(0, grid.shape)
        long = rng.integers(4, 20)
        size = (long, 1) if rng.random() < 0.5 else (1, long)
        grid[i : i + size[0], j : j + size[1]] = True
    grid[rng.integers(25) :, :2] = grid[:2, rng.integers(25) :] = grid[:, -2:] = True
    scene = scene_of(grid, outside_is_free=bool(rng.random() < 0.5))
    return truth(scene, TruthSpec(radius=0.15, mouth=2.0))


SMALL = OpeningSpec(straight=0.6, travel=1.2)


def dijkstra(free, start, limit):
    """Length [cells] of the 8-connected way to each cell, around corners only beside a free cell."""
    way = {start: 0.0}
    queue = [(0.0, start)]
    while queue:
        length, (i, j) = heapq.heappop(queue)
        if length > way[i, j]:
            continue
        for di, dj in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            near, longer = (i + di, j + dj), length + math.hypot(di, dj)
            if longer > limit or not free(near) or not (free((i, near[1])) or free((near[0], j))):
                continue
            if longer < way.get(near, math.inf):
                way[near] = longer
                heapq.heappush(queue, (longer, near))
    return way


def in_steps(free, start, num_steps):
    """Cells reached when every sqrt(2) + 1st step may be diagonal, as sets."""
    reached = {start}
    for k in range(num_steps):
        corner = math.floor((k + 1) * (math.sqrt(2) - 1)) > math.floor(k * (math.sqrt(2) - 1))
        grown = set(reached)
        for i, j in reached:
            beside = [(i, j + 1), (i + 1, j), (i, j - 1), (i - 1, j)]
            grown |= {c for c in beside if free(c)}
            if corner:
                for di in (-1, 1):
                    for dj in (-1, 1):
                        if free((i + di, j + dj)) and (free((i, j + dj)) or free((i + di, j))):
                            grown.add((i + di, j + dj))
        reached = grown
    return reached


def by_hand(made, place, yaw, cells, spec):
    """Eq. 1 and 2, cell by cell; None where the place is not in F."""
    h, w = made.label.shape
    inside = lambda c: 0 <= c[0] < h and 0 <= c[1] < w  # noqa: E731
    stands = lambda c: made.standable[c] if inside(c) else made.outside_is_free  # noqa: E731
    start = tuple(int(math.floor((place[k] - made.origin[k]) / made.resolution)) for k in (1, 0))
    if not stands(start):
        return None

    def free(c):
        x = (c[1] + 0.5) * made.resolution + made.origin[0] - place[0]
        y = (c[0] + 0.5) * made.resolution + made.origin[1] - place[1]
        return c == start or (abs(math.remainder(math.atan2(y, x) - yaw, 2 * math.pi)) <= 3 * math.pi / 4 and stands(c))

    depth = lambda c: float(made.depth[c]) if inside(c) else 0.0  # noqa: E731
    found = [False] * 3
    for c in cells(free, start):
        x = (c[1] + 0.5) * made.resolution + made.origin[0] - place[0]
        y = (c[0] + 0.5) * made.resolution + made.origin[1] - place[1]
        away = math.hypot(x, y)
        good = not (inside(c) and made.label[c]) or depth(c) <= depth(start) - away / math.sqrt(2)
        if away < spec.straight or not good:
            continue
        for k, sector in enumerate((0, math.pi / 2, -math.pi / 2)):
            off = math.atan2(y, x) - yaw - sector
            if abs(math.remainder(off, 2 * math.pi)) <= math.pi / 4:
                found[k] = True
    return found


def poses_in(made, rng, num):
    cells = np.argwhere(made.standable)
    cells = cells[rng.integers(len(cells), size=num)][:, ::-1]
    xy = (cells + rng.uniform(0.1, 0.9, (num, 2))) * made.resolution + made.origin
    return np.concatenate([xy, rng.uniform(-4, 4, (num, 1))], axis=1)


@pytest.mark.parametrize("seeds", [range(5), pytest.param(range(5, 30), marks=pytest.mark.slow)])
def test_equals_brute_force(seeds):
    """Open ways and stability of both labels: 15 poses near each, step by step in sets."""
    steps = round(0.96 * SMALL.travel / 0.1)
    seen = np.zeros((3, 2), int)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        made = random_truth(rng)
        poses = poses_in(made, rng, 6)
        got = openings(made, poses, SMALL)
        for k, (x, y, yaw) in enumerate(poses):
            near = []
            for ahead, left in ((0, 0), (0.1, 0), (-0.1, 0), (0, 0.1), (0, -0.1)):
                place = (
                    x + ahead * math.cos(yaw) - left * math.sin(yaw),
                    y + ahead * math.sin(yaw) + left * math.cos(yaw),
                )
                cells = lambda free, start: in_steps(free, start, steps)  # noqa: E731
                near += [by_hand(made, place, yaw + turn, cells, SMALL) for turn in (0.0, SMALL.turn, -SMALL.turn)]
            nominal = near[0]
            near = [n for n in near if n is not None]
            assert got.open[k].tolist() == nominal
            assert got.stable[k].tolist() == [all(n[s] == nominal[s] for n in near) for s in range(3)]
            assert got.dead_end[k] == (not any(nominal))
            assert got.dead_end_stable[k] == all(any(n) == any(nominal) for n in near)
            seen += [[x, not x] for x in (got.open[k, 0], got.stable[k, 0], got.dead_end[k])]
    assert (seen > 1).all(), "each answer occurs"


@pytest.mark.parametrize("seeds", [range(30, 38), pytest.param(range(38, 60), marks=pytest.mark.slow)])
def test_lengths_are_right_within_the_octagon(seeds):
    """What Dijkstra reaches in clearly less is OPEN, what is OPEN Dijkstra reaches in hardly more."""
    steps = SMALL.travel / 0.1
    shorter = lambda free, start: dijkstra(free, start, steps * (1 - OCTAGON) - 1)  # noqa: E731
    # of 8 directions lengths are up to 8 % too long
    longer = lambda free, start: dijkstra(free, start, steps * (1 + OCTAGON) * 1.083 + 1)  # noqa: E731
    for seed in seeds:
        rng = np.random.default_rng(seed)
        made = random_truth(rng)
        poses = poses_in(made, rng, 10)
        got = openings(made, poses, SMALL).open
        for is_open, (x, y, yaw) in zip(got, poses, strict=True):
            least, most = (by_hand(made, (x, y), yaw, cells, SMALL) for cells in (shorter, longer))
            for a, b, c in zip(least, is_open, most, strict=True):
                assert a <= b <= c


def test_batches_do_not_mix():
    """Each robot's answer is the one it gets alone."""
    rng = np.random.default_rng(0)
    made = truth(worlds.sample("t", 1, "train"))
    poses = poses_in(made, rng, 30)
    together = openings(made, poses)
    for k in (0, 11, 12, 29):
        alone = openings(made, poses[k : k + 1])
        for a, b in zip(alone, together, strict=True):
            np.testing.assert_array_equal(a[0], b[k])
    assert [len(f) for f in openings(made, poses[:0])] == [0] * 4


def test_turning_the_world_turns_nothing():
    """A quarter turn and a mirror of world and robot change no label, but left and right."""
    rng = np.random.default_rng(3)
    scene = worlds.sample("l", 2, "train")
    flat = scene_of(scene.occupied, origin=(0.0, 0.0))
    poses = poses_in(truth(flat), rng, 60)
    height = scene.occupied.shape[0] * 0.1
    mirrored = scene_of(np.ascontiguousarray(scene.occupied[::-1]), origin=(0.0, 0.0))
    turned = scene_of(np.ascontiguousarray(np.rot90(scene.occupied)), origin=(0.0, 0.0))
    straight = openings(truth(flat), poses).open
    x, y, yaw = poses.T
    over = openings(truth(mirrored), np.stack([x, height - y, -yaw], axis=1)).open
    width = scene.occupied.shape[1] * 0.1
    around = openings(truth(turned), np.stack([y, width - x, yaw - math.pi / 2], axis=1)).open
    assert np.mean(over == straight[:, [0, 2, 1]]) >= 0.99 and np.mean(around == straight) >= 0.99


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"straight": 0.0}, "straight"),
        ({"straight": 6.0}, "straight <= travel"),
        ({"travel": math.inf}, "travel"),
        ({"shift": -0.1}, "shift must be >= 0 m"),
        ({"turn": 1.0}, "turn"),
        ({"turn": math.nan}, "turn"),
    ],
)
def test_spec_refuses(changes, rule):
    with pytest.raises(ValueError, match=rule):
        OpeningSpec(**changes)
