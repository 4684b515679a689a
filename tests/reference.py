"""Oracles in plain loops and double precision, written from the definitions, not from the package's code."""

import heapq
import math

import numpy as np

UNREACHABLE = 1e4

STRAIGHT = [(0, 1), (0, -1), (1, 0), (-1, 0)]
DIAGONAL = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
KNIGHT = [(1, 2), (1, -2), (-1, 2), (-1, -2), (2, 1), (2, -1), (-2, 1), (-2, -1)]


def sides(enter, east=None, north=None):
    """The set of neighbouring cells ((i, j), (i, j)) between which one can pass, both ways."""
    h, w = enter.shape
    joined = set()
    for i in range(h):
        for j in range(w):
            for (a, b), wall in (((i, j + 1), east), ((i + 1, j), north)):
                if a < h and b < w and enter[i, j] and enter[a, b] and (wall is None or wall[i, j]):
                    joined |= {((i, j), (a, b)), ((a, b), (i, j))}
    return joined


def edges(cell_cost, resolution, east=None, north=None):
    """`{cell: [(next cell, cost)]}`: the graph on which `grids.cost_to_go` is defined."""
    h, w = cell_cost.shape
    enter = cell_cost < UNREACHABLE
    joined = sides(enter, east, north)

    def open_around(i, j, n):
        """Whether all cells within n of (i, j) can be entered, through open sides; the window's edge is no wall."""
        block = [(a, b) for a in range(i - n, i + n + 1) for b in range(j - n, j + n + 1)]
        block = {(a, b) for a, b in block if 0 <= a < h and 0 <= b < w}
        for a, b in block:
            if not enter[a, b]:
                return False
            for c in ((a + 1, b), (a, b + 1)):
                if c in block and ((a, b), c) not in joined:
                    return False
        return True

    graph = {}
    for i in range(h):
        for j in range(w):
            ways = [(k, 1.0) for k in STRAIGHT if ((i, j), (i + k[0], j + k[1])) in joined]
            if open_around(i, j, 1):
                ways += [(k, math.sqrt(2)) for k in DIAGONAL]
            if open_around(i, j, 2):
                ways += [(k, math.sqrt(5)) for k in KNIGHT]
            graph[i, j] = [
                ((i + k[0], j + k[1]), length * cell_cost[i, j] * resolution)
                for k, length in ways
                if 0 <= i + k[0] < h and 0 <= j + k[1] < w
            ]
    return graph


def dijkstra(cell_cost, initial, resolution, east=None, north=None):
    """Least cost from every cell to the cells where `initial` is known, on the graph `edges`."""
    back = {cell: [] for cell in np.ndindex(cell_cost.shape)}
    for cell, ways in edges(cell_cost, resolution, east, north).items():
        for to, cost in ways:
            back[to].append((cell, cost))
    value = np.full(cell_cost.shape, UNREACHABLE)
    queue = [(float(initial[c]), c) for c in back if initial[c] < UNREACHABLE]
    heapq.heapify(queue)
    while queue:
        cost, cell = heapq.heappop(queue)
        if cost >= value[cell]:
            continue
        value[cell] = cost
        for before, step in back[cell]:
            heapq.heappush(queue, (cost + step, before))
    return value


def inflation(distance, inscribed, scaling, radius):
    """Nav2's `InflationLayer::computeCost` for one distance [m]; 0 beyond the inflation radius."""
    if distance == 0:
        return 254
    if distance <= inscribed:
        return 253
    if distance > radius:
        return 0
    return int(252 * math.exp(-scaling * (distance - inscribed)))


def wrap(angle):
    """An angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def rollout(pose, twist, v_target, w_target, robot, dt, steps):
    """`[(x, y, yaw, v, omega)]` of a unicycle that tends to the target speeds, by the midpoint rule."""
    x, y, yaw = map(float, pose)
    v, w = map(float, twist)
    out = []
    for _ in range(steps):
        v = min(max(float(v_target), v - robot.a_max * dt), v + robot.a_max * dt)
        w = min(max(float(w_target), w - robot.alpha_max * dt), w + robot.alpha_max * dt)
        x += v * dt * math.cos(yaw + w * dt / 2)
        y += v * dt * math.sin(yaw + w * dt / 2)
        yaw += w * dt
        out.append((x, y, yaw, v, w))
    return out


def score(layers, origin, resolution, candidate, params, robot, dt, steps, block, standing_speed):
    """The best prefix of one candidate by the equations of `planning.scoring`.

    Args:
        layers: (clearance [m], risk, value [m]), each `[H, W]`.
        origin: Corner of cell (0, 0).
        resolution: Edge of a cell.
        candidate: pose, twist, v, w, turned, reach, bias.
        params: Weights.
        robot: Limits.
        dt: Step.
        steps: Their number.
        block: Clearance below which a step is blocked.
        standing_speed: Equivalent length per second of standing still.

    Returns:
        Score, J_geom, EDE, end and length of the best prefix (None if there is none), whether the runner-up is worse by
        1e-3, and how far every pose was from the border between two cells [cells].
    """
    clear, risk, value = layers
    h, w = clear.shape
    arc = lack = exposure = 0.0
    turned = candidate["turned"]
    hit, found, certainty = False, [], 1.0
    path = rollout(candidate["pose"], candidate["twist"], candidate["v"], candidate["w"], robot, dt, steps)
    for k, (x, y, _, v, omega) in enumerate(path, start=1):
        if k * dt > params.horizon + 1e-9 or arc >= min(candidate["reach"], params.range_max):
            break
        fx, fy = (x - origin[0]) / resolution, (y - origin[1]) / resolution
        certainty = min(certainty, *(abs(f - round(f)) for f in (fx, fy)))
        cell = min(max(math.floor(fy), 0), h - 1), min(max(math.floor(fx), 0), w - 1)
        if clear[cell] < block:
            hit = True
            break
        ds = abs(v) * dt
        arc += ds
        turned += abs(omega) * dt
        soft = robot.radius + params.soft_clearance
        share = (soft - clear[cell]) / (params.soft_clearance - params.margin)
        lack += max(share, 0.0) ** 2 * ds
        exposure += math.exp(-params.decay * arc) * risk[cell] * max(ds, standing_speed * dt)
        geometric = (
            params.clearance * lack
            + params.smoothness * turned
            + params.range_bias * max(params.range_min - arc, 0.0)
            + params.progress * (value[cell] + arc)
        )
        if arc >= params.range_least:
            found.append((geometric + params.risk_weight * exposure, geometric, exposure, x, y, arc))
    if not found:
        return None, certainty
    found.sort()
    extra = params.collision * hit + candidate["bias"]
    best = found[0]
    clear_winner = len(found) == 1 or found[1][0] > best[0] + 1e-3
    result = {
        "score": best[0] + extra, "geometric": best[1] + extra, "exposure": best[2], "end": best[3:5], "arc": best[5],
        "hit": hit, "clear_winner": clear_winner,
    }  # fmt: skip
    return result, certainty
