"""Nav2's DWB and MPPI in plain loops and double precision, written from their formulas, not from the package's code."""

import math

import numpy as np


def wrap(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


class Map:
    """A costmap of bytes."""

    def __init__(self, values, origin, resolution):
        self.values, self.origin, self.resolution = np.asarray(values), np.asarray(origin, float), resolution

    def cell(self, x, y):
        """(row, column), or None off the map."""
        row = math.floor((y - self.origin[1]) / self.resolution)
        col = math.floor((x - self.origin[0]) / self.resolution)
        h, w = self.values.shape
        return (row, col) if 0 <= row < h and 0 <= col < w else None

    def cost(self, x, y):
        cell = self.cell(x, y)
        return 255.0 if cell is None else float(self.values[cell])


# DWB


def project(v0, acc, decel, dt, target):
    """Nav2's projectVelocity: towards the target, up with `acc`, down with `decel` < 0."""
    return min(target, v0 + acc * dt) if v0 < target else max(target, v0 + decel * dt)


def one_axis(current, low, high, acc, decel, time, num):
    """What OneDVelocityIterator returns, in order."""
    current = min(max(current, low), high)
    top, bottom = project(current, acc, decel, time, high), project(current, acc, decel, time, low)
    if abs(bottom - top) < 1e-5:
        return [bottom]
    step = (top - bottom) / (max(2, num) - 1)
    found = []
    for k in range(num):
        value = bottom + k * step
        if found and found[-1] < 0 < value:
            found.append(0.0)
        found.append(value)
    return found


def twists(current, limits, time, nums):
    """[(vx, vy, omega)], x outermost; limits = ((low, high, acc, decel) for x, y, theta)."""
    axes = [one_axis(c, *limit, time, n) for c, limit, n in zip(current, limits, nums, strict=True)]
    return [(x, y, t) for x in axes[0] for y in axes[1] for t in axes[2] if (x, y, t) != (0, 0, 0)]


def trajectory(pose, twist, v, w, robot, sim_time, linear, angular, max_steps=10**9):
    """Poses of one twist, the one at the start included, and N before rounding up."""
    exact = max(abs(v) * sim_time / linear, abs(w) * sim_time / angular)
    steps = min(max(math.ceil(exact - 1e-4), 1), max_steps)
    dt = sim_time / steps
    x, y, yaw = map(float, pose)
    now_v, now_w = map(float, twist)
    poses = [(x, y, yaw)]
    for _ in range(steps):
        now_v = project(now_v, robot.a_max, -robot.a_max, dt, v)
        now_w = project(now_w, robot.alpha_max, -robot.alpha_max, dt, w)
        x, y = x + now_v * math.cos(yaw) * dt, y + now_v * math.sin(yaw) * dt
        yaw += now_w * dt
        poses.append((x, y, yaw))
    return poses + poses[-1:], exact


def grid_of(costmap, points, goal_only):
    """Exact L1 distances [cells] by brute force; None where there are no path cells."""
    cells, started = [], False
    for x, y in points:
        cell = costmap.cell(x, y)
        if cell is not None and costmap.values[cell] != 255:
            cells.append(cell)
            started = True
        elif started:
            break
    if not cells:
        return None
    cells = cells[-1:] if goal_only else cells
    h, w = costmap.values.shape
    return np.array([[min(abs(i - a) + abs(j - b) for a, b in cells) for j in range(w)] for i in range(h)])


def dwb_scores(params, latched, trends, costmap, points, pose, twist, goal, v, w, poses):
    """{critic: (scale, raw or None if illegal)} of one trajectory.

    Args:
        params: Scales and numbers.
        latched: (in_window, rotating), this tick included.
        trends: ((positive only, negative only) for v, for omega).
        costmap: A Map.
        points: Of the path.
        pose: Robot.
        twist: Its speeds.
        goal: x, y, yaw.
        v: Of the trajectory.
        w: Of the trajectory.
        poses: Of the trajectory.
    """
    end = poses[-1]
    res = costmap.resolution
    away = math.hypot(goal[0] - pose[0], goal[1] - pose[1])
    in_window, rotating = latched
    found = {}
    turn = abs(wrap(goal[2] - end[2]))
    if not in_window:
        rotate = 0.0
    elif not rotating:
        rotate = None if v * v >= twist[0] ** 2 else 5.0 * v * v + turn
    else:
        rotate = None if v != 0 else turn
    found["RotateToGoal"] = (params.rotate_to_goal, rotate)
    swings = any(
        (positive and speed < 0) or (negative and speed > 0)
        for (positive, negative), speed in zip(trends, (v, w), strict=True)
    )
    found["Oscillation"] = (params.oscillation, None if swings else 0.0)
    hit = any(costmap.cost(x, y) >= 253 for x, y, _ in poses)
    found["BaseObstacle"] = (params.base_obstacle, None if hit else costmap.cost(*end[:2]))

    def at(grid, x, y):
        cell = costmap.cell(x, y)
        return None if cell is None else (1e6 if grid is None else float(grid[cell]))

    ahead = params.forward_point
    nose = end[0] + ahead * math.cos(end[2]), end[1] + ahead * math.sin(end[2])
    bearing = math.atan2(goal[1] - pose[1], goal[0] - pose[0])
    moved = [*points[:-1], (points[-1][0] + ahead * math.cos(bearing), points[-1][1] + ahead * math.sin(bearing))]
    path_grid, goal_grid = grid_of(costmap, points, False), grid_of(costmap, points, True)
    found["GoalAlign"] = (params.goal_align * res / 2, at(grid_of(costmap, moved, True), *nose))
    found["PathAlign"] = (0.0 if away <= ahead else params.path_align * res / 2, at(path_grid, *nose))
    off = any(costmap.cell(x, y) is None for x, y, _ in poses)
    for name, grid, scale in (
        ("PathDist", path_grid, params.path_dist),
        ("GoalDist", goal_grid, params.goal_dist),
    ):
        found[name] = (scale * res / 2, None if off or grid is None else at(grid, *end[:2]))
    return found


def dwb_best(scores):
    """Index and total of the first strict minimum of [{critic: (scale, raw)}]; (None, None) if nothing is legal."""
    best = None, None
    for k, critics in enumerate(scores):
        asked = [(scale, raw) for scale, raw in critics.values() if scale != 0]
        if any(raw is None for _, raw in asked):
            continue
        total = sum(scale * raw for scale, raw in asked)
        if best[1] is None or total < best[1]:
            best = k, total
    return best


class Trend:
    """One sign trend of the Oscillation critic."""

    def __init__(self):
        self.sign, self.positive_only, self.negative_only = 0, False, False

    def update(self, speed):
        flipped = False
        if speed < 0:
            if self.sign > 0:
                self.negative_only = flipped = True
            self.sign = -1
        elif speed > 0:
            if self.sign < 0:
                self.positive_only = flipped = True
            self.sign = 1
        return flipped


class Oscillation:
    """Trends of v and omega, as they are debriefed with what was sent."""

    def __init__(self, params):
        self.params, self.v, self.w, self.place = params, Trend(), Trend(), (0.0, 0.0, 0.0)

    def debrief(self, pose, v, w):
        flipped = self.v.update(v)
        if abs(v) <= self.params.only_x:
            flipped |= self.w.update(w)
        if flipped:
            self.place = tuple(map(float, pose))
        held = [t.positive_only or t.negative_only for t in (self.v, self.w)]
        moved = math.hypot(pose[0] - self.place[0], pose[1] - self.place[1]) > self.params.reset_distance
        if any(held) and (moved or abs(wrap(pose[2] - self.place[2])) > self.params.reset_angle):
            self.v, self.w = Trend(), Trend()

    def trends(self):
        return tuple((t.positive_only, t.negative_only) for t in (self.v, self.w))


# MPPI


def accelerate(v, target, up, down, dt):
    """What is reached of `target`; `up` speeds up, `down` > 0 slows down, by the sign of v."""
    low, high = (v - down * dt, v + up * dt) if v > 0 else (v - up * dt, v + down * dt)
    return min(max(target, low), high)


def mppi_rollout(pose, twist, controls, limits, dt):
    """`[T]` arrays x, y, yaw, v, omega of one control sequence `[T, 2]`."""
    v, w = [float(twist[0])], [float(twist[1])]
    for c in controls[:-1]:
        v.append(accelerate(v[-1], c[0], limits.a_max, -limits.a_min, dt))
        w.append(min(max(c[1], w[-1] - limits.alpha_max * dt), w[-1] + limits.alpha_max * dt))
    x, y, yaw = map(float, pose)
    rows = []
    for a, b in zip(v, w, strict=True):
        x, y, yaw = x + a * math.cos(yaw) * dt, y + a * math.sin(yaw) * dt, yaw + b * dt
        rows.append((x, y, yaw))
    return (*np.array(rows).T, np.array(v), np.array(w))


def collides(cost, circular, track_unknown):
    return cost == 254 or (cost == 253 and circular) or (cost == 255 and not track_unknown)


def mppi_terms(spec, params, limits, inflation, costmap, risk, path, pose, goal_yaw, goal_tolerance, runs, dt):
    """{critic: [K] costs} of trajectories `runs` = [(x, y, yaw, v, omega)], and whether all collide.

    Args:
        spec: Critics, strides and rules of collision.
        params: Numbers.
        limits: Of the robot.
        inflation: Scaling and radius.
        costmap: A Map.
        risk: A Map of P_dead^foot; None = no risk.
        path: [(x, y)].
        pose: Robot.
        goal_yaw: Wanted at the end of the path.
        goal_tolerance: Of its last point.
        runs: Trajectories.
        dt: Step.
    """
    n, num = len(path), len(runs)
    arc = [0.0]
    for a, b in zip(path[:-1], path[1:], strict=True):
        arc.append(arc[-1] + math.dist(a, b))
    left = arc[-1]
    steps = len(runs[0][0])
    bad = [collides(costmap.cost(*p), spec.circular, spec.track_unknown) for p in path[:-1]]
    nearest = []
    for x, y, *_ in runs:
        away = [math.dist(p, (x[-1], y[-1])) for p in path]
        nearest.append(min(range(n), key=away.__getitem__))
    furthest = max(nearest)
    out = {}

    def put(name, of, terms):
        out[name] = np.array([(of.weight * t) ** of.power for t in terms])

    over = [[max(a - limits.v_max, 0) + max(limits.v_min - a, 0) for a in v] for _, _, _, v, _ in runs]
    put("Constraint", params.constraint, [dt * sum(o) for o in over])

    def strided_cost(x, y):
        looked = range(0, steps, spec.cost_every)
        total, hit = 0.0, False
        for t in looked:
            c = costmap.cost(x[t], y[t])
            if c < 1:
                continue
            if collides(c, spec.circular, spec.track_unknown):
                total, hit = params.cost.collision, True
                break
            if c >= 253:
                total += params.cost.critical
            elif left >= params.cost.near_goal:
                total += c
        return total / 254.0 / len(looked), hit

    priced = [strided_cost(x, y) for x, y, *_ in runs]
    put("Cost", params.cost, [p for p, _ in priced])
    all_hit = all(h for _, h in priced)

    raws, reps = [], []
    for x, y, *_ in runs:
        raw = rep = 0.0
        for a, b in zip(x, y, strict=True):
            c = costmap.cost(a, b)
            if c < 1:
                continue
            if collides(c, spec.circular, spec.track_unknown):
                raw = params.obstacles.collision
                break
            d = (math.log(253.0) - math.log(c)) / inflation.scaling
            raw += max(params.obstacles.margin - d, 0.0)
            if left >= params.obstacles.near_goal:
                rep += inflation.radius - d
        raws.append(raw)
        reps.append(rep)
    of = params.obstacles
    out["Obstacles"] = np.array(
        [
            (of.critical * raw + of.repulsion * (rep - min(reps)) / steps) ** of.power
            for raw, rep in zip(raws, reps, strict=True)
        ]
    )

    to_goal = [sum(math.dist(path[-1], p) for p in zip(x, y, strict=True)) / steps for x, y, *_ in runs]
    put("Goal", params.goal, to_goal if left <= params.goal.within else [0.0] * num)
    turned = [sum(abs(wrap(a - goal_yaw)) for a in yaw) / steps for _, _, yaw, *_ in runs]
    put("GoalAngle", params.goal_angle, turned if left <= params.goal_angle.within else [0.0] * num)

    blocked = sum(bad[:furthest])
    aligned = (
        left >= params.align.beyond
        and furthest >= params.align.furthest
        and (blocked <= 2 or blocked / furthest <= params.align.blocked)
    )

    def at_arc(s):
        """Index of the path point, but for the last, nearest to arc length s; of two the later."""
        return min(range(n - 1), key=lambda k: (abs(arc[k] - s), -k))

    def apart(x, y):
        s = total = count = 0.0
        for t in range(spec.align_every, steps, spec.align_every):
            s += math.dist((x[t], y[t]), (x[t - spec.align_every], y[t - spec.align_every]))
            k = at_arc(s)
            if not bad[k]:
                total, count = total + math.dist(path[k], (x[t], y[t])), count + 1
        return total / count if count else 0.0

    put("PathAlign", params.align, [apart(x, y) for x, y, *_ in runs] if aligned else [0.0] * num)

    at = min(furthest + params.follow.offset, n - 1)
    while at < n - 2 and bad[at]:
        at += 1
    gaps = [math.dist(path[at], (x[-1], y[-1])) for x, y, *_ in runs]
    put("PathFollow", params.follow, gaps if left >= params.follow.beyond else [0.0] * num)

    px, py = path[min(furthest + params.angle.offset, n - 1)]
    aside = abs(wrap(math.atan2(py - pose[1], px - pose[0]) - pose[2]))
    if left >= params.angle.beyond and aside >= params.angle.min_angle:
        angles = [abs(wrap(math.atan2(py - y[-1], px - x[-1]) - yaw[-1])) for x, y, yaw, *_ in runs]
    else:
        angles = [0.0] * num
    put("PathAngle", params.angle, angles)

    backwards = [dt * sum(max(-a, 0.0) for a in v) for _, _, _, v, _ in runs]
    put("PreferForward", params.forward, backwards if left >= params.forward.beyond else [0.0] * num)
    there = math.dist(path[-1], pose[:2]) < goal_tolerance
    put("Twirling", params.twirling, [0.0 if there else float(np.mean(np.abs(w))) for *_, w in runs])
    of = params.deadband
    slow = [
        dt * sum(max(of.v - abs(a), 0.0) + max(of.w - abs(b), 0.0) for a, b in zip(v, w, strict=True))
        for _, _, _, v, w in runs
    ]
    put("VelocityDeadband", of, slow)

    def exposure(x, y, v):
        s = total = 0.0
        for a, b, speed in zip(x, y, v, strict=True):
            ds = abs(speed) * dt
            s += ds
            p = 0.0 if risk is None or risk.cell(a, b) is None else float(risk.values[risk.cell(a, b)])
            total += math.exp(-params.exposure.decay * s) * p * max(ds, 0.25 * dt)
        return total

    put("Exposure", params.exposure, [exposure(x, y, v) for x, y, _, v, _ in runs])
    return out, all_hit


def mppi_update(u, c, costs, gamma, sigma, temperature):
    """New control sequence `[T, 2]` from c `[K, T, 2]` and the costs of driving it, and the weights."""
    u, c, costs = (np.asarray(a, float) for a in (u, c, costs))
    total = costs.copy()
    for k in range(len(costs)):
        for axis in range(2):
            for t in range(len(u)):
                total[k] += gamma / sigma[axis] ** 2 * u[t, axis] * (c[k, t, axis] - u[t, axis])
    weight = np.exp(-(total - total.min()) / temperature)
    weight /= weight.sum()
    return np.einsum("k,kta->ta", weight, c), weight


def mppi_clamp(u, twist, limits, dt):
    """Speed limits, then what is reachable from the speed before."""
    v, w = map(float, twist)
    out = []
    for a, b in u:
        a, b = min(max(a, limits.v_min), limits.v_max), min(max(b, -limits.w_max), limits.w_max)
        v = accelerate(v, a, limits.a_max, -limits.a_min, dt)
        w = min(max(b, w - limits.alpha_max * dt), w + limits.alpha_max * dt)
        out.append((v, w))
    return np.array(out)
