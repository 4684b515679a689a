"""Layouts that need walls only: an open field, a cul-de-sac, corridors, T-junctions, blind corners."""

import math

import numpy as np

from drnav_jax.worlds.solids import REAR, Draw, Layout, block, box, fork, wall

MOUTH = 4.9  # [m] the widest of a cul-de-sac; wider or shallower ones are bays, not dead ends


def _open(draw: Draw, rng: np.random.Generator) -> Layout:
    length = draw("length")
    yard = (1.5, -6.0, length - 1.5, 6.0)
    around = [[0, 0], [0, 7], [length, 7], [length, 0]]  # a way past everything
    return Layout(
        solids=[],
        plugs=[],
        doorposts=[],
        ways=[np.array(around)],
        yards=[yard],
        hull=yard,
        start=(0.0, 0.0),
        goal=(length, rng.uniform(-2, 2)),
        num_clutter=int(draw("count")),
    )


def _u(draw: Draw, rng: np.random.Generator) -> Layout:
    ahead, depth, width, behind = (draw(name) for name in ("ahead", "depth", "width", "behind"))
    depth = max(depth, 1.3 * width)
    behind = max(behind, 15.0 - ahead - depth)
    thickness = rng.uniform(0.2, 0.3)
    shift, goal_y = rng.uniform(-0.25, 0.25) * width, rng.uniform(-1.0, 1.0)
    back = ahead + depth
    low, high = shift - width / 2, shift + width / 2
    spread = [depth * math.tan(math.radians(draw("flare"))) for _ in range(2)]
    room = min(MOUTH, depth / 1.25) - width
    spread = [min(max(s, -0.2 * width), room / 2) for s in spread]
    door = draw("door")
    middle = shift + rng.uniform(-0.5, 0.5) * (width - door - 0.5)
    sides = [
        wall((ahead, low - spread[0]), (back, low), thickness),
        wall((ahead, high + spread[1]), (back, high), thickness),
    ]
    edge = max(-low + max(spread[0], 0), high + max(spread[1], 0)) + 1.2
    goal = (back + behind, goal_y)
    ways = [
        np.array([[0, 0], [ahead - 0.5, s * edge], [back + 1, s * edge], goal]) for s in (-1, 1)
    ]
    inner = np.array([[0, 0], [ahead, shift], [back - 1, middle], [back + 1, middle], goal])
    return Layout(
        solids=sides,
        plugs=[wall((back, low), (back, high), thickness, "end")],
        doorposts=[
            wall((back, low), (back, middle - door / 2 - thickness / 2), thickness, "end"),
            wall((back, middle + door / 2 + thickness / 2), (back, high), thickness, "end"),
        ],
        ways=[*ways, inner],
        yards=[(1.5, -edge - 2.5, back + behind - 1.5, edge + 2.5)],
        hull=(0.0, -edge - 1.0, back + behind, edge + 1.0),
        start=(0.0, 0.0),
        goal=goal,
    )


def _corridor(draw: Draw, rng: np.random.Generator) -> Layout:
    ahead, depth, end, behind = (draw(name) for name in ("ahead", "depth", "end", "behind"))
    width, through, aside = (draw(name) for name in ("width", "through", "aside"))
    # A wall at least as thick as a thin one stands between the two.
    aside = max(aside, (width + through) / 2 + 0.3)
    near, far, y = ahead, ahead + depth + end, -aside
    blocked = (near, -width / 2, far, width / 2)
    passage = (near, y - through / 2, far, y + through / 2)
    hull = (near, y - through / 2 - rng.uniform(0.5, 3), far, width / 2 + rng.uniform(0.5, 3))
    start, goal = (0.0, rng.uniform(-0.5, 0.5)), (far + behind, rng.uniform(-0.5, 1.0))
    straight = np.array([[near, 0.0], [far, 0.0]])
    around = np.array([[near, y], [far, y]])
    return Layout(
        solids=block(hull, [blocked, passage], rng, fence=near + REAR),
        plugs=[box((near + depth, -width / 2, far, width / 2), "end")],
        doorposts=[],
        ways=[np.array([start, *line, goal]) for line in (straight, around)],
        corridors=[(straight, width), (around, through)],
        yards=[(-1.0, y - 2, near - 0.5, 3.0), (far + 0.5, y - 2, goal[0] + 1, 3.0)],
        hull=hull,
        start=start,
        goal=goal,
    )


def _t(draw: Draw, rng: np.random.Generator) -> Layout:
    stem, width, arm = (draw(name) for name in ("stem", "width", "arm"))
    other = arm + draw("longer")
    depth, end, behind = (draw(name) for name in ("depth", "end", "behind"))
    h = width / 2
    far = stem + h + depth + end
    hull = (-REAR, -other - h - rng.uniform(0.3, 2), far, arm + h + rng.uniform(0.3, 2))
    free = [
        (-REAR, -h, stem + h, h),
        (stem - h, -other - h, stem + h, arm + h),
        (stem - h, arm - h, far, arm + h),
        (stem - h, -other - h, far, -other + h),
    ]
    start, goal = (0.0, rng.uniform(-0.2, 0.2)), (far + behind, rng.uniform(0.3, 1.0) * arm)
    blocked = np.array([[-REAR, 0], [stem, 0], [stem, arm], [far, arm]])
    through = np.array([[stem, 0], [stem, -other], [far, -other]])
    return Layout(
        solids=block(hull, free, rng),
        plugs=[box((stem + h + depth, arm - h, far, arm + h), "end")],
        doorposts=[],
        ways=[np.array([*line, goal]) for line in (blocked, through)],
        corridors=[(blocked, width), (through, width)],
        yards=[(far + 0.5, -other, goal[0] + 1, arm)],
        hull=hull,
        start=start,
        goal=goal,
    )


def _l(draw: Draw, rng: np.random.Generator) -> Layout:
    stem, width, straight = (draw(name) for name in ("stem", "width", "straight"))
    depth, end, aside, behind = (draw(name) for name in ("depth", "end", "aside", "behind"))
    h = width / 2
    corner = stem + straight
    far = corner + h + end
    exit_y = max(depth, width + 0.3)  # centre line of the way out that only the open twin has
    aside = max(aside, exit_y + 0.5)  # the detour is the longer way
    hull = (-REAR, -aside - h - rng.uniform(0.3, 2), far, exit_y + h + rng.uniform(0.3, 2))
    free = [
        (-REAR, -h, corner + h, h),
        (corner - h, -h, corner + h, exit_y + h),
        (corner - h, exit_y - h, far, exit_y + h),
        (stem - h, -aside - h, stem + h, h),
        (stem - h, -aside - h, far, -aside + h),
    ]
    start, goal = (0.0, rng.uniform(-0.2, 0.2)), (far + behind, rng.uniform(0.0, 1.0) * exit_y)
    blocked = np.array([[-REAR, 0], [corner, 0], [corner, exit_y], [far, exit_y]])
    detour = np.array([[stem, 0], [stem, -aside], [far, -aside]])
    return Layout(
        solids=block(hull, free, rng),
        plugs=[box((corner + h, exit_y - h, far, exit_y + h), "end")],
        doorposts=[],
        ways=[np.array([*line, goal]) for line in (blocked, detour)],
        corridors=[(blocked, width), (detour, width)],
        yards=[(far + 0.5, -aside, goal[0] + 1, exit_y)],
        hull=hull,
        start=start,
        goal=goal,
    )


def _t_both(draw: Draw, rng: np.random.Generator) -> Layout:
    back, stem, width, arm = (draw(name) for name in ("fork", "stem", "width", "arm"))
    other = arm + draw("longer")
    depth, end, behind = (draw(name) for name in ("depth", "end", "behind"))
    h, stem = width / 2, back + stem
    far = stem + h + depth + end
    aside = other + width + rng.uniform(0.5, 1.5)
    lower = rng.random() < 0.5  # whether it is the arm on the detour's side that the open twin has
    ways = fork(back, stem + h, aside, far, width)
    hull = (-REAR, -aside - h - rng.uniform(0.3, 2), far, arm + h + rng.uniform(0.3, 2))
    free = [
        *ways.free,
        (stem - h, -other - h, stem + h, arm + h),
        (stem - h, arm - h, far, arm + h),
        (stem - h, -other - h, far, -other + h),
    ]
    reach = (-other, 0.3 * other) if lower else (-0.1 * arm, arm)
    start, goal = (0.0, rng.uniform(-0.2, 0.2)), (far + behind, rng.uniform(*reach))
    # The other arm may end sooner or later than the one that the twins differ in.
    short = min(max(depth + rng.uniform(-1, 1), 2.0), depth + end - 0.8)
    arms = {y: np.array([[stem, 0], [stem, y], [far, y]]) for y in (arm, -other)}
    plugged, filled = (-other, arm) if lower else (arm, -other)
    return Layout(
        solids=[*block(hull, free, rng), box((stem + h + short, filled - h, far, filled + h), "end")],
        plugs=[box((stem + h + depth, plugged - h, far, plugged + h), "end")],
        doorposts=[],
        ways=[np.array([*ways.stem, *arms[plugged][1:], goal]), np.array([*ways.detour, goal])],
        corridors=[(ways.stem, width), (ways.detour, width), *((line, width) for line in arms.values())],
        yards=[(far + 0.5, -aside, goal[0] + 1, arm)],
        hull=hull,
        start=start,
        goal=goal,
    )


LAYOUTS = {"open": _open, "u": _u, "corridor": _corridor, "t": _t, "t-both": _t_both, "l": _l}
