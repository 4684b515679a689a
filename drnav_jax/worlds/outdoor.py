"""Layouts under the sky or a wide roof: a loading dock, parked cars, a trail through bushes, a field of clutter."""

import math

import numpy as np

from drnav_jax.worlds.clutter import to_polyline
from drnav_jax.worlds.solids import REAR, WAY, Draw, Layout, Point, Solid, block, box, fork, post, slab

PIT = -1.2  # [m] bottom of a drop
PAINT = 0.01  # [m] top of what is painted on the ground


def _stripe(x0: float, y0: float, x1: float, y1: float) -> Solid:
    return box((x0, y0, x1, y1), "stripe", 0.0, PAINT)


def _dock(draw: Draw, rng: np.random.Generator) -> Layout:
    """The way ahead is cut by a sunken bay with painted edges; or the paint is on level ground."""
    at, run, width, bay = (draw(name) for name in ("stem", "run", "width", "bay"))
    deck, end, behind, paint = (draw(name) for name in ("deck", "end", "behind", "paint"))
    h, near = width / 2, at + run
    low, high = -deck / 2, deck / 2
    edge = near + draw("apron")
    far = edge + bay + end
    aside = max(draw("aside"), deck / 2 + h + 0.5)
    ways = fork(at, near, aside, far, width)
    # A bay beside the stem that closes nothing.
    side, reach = rng.uniform(0.5, 1.5), rng.uniform(1.8, 2.6)
    niche = (side, h, side + min(rng.uniform(2, 3), at - h - side), h + reach)
    hull = (-REAR, -aside - h - rng.uniform(0.3, 2), far, max(high, niche[3]) + rng.uniform(0.3, 2))
    free = [*ways.free, (near, low, far, high), niche]
    x = rng.uniform(at + h + 0.5, far - paint - 0.5)
    start, goal = (0.0, rng.uniform(-0.2, 0.2)), (far + behind, rng.uniform(0.0, 1.0) * max(high, 1.0))
    return Layout(
        solids=[
            *block(hull, free, rng),
            _stripe(edge - paint, low, edge, high),
            _stripe(edge + bay, low, edge + bay + paint, high),
            _stripe(x, -aside - h, x + paint, -aside + h),
            _stripe(niche[0], h - paint, niche[2], h),
            box(niche, "drop", PIT, 0.0),
        ],
        plugs=[box((edge, low, edge + bay, high), "drop", PIT, 0.0)],
        doorposts=[],
        ways=[np.array([*ways.stem, [far, 0.0], goal]), np.array([*ways.detour, goal])],
        hull=hull,
        start=start,
        goal=goal,
        corridors=[(ways.stem[:1].repeat(2, 0) + [[0, 0], [REAR - 0.5, 0]], width), (ways.detour, width)],
        yards=[(far + 0.5, -aside, goal[0] + 1, max(high, 2.0))],
    )


def _car(x: float, y: float, yaw: float, size: tuple[float, float], number: int, rng: np.random.Generator) -> list[Solid]:
    """Body and cabin of a car; its nose looks along its yaw."""
    length, width = size
    waist, roof = rng.uniform(0.8, 0.95), rng.uniform(1.4, 1.6)
    cabin, back = rng.uniform(0.45, 0.6) * length, rng.uniform(0.05, 0.12) * length
    role, c, s = f"car:{number}", math.cos(yaw), math.sin(yaw)
    return [
        slab(x, y, yaw, length, width, role, 0.0, waist),
        slab(x - back * c, y - back * s, yaw, cabin, width - 0.12, role, waist, roof),
    ]


def _cars(draw: Draw, rng: np.random.Generator) -> Layout:
    """An aisle between parked cars ends at a row of cars; one of them may be missing."""
    at, run, width, gap, behind = (draw(name) for name in ("stem", "run", "width", "gap", "behind"))
    num, rows = int(draw("row")), int(draw("aisle"))
    h, number = width / 2, iter(range(1000))

    def size() -> tuple[float, float]:
        return rng.uniform(4.0, 4.6), rng.uniform(1.65, 1.8)

    def parked(x: float, y: float, yaw: float, one: tuple[float, float]) -> list[Solid]:
        return _car(x, y, yaw + rng.choice([0, math.pi]) + rng.uniform(-0.02, 0.02), one, next(number), rng)

    row = [size() for _ in range(num)]
    high = (sum(w for _, w in row) + (num + 1) * gap) / 2  # of the lot, which the row fills
    near = at + run
    x, sides = near + 0.3, []
    for _ in range(rows):
        for side in (-1, 1):
            one = size()
            if rng.random() < 0.8:
                sides += parked(x + one[0] / 2, side * (high - one[1] / 2 - 0.12), 0.0, one)
        x += 4.6 + rng.uniform(0.25, 0.4)
    back = x + rng.uniform(0.3, 0.9)  # where the row begins
    far = back + 4.6 + rng.uniform(0.2, 0.5)
    missing = int(rng.integers(1, num - 1))  # not one that the side rows hide
    y, front, plug = -high + gap, [], []
    for k, one in enumerate(row):
        # None is longer than the row is deep; turned along x they stand side by side.
        (plug if k == missing else front).extend(parked(back + 2.3, y + one[1] / 2, 0.0, one))
        if k == missing:
            middle = y + one[1] / 2
        y += one[1] + gap
    aside = max(draw("aside"), high + h + 2.3)
    ways = fork(at, near, aside, far, width)
    bay = (at + h + 1.0, -aside - h - 2.0, far - 0.5, -aside - h)  # beside the way round
    x = bay[0] + 0.3
    while x + 4.7 < bay[2]:
        one = size()
        if rng.random() < 0.6:
            sides += parked(x + one[0] / 2, bay[1] + one[1] / 2 + 0.15, 0.0, one)
        x += 4.6 + rng.uniform(0.25, 1.0)
    hull = (-REAR, bay[1] - rng.uniform(0.3, 1), far, high + rng.uniform(0.3, 2))
    start, goal = (0.0, rng.uniform(-0.2, 0.2)), (far + behind, rng.uniform(0.0, 1.0) * high)
    return Layout(
        solids=[*block(hull, [*ways.free, (near, -high, far, high), bay], rng), *sides, *front],
        plugs=plug,
        doorposts=[],
        ways=[np.array([*ways.stem, [back - 0.5, middle], [far, middle], goal]), np.array([*ways.detour, goal])],
        hull=hull,
        start=start,
        goal=goal,
        yards=[(far + 0.5, -aside, goal[0] + 1, high)],
        num_clutter=4,
    )


def _thicket(
    x: float, low: float, high: float, deep: float, top: float, role: str, rng: np.random.Generator
) -> list[Solid]:
    """Plants across a way: a hedge with bulges."""
    plants = [box((x, low, x + deep, high), role, 0.0, top * rng.uniform(0.75, 0.95))]
    for y in np.arange(low + 0.25, high, rng.uniform(0.5, 0.8)):
        radius = rng.uniform(0.3, 0.55)
        along = x + deep / 2 + rng.uniform(-0.4, 0.4)
        inside = min(max(float(y), low + radius), high - radius)
        plants.append(post(along, inside, radius, role, top * rng.uniform(0.7, 1.0)))
    return plants


def _trail(draw: Draw, rng: np.random.Generator) -> Layout:
    """A trail between hedges that plants cross: bushes, or tall grass that one may drive through."""
    at, run, width, end, behind = (draw(name) for name in ("stem", "run", "width", "end", "behind"))
    deep, top, h = draw("deep"), draw("top"), width / 2
    near = at + h + run  # where the plants begin
    far, aside = near + deep + end, draw("aside") + width
    shift = rng.uniform(-0.6, 0.6)  # the trail is not quite straight
    bend = rng.uniform(at + h + 0.5, max(near - 1.5, at + h + 0.6))
    ways = fork(at, bend + h, aside, far, width)
    low, high = shift - h, shift + h
    hull = (-REAR, -aside - h - rng.uniform(1.2, 2.5), far, max(h, high) + rng.uniform(1.2, 2.5))
    free = [*ways.free, (bend - h, low, far, high)]
    start, goal = (0.0, rng.uniform(-0.2, 0.2)), (far + behind, rng.uniform(-0.3, 1.0) * 2.0)
    inner = np.array([*ways.stem[:1], [bend, 0.0], [bend + 0.5, shift], [far, shift], goal])
    round_ = np.array([*ways.detour, goal])
    lines = [ways.stem, np.array([[bend, shift], [far, shift]]), ways.detour]

    plants: list[Solid] = []
    if rng.random() < 0.6:  # grass across the way round as well
        x = rng.uniform(at + h + 1.0, far - deep - 1.0)
        plants += _thicket(x, -aside - h, -aside + h, deep, top, "grass", rng)
    for line in lines:  # beside the trails: grass that reaches into them, bushes at the hedge
        for a, b in zip(line[:-1], line[1:], strict=True):
            length = math.dist(a, b)
            unit = (b - a) / length
            for s in np.arange(0.5, length, rng.uniform(1.2, 2.4)):
                side, bush, radius = rng.choice([-1, 1]), rng.random() < 0.6, rng.uniform(0.3, 0.6)
                into = rng.uniform(0.1, 0.4) if bush else rng.uniform(0.2, 0.8)
                centre = a + s * unit + side * (h + radius - into) * np.array([-unit[1], unit[0]])
                height = top * rng.uniform(0.6, 1.0) if bush else rng.uniform(0.25, 0.9) * top
                # half of WAY on either side of the middle of every trail
                room = min(to_polyline(centre[None], way)[0] for way in (inner, round_)) - radius
                if not bush or room >= WAY / 2:
                    x, y = centre
                    plants.append(post(x, y, radius, "bush" if bush else "grass", height))
    for _ in range(int(rng.integers(2, 6))):  # trees, and meadow beyond
        x, y = rng.uniform(far + 1, goal[0] + 2), rng.uniform(-aside, 4.0)
        if min(to_polyline(np.array([[x, y]]), way)[0] for way in (inner, round_)) < WAY:
            continue
        if rng.random() < 0.5:
            trunk, crown = rng.uniform(0.12, 0.25), rng.uniform(0.8, 1.5)
            plants += [post(x, y, trunk, "trunk", 2.6), post(x, y, crown, "bush", rng.uniform(3.5, 5.0), 2.2)]
        else:
            plants.append(slab(x, y, rng.uniform(0, 3), rng.uniform(1, 3), rng.uniform(1, 2), "grass", 0.0, 0.8 * top))
    state = rng.bit_generator.state  # the same plants twice
    closed = _thicket(near, low, high, deep, top, "bush", rng)
    rng.bit_generator.state = state
    opened = _thicket(near, low, high, deep, top, "grass", rng)
    return Layout(
        solids=[*block(hull, free, rng, role="hedge"), *plants],
        plugs=closed,
        doorposts=opened,
        ways=[inner, round_],
        hull=hull,
        start=start,
        goal=goal,
    )


def _chain(points: list[Point], door: tuple[int, float, float], role: str, rng: np.random.Generator):
    """Obstacles along a polyline with gaps that no robot passes.

    Args:
        points: The polyline [m].
        door: On which segment, from where to where along it [m], the open twin has nothing.
        role: Of all.
        rng: Consumed.

    Returns:
        The solids of both twins, and those in the door.
    """
    both: list[Solid] = []
    inside: list[Solid] = []
    for k, (a, b) in enumerate(zip(points[:-1], points[1:], strict=True)):
        length, yaw = math.dist(a, b), math.atan2(b[1] - a[1], b[0] - a[0])
        s = 0.0
        while s < length:
            half = min(rng.uniform(0.25, 0.5), max((length - s) / 2, 0.2))
            s += half
            x, y = a[0] + s * math.cos(yaw), a[1] + s * math.sin(yaw)
            height, is_box = rng.uniform(0.7, 1.8), rng.random() < 0.5
            tone = f"{role}:{int(rng.integers(6))}"
            if is_box:
                one = slab(x, y, yaw + rng.uniform(-0.12, 0.12), 2 * half, rng.uniform(0.4, 0.7), tone, 0.0, height)
            else:
                one = post(x, y, half, tone, height)
            in_door = k == door[0] and s + half > door[1] and s - half < door[2]
            (inside if in_door else both).append(one)
            s += half + rng.uniform(0.0, 0.25)
    return both, inside


def _field(draw: Draw, rng: np.random.Generator) -> Layout:
    """Clutter in the open that stands in pockets; the one on the way may have a hole in its back."""
    ahead, depth, width, behind = (draw(name) for name in ("ahead", "depth", "width", "behind"))
    depth = max(depth, 1.3 * width + 0.5)
    door = min(draw("door"), width - 0.6)
    back, shift = ahead + depth, rng.uniform(-0.25, 0.25) * width
    low, high, r = shift - width / 2 - 0.4, shift + width / 2 + 0.4, 0.4
    middle = rng.uniform(low + r + door / 2 + 0.3, high - r - door / 2 - 0.3)
    points = [(ahead, low), (back, low), (back, high), (ahead, high)]
    both, plug = _chain(points, (1, middle - door / 2 - low, middle + door / 2 - low), "heap", rng)
    edge = max(-low, high) + r + 1.2
    goal = (back + behind, rng.uniform(-1.0, 1.0))
    round_ = [np.array([[0, 0], [ahead - 0.5, s * edge], [back + 1, s * edge], goal]) for s in (-1, 1)]
    inner = np.array([[0, 0], [ahead, shift], [back - 1, middle], [back + 1, middle], goal])
    solids, wide = list(both), edge + 5.5
    for _ in range(int(draw("pockets"))):  # elsewhere, and always closed
        w, d, turn = rng.uniform(1.5, 2.6), rng.uniform(3.4, 4.4), rng.uniform(-math.pi, math.pi)
        x, y = rng.uniform(ahead, back + 2), rng.choice([-1, 1]) * rng.uniform(edge + 3.6, wide)
        c, s = math.cos(turn), math.sin(turn)
        outline = [(-d / 2, -w / 2 - r), (d / 2, -w / 2 - r), (d / 2, w / 2 + r), (-d / 2, w / 2 + r)]
        corners = [(x + c * p - s * q, y + s * p + c * q) for p, q in outline]
        near = [p for o in solids for p in [o.row[:2]] if math.dist(p, (x, y)) < 5.2]
        if not near:
            solids += _chain(corners, (-1, 0.0, 0.0), "heap", rng)[0]
    return Layout(
        solids=solids,
        plugs=plug,
        doorposts=[],
        ways=[*round_, inner],
        hull=(0.0, -wide - 2.5, back + behind, wide + 2.5),
        start=(0.0, 0.0),
        goal=goal,
        yards=[(1.5, -wide - 2, back + behind - 1.5, wide + 2)],
        num_clutter=int(draw("count")),
    )


LAYOUTS = {"dock": _dock, "cars": _cars, "trail": _trail, "field": _field}
