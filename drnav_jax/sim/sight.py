"""What the rays of a pinhole camera meet in a world.

A camera at p with the rotation C (optical frame to world) sees through the pixel in row i and column j along

    d(i, j) = C ((j + 1/2 - cx) / fx, (i + 1/2 - cy) / fy, 1)                                   (1)

and what lies at p + t d is at the depth t along the optical axis. Of a level camera (no pitch, no roll) the horizontal
part of d depends on the column and the vertical one on the row, so `spans` costs one interval for each; a tilted one
needs an interval for each pixel. Solids out of view are skipped.

The first opaque surface of a ray is that of a solid, a map's wall, the ceiling, the ground, or, where the ground has a
drop, the drop's floor or far wall. In front of it lie veils (panes and plants), of which the two nearest are kept.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from drnav_jax.sim import spans
from drnav_jax.sim.field import wall_distance
from drnav_jax.types import CameraRig
from drnav_jax.worlds.world import WALL_HEIGHT, World

NEAR = 0.4  # [m] depth from which on a plant around the camera is seen
WALLS_END = 200.0  # [m] how far a map's walls are looked for


class Rays(NamedTuple):
    """Eq. 1 of one camera; `[1, w]` and `[h, 1]` if it is level, otherwise all `[h, w]`."""

    origin: Array  # [3] in the world
    dx: Array
    dy: Array
    dz: Array
    focal: Array  # [] pixels


class _Solids(NamedTuple):
    """Boxes, then cylinders, as the rays of one camera see them."""

    material: Array  # [N]
    in_view: Array  # [N] bool
    footprint: Callable[[Array], tuple[Array, Array]]  # n -> (entry, leave)
    heights: Callable[[Array], tuple[Array, Array]]  # n -> depths between which the rays are at its height


class Veil(NamedTuple):
    """A solid that a ray may pass: a pane or a plant."""

    depth: Array  # [h, w] where the ray enters; inf = no veil
    last: Array  # [h, w] where it leaves
    n: Array  # [h, w] which solid


class Hits(NamedTuple):
    """What the rays of one camera meet, `[h, w]`; n counts the rows of `shading.table_of`."""

    depth: Array
    n: Array
    painted: Array  # bool: n is paint on the ground
    first: Veil
    second: Veil


def rays_of(level: bool, shape: tuple[int, int], rig: CameraRig, pose: Array) -> Rays:
    """The rays of one camera (a rig without its first axis) at a pose of `base_link`."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = rig.position[0], rig.position[1]
    origin = jnp.stack([pose[0] + c * x - s * y, pose[1] + s * x + c * y, rig.position[2]])
    u = ((jnp.arange(shape[1], dtype=jnp.float32) + 0.5 - rig.centre[0]) / rig.focal[0])[None, :]
    v = ((jnp.arange(shape[0], dtype=jnp.float32) + 0.5 - rig.centre[1]) / rig.focal[1])[:, None]
    turn = rig.rotation
    if level:
        bx, by = (turn[k, 0] * u + turn[k, 2] for k in (0, 1))
        dz = turn[2, 1] * v
    else:
        bx, by, dz = (turn[k, 0] * u + turn[k, 1] * v + turn[k, 2] for k in range(3))
    return Rays(origin, c * bx - s * by, s * bx + c * by, _nonzero(dz), rig.focal[0])


def _nonzero(x: Array) -> Array:
    return jnp.where(jnp.abs(x) < 1e-9, 1e-9, x)


def _solids(level: bool, world: World, rays: Rays) -> _Solids:
    """Spans in units of depth: of all solids at once for a level camera, of one at a time for a tilted one."""
    height, shape = rays.origin[2], rays.dx.shape
    dx, dy = rays.dx.reshape(-1), rays.dy.reshape(-1)
    norm = jnp.maximum(jnp.sqrt(dx * dx + dy * dy), 1e-6)
    kinds = [(world.boxes, spans.box_spans), (world.cylinders, spans.cylinder_spans)]
    low = jnp.concatenate([rows[:, -2] for rows, _ in kinds]) - height
    high = jnp.concatenate([rows[:, -1] for rows, _ in kinds]) - height
    material = jnp.concatenate([world.box_surfaces.material, world.cylinder_surfaces.material])

    def run(rows: Array, of: Callable) -> tuple[Array, Array]:
        found = of(rows, height, rays.origin, dx / norm, dy / norm)
        return found.entry / norm[None], found.leave / norm[None]

    if level:
        parts = [run(rows, of) for rows, of in kinds]
        entry, leave = (jnp.concatenate(side) for side in zip(*parts, strict=True))
        a, b = low[:, None] / rays.dz[None, :, 0], high[:, None] / rays.dz[None, :, 0]
        above, below = jnp.minimum(a, b), jnp.maximum(a, b)
        return _Solids(
            material=material,
            in_view=jnp.any(leave > jnp.maximum(entry, 0.0), axis=1),
            footprint=lambda n: (entry[n][None, :], leave[n][None, :]),
            heights=lambda n: (above[n][:, None], below[n][:, None]),
        )
    inverse, num_boxes = 1 / rays.dz, len(world.boxes)

    def footprint(n: Array) -> tuple[Array, Array]:
        if 0 < num_boxes < len(material):
            box = functools.partial(run, world.boxes[jnp.minimum(n, num_boxes - 1)][None], spans.box_spans)
            post = functools.partial(run, world.cylinders[jnp.maximum(n - num_boxes, 0)][None], spans.cylinder_spans)
            entry, leave = jax.lax.cond(n < num_boxes, box, post)
        else:
            rows, of = kinds[0] if num_boxes else kinds[1]
            entry, leave = run(rows[n][None], of)
        return entry.reshape(shape), leave.reshape(shape)

    def heights(n: Array) -> tuple[Array, Array]:
        a, b = low[n] * inverse, high[n] * inverse
        return jnp.minimum(a, b), jnp.maximum(a, b)

    return _Solids(material, _in_cone(world, rays, low, high), footprint, heights)


def _in_cone(world: World, rays: Rays, low: Array, high: Array) -> Array:
    """Whether the ball around each solid touches the cone around the image, `[N]`."""
    d = jnp.stack([rays.dx, rays.dy, rays.dz])
    d = d / jnp.sqrt(jnp.sum(d * d, axis=0))[None]
    axis = jnp.sum(d, axis=(1, 2))
    axis = axis / jnp.sqrt(jnp.sum(axis * axis))
    half = jnp.arccos(jnp.clip(jnp.min(jnp.sum(axis[:, None, None] * d, axis=0)), -1.0, 1.0)) + 0.02
    centre = jnp.concatenate([world.boxes[:, :2], world.cylinders[:, :2]]) - rays.origin[None, :2]
    reach = jnp.concatenate([jnp.hypot(world.boxes[:, 3], world.boxes[:, 4]), world.cylinders[:, 2]])
    to = jnp.concatenate([centre, (0.5 * (low + high))[:, None]], axis=1)
    radius, away = jnp.hypot(reach, 0.5 * (high - low)), jnp.sqrt(jnp.sum(to * to, axis=1))
    angle = jnp.arccos(jnp.clip(jnp.sum(to * axis[None], axis=1) / jnp.maximum(away, 1e-6), -1.0, 1.0))
    return (away <= radius) | (angle - jnp.arcsin(jnp.clip(radius / jnp.maximum(away, 1e-6), 0.0, 1.0)) < half)


def meet(level: bool, world: World, rays: Rays, shape: tuple[int, int]) -> Hits:
    """The first opaque surface of each ray, the paint on it and the two nearest veils before it."""
    solids = _solids(level, world, rays)
    height, dz, num = rays.origin[2], jnp.broadcast_to(rays.dz, shape), len(solids.material)
    never, none = jnp.full(shape, jnp.inf, jnp.float32), jnp.full(shape, num, jnp.int32)
    opaque, veils, drops, flat = (
        jnp.asarray(kind)[solids.material] & solids.in_view
        for kind in (spans.OPAQUE, spans.VEILS, spans.DROPS, spans.FLAT)
    )

    def interval(n: Array) -> tuple[Array, Array]:
        entry, leave = solids.footprint(n)
        above, below = solids.heights(n)
        return jnp.maximum(entry, above), jnp.minimum(leave, below)

    def nearer(n: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        met, which = carry
        first, last = interval(n)
        hit = (first < last) & (last > 0) & (first < met)
        return jnp.where(hit, jnp.where(first < 0, last, first), met), jnp.where(hit, n, which)  # from within: the far side

    def veiled(n: Array, carry: tuple[Veil, Veil]) -> tuple[Veil, Veil]:
        one, two = carry
        first, last = interval(n)
        first = jnp.maximum(first, NEAR)
        new = Veil(jnp.where(first < last, first, jnp.inf), last, jnp.broadcast_to(n, shape))
        before, between = new.depth < one.depth, new.depth < two.depth
        two = Veil(*(jnp.where(before, a, jnp.where(between, b, c)) for a, b, c in zip(one, new, two, strict=True)))
        return Veil(*(jnp.where(before, a, b) for a, b in zip(new, one, strict=True))), two

    def painted(n: Array, which: Array) -> Array:
        entry, leave = solids.footprint(n)
        return jnp.where((entry < ground) & (ground < leave), n, which)

    ground = jnp.where(dz < 0, -height / dz, jnp.inf)
    end, drop = spans.down_drops(ground, drops, solids.footprint, lambda n: solids.heights(n)[1])
    paint = spans.each(flat, painted, none)
    depth, n = spans.each(opaque, nearer, (never, none + 3))
    no_veil = Veil(never, never, none)
    first, second = spans.each(veils, veiled, (no_veil, no_veil))

    ceiling = jnp.where(dz > 0, (world.scenery.ceiling - height) / dz, jnp.inf)
    on_ground = jnp.where(drop >= 0, drop, paint)
    candidates = [(end, on_ground), (ceiling, none + 2)]
    if world.field.values.size:
        candidates.append((_walls(world, rays, shape), none + 1))
    for at, what in candidates:
        depth, n = jnp.minimum(depth, at), jnp.where(at < depth, what, n)
    return Hits(depth, n, (n == on_ground) & (drop < 0) & (depth == end), first, second)


def _walls(world: World, rays: Rays, shape: tuple[int, int]) -> Array:
    """Depth of a map's wall on each ray, `[h, w]`; inf where there is none, or the ray passes over it."""
    dx, dy = rays.dx.reshape(-1), rays.dy.reshape(-1)
    norm = jnp.maximum(jnp.sqrt(dx * dx + dy * dy), 1e-6)
    far = wall_distance(world.field, rays.origin[:2], dx / norm, dy / norm, WALLS_END) / norm
    far = far.reshape(rays.dx.shape)
    return jnp.broadcast_to(jnp.where(rays.origin[2] + far * rays.dz > WALL_HEIGHT, jnp.inf, far), shape)
