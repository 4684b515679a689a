"""Occupancy against plain NumPy, OctoMap, a continuous ray caster and a long drive along walls."""

import math
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pyoctomap
import pytest

from drnav_jax.filter import OccupancyParams, occupancy

RESOLUTION = 0.1
MAX_RANGE = 12.0
SENSOR_Z = 0.5
AZIMUTHS = -np.pi + (np.arange(180) + 0.5) * 2 * np.pi / 180
RINGS = np.radians(np.linspace(-15, 15, 16))
LEVEL = np.zeros(1)
PARAMS = OccupancyParams()

observed = jax.jit(occupancy.observed, static_argnums=(1, 7))  # as inside `update`: one program, not one for each operation


def wall_distance(segments, pose, azimuths=AZIMUTHS):
    """Horizontal distance [A] from `pose` to the nearest segment (x1, y1, x2, y2); inf: none."""
    bearings = azimuths + pose[2]
    d = np.stack([np.cos(bearings), np.sin(bearings)], -1)[:, None]
    a, b = np.asarray(segments)[None, :, :2], np.asarray(segments)[None, :, 2:]
    e, f = b - a, a - np.asarray(pose)[None, None, :2]
    cross = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
    cross = np.where(np.abs(cross) < 1e-12, 1e-12, cross)
    t = (f[..., 0] * e[..., 1] - f[..., 1] * e[..., 0]) / cross
    u = (f[..., 0] * d[..., 1] - f[..., 1] * d[..., 0]) / cross
    return np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf).min(1)


def scan(segments, pose, rings=RINGS, height=2.5, noise=None):
    """Points [P, 3] in base_link of a scan among upright walls of one height on flat ground."""
    flat = np.repeat(wall_distance(segments, pose)[None], len(rings), 0)
    tan = np.tan(rings)[:, None]
    flat = np.minimum(flat, 1e3)
    flat = np.where(SENSOR_Z + flat * tan > height, np.inf, flat)
    flat = np.minimum(flat, np.where(tan < 0, SENSOR_Z / np.maximum(-tan, 1e-9), np.inf))
    r = flat / np.cos(rings)[:, None]
    if noise is not None:
        r = np.where(r < MAX_RANGE, r + noise.normal(0, 0.02, r.shape), r)
    r = np.minimum(r, MAX_RANGE)
    c, s = np.cos(rings)[:, None], np.sin(rings)[:, None]
    x, y = r * c * np.cos(AZIMUTHS)[None], r * c * np.sin(AZIMUTHS)[None]
    points = np.stack([x, y, SENSOR_Z + r * s], -1).reshape(-1, 3)
    return jnp.asarray(points, jnp.float32)


def box(x1, y1, x2, y2):
    return [(x1, y1, x2, y1), (x2, y1, x2, y2), (x2, y2, x1, y2), (x1, y2, x1, y1)]


def blank(shape):
    return jnp.zeros(shape, jnp.float32), jnp.zeros(shape, bool)


def window(shape, xy=(0.0, 0.0)):
    """Origin of a window centred on `xy`."""
    h, w = shape
    half = np.array([w, h]) * RESOLUTION / 2
    return jnp.asarray(np.asarray(xy) - half, jnp.float32)


def everything(points):
    return jnp.ones(points.shape[0], bool)


def centres(shape, origin):
    x = float(origin[0]) + (np.arange(shape[1]) + 0.5) * RESOLUTION
    y = float(origin[1]) + (np.arange(shape[0]) + 0.5) * RESOLUTION
    return np.meshgrid(x, y)


def masks_in_loops(shape, origin, pose, points, valid, params=PARAMS, n=180):
    """The masks of `observed`, cell by cell and point by point.

    Also which cells lie too near a bin's edge or the clear range to say (rounding).
    """
    clear = np.zeros(n)
    nearest = np.full(n, np.inf)
    hit = np.zeros(shape, bool)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for (x, y, z), ok in zip(points, valid, strict=True):
        if not (ok and np.isfinite([x, y, z]).all() and math.hypot(x, y) > params.min_range):
            continue
        k = int((math.atan2(y, x) + math.pi) / (2 * math.pi) * n) % n
        r = math.hypot(x, y)
        ended = math.sqrt(r * r + (z - params.sensor_z) ** 2) < params.max_range - 1e-3
        if ended and params.z_min <= z <= params.z_max:
            nearest[k] = min(nearest[k], r)
            col = math.floor((pose[0] + c * x - s * y - origin[0]) / RESOLUTION)
            row = math.floor((pose[1] + s * x + c * y - origin[1]) / RESOLUTION)
            if 0 <= row < shape[0] and 0 <= col < shape[1]:
                hit[row, col] = True
        else:
            rise = max(z - params.sensor_z, 1e-9)
            clear[k] = max(clear[k], r * min(1.0, (params.z_max - params.sensor_z) / rise))
    clear = np.where(np.isfinite(nearest), nearest, clear)
    crossed, unsure = np.zeros(shape, bool), np.zeros(shape, bool)
    for row in range(shape[0]):
        for col in range(shape[1]):
            dx = origin[0] + (col + 0.5) * RESOLUTION - pose[0]
            dy = origin[1] + (row + 0.5) * RESOLUTION - pose[1]
            place = ((math.atan2(dy, dx) - pose[2] + math.pi) / (2 * math.pi) * n) % n
            k = int(place) % n
            limit = min(clear[k], clear[k - 1], clear[(k + 1) % n]) - params.margin * RESOLUTION
            limit = max(limit, params.body_radius)
            crossed[row, col] = math.hypot(dx, dy) < limit and not hit[row, col]
            edge = abs(place - round(place)) < 0.01
            unsure[row, col] = edge or abs(math.hypot(dx, dy) - limit) < 1e-4
    return hit, crossed, unsure


def random_points(rng, n=400):
    points = rng.uniform([-6, -6, -0.2], [6, 6, 2.5], (n, 3))
    points[rng.random(n) < 0.05] = np.nan
    far = rng.random(n) < 0.2
    points[far] *= (MAX_RANGE + 0.01) / np.linalg.norm(points[far] - [0, 0, SENSOR_Z], axis=-1, keepdims=True)
    return points.astype(np.float32), rng.random(n) < 0.8


def test_bearing_is_close_to_atan2():
    angle = jnp.linspace(-math.pi + 1e-6, math.pi - 1e-6, 20_001)
    for radius in (1e-3, 1.0, 12.0):
        error = occupancy.bearing(radius * jnp.cos(angle), radius * jnp.sin(angle)) - angle
        assert float(jnp.degrees(jnp.max(jnp.abs(error)))) < 0.01
    assert float(occupancy.bearing(jnp.float32(0), jnp.float32(0))) == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_masks_equal_plain_loops(seed):
    rng = np.random.default_rng(seed)
    shape, pose = (44, 60), rng.uniform([-1, -1, -4], [1, 1, 4]).astype(np.float32)
    points, valid = random_points(rng)
    origin = window(shape)
    hit, crossed = observed(
        PARAMS,
        shape,
        origin,
        RESOLUTION,
        jnp.asarray(pose),
        jnp.asarray(points),
        jnp.asarray(valid),
        36,
    )
    hit_, crossed_, unsure = masks_in_loops(shape, np.asarray(origin), pose, points, valid, n=36)
    assert not (np.asarray(hit & crossed)).any()
    assert (np.asarray(hit) == hit_).mean() > 0.999  # a point on a cell's edge may round either way
    sure = ~unsure & (np.asarray(hit) == hit_)
    np.testing.assert_array_equal(np.asarray(crossed)[sure], crossed_[sure])
    assert sure.mean() > 0.85 and crossed_.sum() > 50


def test_equals_octomap():
    """The same hits and misses through the OctoMap binding give the same log-odds, bit for bit."""
    rng = np.random.default_rng(0)
    shape = (24, 20)
    params = PARAMS._replace(blind_range=0.0)
    tree = pyoctomap.OcTree(RESOLUTION)
    origin = jnp.asarray([0.0, 0.0], jnp.float32)
    belief, seen = blank(shape)
    x, y = centres(shape, origin)
    for _ in range(40):
        pose = jnp.asarray(rng.uniform([0.5, 0.5, -3], [1.5, 1.9, 3]), jnp.float32)
        points = scan(box(0.25, 0.25, 1.75, 2.15), pose, LEVEL, noise=rng)
        args = (origin, RESOLUTION, pose, points, everything(points))
        hit, crossed = (np.asarray(m) for m in observed(params, shape, *args))
        belief, seen = occupancy.update(params, belief, seen, *args)
        for i, j in zip(*np.nonzero(hit | crossed), strict=True):
            tree.updateNode(np.array([x[i, j], y[i, j], 0.05]), bool(hit[i, j]))
    touched = 0
    for i, j in np.ndindex(shape):
        node = tree.search(np.array([x[i, j], y[i, j], 0.05]))
        assert (node is not None) == bool(seen[i, j])
        if node is not None:
            touched += 1
            # Both are float32; OctoMap rounds its constants once more.
            assert abs(node.getLogOdds() - float(belief[i, j])) < 2e-5
    assert touched > 150
    assert float(belief.max()) == pytest.approx(tree.getClampingThresMaxLog(), abs=1e-5)
    assert float(belief.min()) == pytest.approx(tree.getClampingThresMinLog(), abs=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_clears_what_is_in_sight_and_nothing_else(seed):
    rng = np.random.default_rng(seed)
    shape, segments = (120, 140), []
    for _ in range(8):
        at, size = rng.uniform(-6, 6, 2), rng.uniform(0.6, 1.5, 2)
        if np.abs(at).max() > 1.8:
            segments += box(*(at - size / 2), *(at + size / 2))
    pose = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(-3, 3)], np.float32)
    origin = window(shape)
    points = scan(segments, pose)
    _, crossed = observed(PARAMS, shape, origin, RESOLUTION, jnp.asarray(pose), points, everything(points))
    crossed = np.asarray(crossed)
    x, y = centres(shape, origin)
    # Each cell's own line of sight, in the continuous world.
    angle = np.arctan2(y - pose[1], x - pose[0]).ravel() - pose[2]
    distance = np.hypot(x - pose[0], y - pose[1])
    free = wall_distance(segments, pose, angle).reshape(shape)
    assert (distance < free)[crossed].all()
    # A margin and two neighbouring beams of caution hide little of what is in sight.
    wide = [wall_distance(segments, pose, angle + k).reshape(shape) for k in (-0.06, 0.06)]
    surely = distance < np.minimum(np.minimum(*wide), free) - 0.2
    assert crossed[surely].mean() > 0.98 and surely.sum() > 2000


def test_a_beam_that_met_nothing_clears_and_marks_nothing():
    shape, pose = (256, 256), jnp.zeros(3, jnp.float32)
    points = scan([(50, 50, 51, 51)], (0, 0, 0), LEVEL)
    belief, seen = occupancy.update(PARAMS, *blank(shape), window(shape), RESOLUTION, pose, points, everything(points))
    x, y = centres(shape, window(shape))
    disc = np.hypot(x, y) < MAX_RANGE - 0.2
    assert np.asarray(seen)[disc].all() and (np.asarray(belief)[disc] < 0).all()
    assert not np.asarray(seen)[np.hypot(x, y) > MAX_RANGE].any() and not bool((belief > 0).any())


def test_dropouts_clear_nothing():
    shape, pose = (100, 80), jnp.asarray([0.1, -0.2, 0.4], jnp.float32)
    origin = window(shape)
    points = scan(box(-3, -4, 3, 4), (0.1, -0.2, 0.4))
    args = (origin, RESOLUTION, pose)
    belief, seen = occupancy.update(PARAMS, *blank(shape), *args, points, jnp.zeros(len(points), bool))
    x, y = centres(shape, origin)
    body = np.hypot(x - 0.1, y + 0.2) < PARAMS.body_radius
    np.testing.assert_array_equal(np.asarray(seen), body)  # the robot stands there: that is known

    lost = np.tile((AZIMUTHS > 0.5) & (AZIMUTHS < 1.0), len(RINGS))
    bearings = np.mod(np.arctan2(y + 0.2, x - 0.1) - 0.4 + np.pi, 2 * np.pi) - np.pi
    sector = (bearings > 0.5) & (bearings < 1.0) & ~body
    valid = jnp.asarray(~lost)
    belief, seen = occupancy.update(PARAMS, *blank(shape), *args, points, valid)
    assert not np.asarray(seen)[sector].any() and bool(seen.any())
    # What is not finite is a dropout as well, and so is what comes from the robot's own body.
    for bad in (jnp.nan, jnp.inf, 0.01):
        broken = jnp.where(jnp.asarray(lost)[:, None], bad, points)
        again = occupancy.update(PARAMS, *blank(shape), *args, broken, everything(points))
        chex.assert_trees_all_equal(again, (belief, seen))
    # One ring that drops out changes nothing of what is clear: the others still end at the wall.
    level = jnp.asarray(np.repeat(np.abs(RINGS) > 0.02, 180))
    _, whole = occupancy.update(PARAMS, *blank(shape), *args, points, everything(points))
    _, partly = occupancy.update(PARAMS, *blank(shape), *args, points, level)
    np.testing.assert_array_equal(np.asarray(whole), np.asarray(partly))


def test_ground_and_overhead_mark_nothing():
    shape, pose = (80, 80), jnp.zeros(3, jnp.float32)
    origin = window(shape)
    ahead = np.abs(AZIMUTHS) < 0.2
    flat = np.where(ahead, 3.0, np.nan)

    def seen_ahead(z):
        points = np.stack([flat * np.cos(AZIMUTHS), flat * np.sin(AZIMUTHS), flat * 0 + z], -1)
        belief, seen = occupancy.update(
            PARAMS,
            *blank(shape),
            origin,
            RESOLUTION,
            pose,
            jnp.asarray(points, jnp.float32),
            jnp.ones(180, bool),
        )
        free = np.asarray(seen & (belief < 0))[40, 43:]  # along +x, beyond the robot's own cells
        return int((belief > 0).sum()), 0.3 + RESOLUTION * free.sum()

    marked, clear = seen_ahead(0.02)  # ground: clear up to the return
    assert marked == 0 and clear == pytest.approx(2.9, abs=0.11)
    marked, clear = seen_ahead(0.5)
    assert marked > 0 and clear == pytest.approx(2.9, abs=0.11)
    marked, clear = seen_ahead(0.5 + 1.4)  # overhead: leaves the band (0.7 m up) half way there
    assert marked == 0 and clear == pytest.approx(1.4, abs=0.11)


def drive(poses, scans, shape, origin, params=PARAMS):
    """The belief after a sequence of scans, in one compiled loop."""

    def tick(carry, data):
        pose, points = data
        valid = jnp.ones(points.shape[0], bool)
        return occupancy.update(params, *carry, origin, RESOLUTION, pose, points, valid), None

    run = jax.jit(lambda poses, scans: jax.lax.scan(tick, blank(shape), (poses, scans))[0])
    return run(jnp.asarray(poses, jnp.float32), jnp.stack(scans))


@pytest.mark.parametrize("offset", [0.0, 0.01, 0.05, 0.09])
def test_driving_along_a_wall_keeps_it_and_its_door(offset):
    """10 m along a thin wall with a door, noise 2 cm: no leak in the wall, none closed in the door.

    `offset`: where in its row of cells the wall's surface lies.
    """
    rng = np.random.default_rng(1)
    shape, y = (80, 256), 1.0 + offset
    origin = window(shape)
    segments = [(-12, -1.5, 12, -1.5), (-12, 3, 12, 3)]
    segments += box(-12, y, 1.0, y + 0.1) + box(2.0, y, 12, y + 0.1)
    poses = [(x, 0.0, 0.02 * math.sin(x)) for x in np.linspace(-5, 5, 200)]
    belief, seen = drive(poses, [scan(segments, p, noise=rng) for p in poses], shape, origin)
    belief = np.asarray(belief)
    x, ys = centres(shape, origin)
    row = int((y - float(origin[1])) / RESOLUTION)
    wall = belief[row - 1 : row + 2].max(0)  # noise may put an edge's returns in the next row
    driven = np.abs(x[0]) < 6.5
    door = (x[0] > 1.15) & (x[0] < 1.85)
    beside = (x[0] < 0.95) | (x[0] > 2.05)
    assert (wall[driven & beside] > 0).all(), "the wall has holes"
    if 0.03 < offset < 0.07:
        assert (belief[row][driven & beside] > 0).all()
    assert (belief[row - 2 : row + 3][:, door] < 0).all(), "the door has closed"
    lane = np.abs(ys[:, 0]) < 0.6
    assert (belief[lane][:, driven] < 0).all() and np.asarray(seen)[lane][:, driven].all()


def test_a_low_obstacle_is_not_forgotten_at_close_range():
    """At 0.6 m all rays pass over a box of 0.3 m: it must stay in the map while the robot waits."""
    rng = np.random.default_rng(0)
    shape = (60, 80)
    low = box(2.0, -0.5, 2.4, 0.5)
    poses = [(x, 0.0, 0.0) for x in np.linspace(0, 1.45, 30)] + [(1.45, 0.0, 0.0)] * 40
    scans = [scan(low, p, height=0.3, noise=rng) for p in poses]
    belief, _ = drive(poses, scans, shape, window(shape))
    x, y = centres(shape, window(shape))
    face = (np.abs(x - 2.05) < 0.01) & (np.abs(y) < 0.4)
    assert (np.asarray(belief)[face] > 0).all()


def test_contradiction_flips_a_saturated_cell_as_fast_as_the_clamp_says():
    params = PARAMS._replace(blind_range=0.0)
    pose, origin = jnp.zeros(3, jnp.float32), window((10, 12))
    hit, none = jnp.ones((10, 12), bool), jnp.zeros((10, 12), bool)
    step = jax.jit(lambda b, s, h, c: occupancy.apply(params, b, s, origin, 0.1, pose, h, c))

    def updates_until(sign, start, masks):
        belief, seen, n = jnp.full((10, 12), start, jnp.float32), hit, 0
        while not bool((belief * sign > 0).all()):
            belief, seen = step(belief, seen, *masks)
            n += 1
        return n

    to_free = updates_until(-1, params.l_max, (none, hit))
    assert to_free == math.floor(params.l_max / -params.miss) + 1 == 9
    to_occupied = updates_until(1, params.l_min, (hit, none))
    assert to_occupied == math.floor(-params.l_min / params.hit) + 1 == 3


def test_unknown_stays_unknown_and_values_stay_within_the_clamp():
    rng = np.random.default_rng(3)
    shape = (50, 70)
    belief, seen = blank(shape)
    for _ in range(30):
        points, valid = random_points(rng)
        pose = jnp.asarray(rng.uniform([-2, -2, -3], [2, 2, 3]), jnp.float32)
        before = seen
        belief, seen = occupancy.update(
            PARAMS,
            belief,
            seen,
            window(shape),
            RESOLUTION,
            pose,
            jnp.asarray(points),
            jnp.asarray(valid),
        )
        assert not bool((before & ~seen).any())
        assert not bool(((belief != 0) & ~seen).any()) and bool(jnp.isfinite(belief).all())
    assert float(belief.min()) >= PARAMS.l_min - 1e-6 and float(belief.max()) <= PARAMS.l_max + 1e-6


def test_batch_equals_loop_and_traces_once():
    rng = np.random.default_rng(5)
    shape, n = (40, 50), 4
    points, valid = (jnp.asarray(np.stack(a)) for a in zip(*[random_points(rng)] * n, strict=True))
    poses = jnp.asarray(rng.uniform([-1, -1, -3], [1, 1, 3], (n, 3)), jnp.float32)
    params = jax.tree.map(jnp.float32, PARAMS)
    once = chex.assert_max_traces(occupancy.update.__wrapped__, n=1)
    update = partial(jax.jit(once), params, *blank(shape), window(shape), jnp.float32(0.1))
    loop = [update(*a) for a in zip(poses, points, valid, strict=True)]
    update(poses[0] + 1, points[1], valid[2])
    batch = jax.jit(jax.vmap(partial(occupancy.update, params, *blank(shape), window(shape), jnp.float32(RESOLUTION))))(
        poses, points, valid
    )
    for i, (belief, seen) in enumerate(loop):
        np.testing.assert_array_equal(np.asarray(batch[1][i]), np.asarray(seen))
        np.testing.assert_allclose(np.asarray(batch[0][i]), np.asarray(belief), atol=1e-6)


def test_quarters_of_a_cell_follow_the_returns():
    """Of an occupied cell only the quarters into which returns fall are solid; before any fell, all of them."""
    returns = np.zeros((4, 6), np.float32)
    returns[2, 3] = 9.0  # cell (1, 1), its south-east quarter
    returns[3, 3] = 1.0  # a stray return: a tenth of the cell's
    surface = np.zeros((4, 6), np.float32)
    for _ in range(40):
        surface = np.asarray(occupancy.refine(jnp.asarray(surface), jnp.asarray(returns)))
    np.testing.assert_allclose(surface[2:4, 2:4], [[0.0, 0.9], [0.0, 0.1]], atol=1e-3)  # 0.8^40 of the start is left
    occupied = np.zeros((2, 3), bool)
    occupied[1, 1] = occupied[0, 2] = True
    fine = np.asarray(occupancy.fine_obstacles(PARAMS._replace(min_share=0.3), jnp.asarray(occupied), jnp.asarray(surface)))
    expected = np.zeros((4, 6), bool)
    expected[2, 3] = True
    expected[0:2, 4:6] = True
    np.testing.assert_array_equal(fine, expected)


def test_a_few_noisy_returns_before_a_wall_are_no_hit():
    """One return of ten in the cell before a wall's is noise of the range; the same one alone is an obstacle."""
    wall, stray = [[1.05, 0.05, 0.5]] * 10, [[0.95, 0.05, 0.5]]
    origin, pose = jnp.asarray([-2.0, -2.0], jnp.float32), jnp.zeros(3, jnp.float32)
    for points, expected in ((wall + stray, False), (stray, True)):
        cloud = jnp.asarray(points, jnp.float32)
        valid = jnp.ones(len(points), bool)
        hit, _ = observed(PARAMS, (40, 40), origin, 0.1, pose, cloud, valid)
        assert bool(hit[20, 29]) is expected
