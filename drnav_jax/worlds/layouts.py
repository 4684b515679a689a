"""Layouts of the families in their own frame: the trip runs along +x, the dead end lies at y >= 0.

A layout has the walls that both twins share, the plugs that close its dead end and the doorposts
that the open twin has in their place. Its ways are what clutter keeps clear of.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from drnav_jax.worlds.world import WALL_HEIGHT, World, make_world, signed_distance

WAY = 1.2  # [m] width that clutter leaves free along every passage
WING = 50.0  # [m] of wall to either side of a block
MOUTH = 4.9  # [m] the widest of a cul-de-sac; wider or shallower ones are bays, not dead ends
REAR = 7.0  # [m] of stem or fence behind the start

Rect = tuple[float, float, float, float]  # x_min, y_min, x_max, y_max
Draw = Callable[[str], float]


@dataclasses.dataclass(frozen=True)
class Layout:
    """A layout in its own frame; boxes are rows x, y, yaw, half length, half width."""

    walls: list[np.ndarray]  # of both twins
    plugs: list[np.ndarray]  # of the closed one
    doorposts: list[np.ndarray]  # of the open one
    ways: list[np.ndarray]  # polylines [L, 2] along which clutter leaves WAY
    corridors: list[tuple[np.ndarray, float]]  # polylines along whose walls it stands, widths
    yards: list[Rect]  # where it stands freely
    hull: Rect  # everything but the wings, start and goal
    start: tuple[float, float]
    goal: tuple[float, float]
    num_clutter: int = 5


def _wall(a: tuple[float, float], b: tuple[float, float], thickness: float) -> np.ndarray:
    """The box around a segment, longer by half its thickness at both ends."""
    (ax, ay), (bx, by) = a, b
    length = math.hypot(bx - ax, by - ay)
    yaw = math.atan2(by - ay, bx - ax)
    return np.array([(ax + bx) / 2, (ay + by) / 2, yaw, (length + thickness) / 2, thickness / 2])


def _solid(rect: Rect) -> np.ndarray:
    x0, y0, x1, y1 = rect
    return np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0, (x1 - x0) / 2, (y1 - y0) / 2])


def _carved(block: Rect, free: list[Rect]) -> list[np.ndarray]:
    """Boxes that fill a block but for some rectangles: strips along y, merged along x."""
    xs = sorted({min(max(x, block[0]), block[2]) for r in [block, *free] for x in (r[0], r[2])})
    ys = sorted({min(max(y, block[1]), block[3]) for r in [block, *free] for y in (r[1], r[3])})
    running: dict[tuple[float, float], float] = {}  # strips that reach the current x, and from where
    boxes = []
    for x0, x1 in [*zip(xs[:-1], xs[1:], strict=True), (block[2], block[2])]:
        x = (x0 + x1) / 2
        strips: list[tuple[float, float]] = []
        for y0, y1 in zip(ys[:-1], ys[1:], strict=True):
            y = (y0 + y1) / 2
            hollow = any(r[0] < x < r[2] and r[1] < y < r[3] for r in free)
            if hollow or x1 == x0:
                continue
            if strips and strips[-1][1] == y0:
                strips[-1] = (strips[-1][0], y1)
            else:
                strips.append((y0, y1))
        for strip in [s for s in running if s not in strips]:
            boxes.append(_solid((running.pop(strip), strip[0], x0, strip[1])))
        for strip in strips:
            running.setdefault(strip, x0)
    return boxes


def _block(
    hull: Rect, free: list[Rect], rng: np.random.Generator, fence: float = 0.0
) -> list[np.ndarray]:
    """A block with passages and the wall that it stands in, which on one side runs back first."""
    thickness = rng.uniform(0.2, 0.3)
    x, back, low, high = hull[0] + thickness / 2, hull[0] - fence, hull[1], hull[3]
    turns = [(x, high), (back, high)] if fence > 0 else [(x, high)]
    wing = [*turns, (turns[-1][0], high + WING)]
    walls = [_wall(a, b, thickness) for a, b in zip(wing[:-1], wing[1:], strict=True)]
    return [*_carved(hull, free), *walls, _wall((x, low), (x, low - WING), thickness)]


def _open(draw: Draw, rng: np.random.Generator) -> Layout:
    length = draw("length")
    yard = (1.5, -6.0, length - 1.5, 6.0)
    around = [[0, 0], [0, 7], [length, 7], [length, 0]]  # a way past everything
    return Layout(
        walls=[],
        plugs=[],
        doorposts=[],
        ways=[np.array(around)],
        corridors=[],
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
        _wall((ahead, low - spread[0]), (back, low), thickness),
        _wall((ahead, high + spread[1]), (back, high), thickness),
    ]
    edge = max(-low + max(spread[0], 0), high + max(spread[1], 0)) + 1.2
    goal = (back + behind, goal_y)
    ways = [
        np.array([[0, 0], [ahead - 0.5, s * edge], [back + 1, s * edge], goal]) for s in (-1, 1)
    ]
    inner = np.array([[0, 0], [ahead, shift], [back - 1, middle], [back + 1, middle], goal])
    return Layout(
        walls=sides,
        plugs=[_wall((back, low), (back, high), thickness)],
        doorposts=[
            _wall((back, low), (back, middle - door / 2 - thickness / 2), thickness),
            _wall((back, middle + door / 2 + thickness / 2), (back, high), thickness),
        ],
        ways=[*ways, inner],
        corridors=[],
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
        walls=_block(hull, [blocked, passage], rng, fence=near + REAR),
        plugs=[_solid((near + depth, -width / 2, far, width / 2))],
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
        walls=_block(hull, free, rng),
        plugs=[_solid((stem + h + depth, arm - h, far, arm + h))],
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
        walls=_block(hull, free, rng),
        plugs=[_solid((corner + h, exit_y - h, far, exit_y + h))],
        doorposts=[],
        ways=[np.array([*line, goal]) for line in (blocked, detour)],
        corridors=[(blocked, width), (detour, width)],
        yards=[(far + 0.5, -aside, goal[0] + 1, exit_y)],
        hull=hull,
        start=start,
        goal=goal,
    )


LAYOUTS = {"open": _open, "u": _u, "corridor": _corridor, "t": _t, "l": _l}


def _to_polyline(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distance [m] of points `[N, 2]` to a polyline `[L, 2]`."""
    a, d = line[:-1], np.diff(line, axis=0)
    t = np.einsum("nld,ld->nl", points[:, None] - a, d) / np.maximum((d * d).sum(1), 1e-12)
    nearest = a + np.clip(t, 0, 1)[..., None] * d
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(1)


def world_of(boxes: list[np.ndarray], cylinders: list[np.ndarray]) -> World:
    """Boxes x, y, yaw, half length, half width (, height) and cylinders x, y, radius, height."""
    rows = [[*b[:5], 0.0, b[5] if len(b) > 5 else WALL_HEIGHT] for b in boxes]
    return make_world(rows, [[*c[:3], 0.0, c[3]] for c in cylinders])


def clutter(
    layout: Layout, rng: np.random.Generator
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Boxes and cylinders that stand freely in the yards or flush with the walls of corridors."""
    boxes: list[np.ndarray] = []
    cylinders: list[np.ndarray] = []
    fixed = layout.walls + layout.plugs
    ends = np.array([layout.start, layout.goal])

    def place(x: float, y: float, yaw: float, size: float, free_standing: bool) -> None:
        is_box, height = rng.random() < 0.5, rng.uniform(0.7, 2.0)
        half = size * rng.uniform(0.6, 1.0, 2)
        if not free_standing:
            half[1] = size  # from the wall to the way
        reach = math.hypot(*half) if is_box and free_standing else size
        centre = np.array([[x, y]])
        ways = layout.ways if free_standing else [line for line, _ in layout.corridors]
        gap = min(_to_polyline(centre, way)[0] for way in ways) - reach
        solids = world_of(fixed + boxes if free_standing else boxes, cylinders)
        room = signed_distance(solids, centre)[0] - reach
        to_ends = np.linalg.norm(centre - ends, axis=1).min() - reach
        if gap < WAY / 2 or room < WAY or to_ends < WAY:
            return
        if is_box:
            boxes.append(np.array([x, y, yaw, *half, height]))
        else:
            cylinders.append(np.array([x, y, size, height]))

    for _ in range(3 * layout.num_clutter if layout.yards else 0):
        x0, y0, x1, y1 = layout.yards[rng.integers(len(layout.yards))]
        x, y, yaw = rng.uniform(x0, x1), rng.uniform(y0, y1), rng.uniform(-math.pi, math.pi)
        size = rng.uniform(0.15, 0.6)
        if len(boxes) + len(cylinders) < layout.num_clutter:
            place(x, y, yaw, size, free_standing=True)
    for line, width in layout.corridors:
        size = (width - WAY) / 4
        for k in range(len(line) - 1):
            t, side = rng.uniform(0.1, 0.9), rng.choice([-1.0, 1.0])
            d = line[k + 1] - line[k]
            unit = d / np.linalg.norm(d)
            x, y = line[k] + t * d + side * (width / 2 - size) * np.array([-unit[1], unit[0]])
            if size > 0.12 and rng.random() < 0.5:
                place(x, y, math.atan2(unit[1], unit[0]), size - 1e-3, free_standing=False)
    return boxes, cylinders
