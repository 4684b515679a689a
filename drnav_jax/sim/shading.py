"""Colours of what a camera's rays meet.

The colour of an opaque surface is albedo (`textures`) x light, a mirror image of the sky on what shines, and fog over
the range r,

    light = ambient + (1 - ambient) max(n . sun, 0),    colour = air + (surface - air) exp(-fog r) (1)

with less light in the corner above the floor and down a pit. A pane mixes its sheen over what is behind it. A plant is
met where its foliage is thick enough for the way l that the ray has in it,

    -log(thickness) < k l                                                                       (2)

with k the material's extinction and the thickness a random pattern in space, less towards edges and top: plants have
ragged outlines, and grass lets a bit of the background through.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from drnav_jax.geometry import sample_bilinear
from drnav_jax.grids import once
from drnav_jax.sim import textures
from drnav_jax.sim.sight import Hits, Rays, Veil
from drnav_jax.sim.textures import CEILING, LOOKS, SKY, Face
from drnav_jax.worlds.materials import EXTINCTION, Material
from drnav_jax.worlds.world import WALL_HEIGHT, Scenery, World

WHITE = 1.2  # [] light of eq. 1 at which white is just white
HAZE = 0.002  # [1/m] extinction of clear air: the ground fades into the horizon

# Columns of `shading.table_of`; those of `textures.LOOKS` follow.
_CX, _CY, _COS, _SIN, _HX, _HY, _LOW, _HIGH, _R, _G, _B, _MATERIAL, _KIND, _LOOK = range(14)
_BOX, _POST, _PLANE, _WALL = range(4)


def table_of(world: World) -> Array:
    """What shading needs to know of each solid, then of the ground, the map's walls, the ceiling and the sky."""
    scenery, boxes, posts = world.scenery, world.boxes, world.cylinders

    def rows(shape: Array, colour: Array, material: Array, kind: int) -> Array:
        looks = jnp.asarray(LOOKS)[material]
        named = jnp.stack([material.astype(jnp.float32), jnp.full(len(material), kind, jnp.float32)], axis=1)
        return jnp.concatenate([shape, colour, named, looks], axis=1)

    b, c, unit, zero = boxes.T, posts.T, jnp.ones(len(posts), jnp.float32), jnp.zeros(len(posts), jnp.float32)
    of_boxes = jnp.stack([b[0], b[1], jnp.cos(b[2]), jnp.sin(b[2]), b[3], b[4], b[5], b[6]], axis=1)
    of_posts = jnp.stack([c[0], c[1], unit, zero, c[2], c[2], c[3], c[4]], axis=1)
    plane = jnp.asarray([[0, 0, 1, 0, 1e3, 1e3, 0, WALL_HEIGHT]], jnp.float32)
    rest = [
        (scenery.ground_colour, scenery.ground_material, _PLANE), (scenery.wall_colour, scenery.wall_material, _WALL),
        (scenery.ceiling_colour, CEILING, _PLANE), (scenery.sky_colour, SKY, _PLANE),
    ]  # fmt: skip
    return jnp.concatenate([
        rows(of_boxes, world.box_surfaces.colour, world.box_surfaces.material, _BOX),
        rows(of_posts, world.cylinder_surfaces.colour, world.cylinder_surfaces.material, _POST),
        *(rows(plane, colour[None], jnp.asarray(material, jnp.int32)[None], kind) for colour, material, kind in rest),
    ])  # fmt: skip


def _wall_face(world: World, rays: Rays, depth: Array) -> tuple[Array, Array, Array]:
    """Normal of a map's wall and the way along it, at a depth."""
    x, y = rays.origin[0] + depth * rays.dx, rays.origin[1] + depth * rays.dy
    step = 0.5 * world.field.resolution
    a, b = (
        sample_bilinear(world.field, jnp.stack([x + sx, y + sy], axis=-1))
        - sample_bilinear(world.field, jnp.stack([x - sx, y - sy], axis=-1))
        for sx, sy in ((step, 0.0), (0.0, step))
    )
    norm = jnp.maximum(jnp.sqrt(a * a + b * b), 1e-6)
    a, b = a / norm, b / norm
    return a, b, jnp.where(jnp.abs(a) > jnp.abs(b), y, x)


class _Point(NamedTuple):
    """Where the rays meet, in the world and in the frame of what they meet; all `[h, w]`."""

    x: Array
    y: Array
    z: Array
    along: Array
    across: Array


def _point(row: Callable[[int], Array], rays: Rays, depth: Array) -> _Point:
    x, y, z = (rays.origin[k] + depth * d for k, d in enumerate((rays.dx, rays.dy, rays.dz)))
    ax, ay = x - row(_CX), y - row(_CY)
    return _Point(x, y, z, row(_COS) * ax + row(_SIN) * ay, row(_COS) * ay - row(_SIN) * ax)


def _face(
    row: Callable[[int], Array], world: World, rays: Rays, at: _Point, depth: Array, painted: Array
) -> tuple[Face, tuple[Array, Array, Array], Array]:
    """The face that is met, its unit normal towards the camera, and the cosine to the ray."""
    qx, qy = jnp.abs(at.along) - row(_HX), jnp.abs(at.across) - row(_HY)
    qz = jnp.maximum(row(_LOW) - at.z, at.z - row(_HIGH))
    kind = row(_KIND)
    upright = (qz < jnp.maximum(qx, qy)) & (kind != _PLANE) & ~painted
    on_end = qx > qy
    u = jnp.where(upright & on_end, at.across, at.along)
    v = jnp.where(upright, at.z - row(_LOW), at.across)
    half = jnp.where(upright & on_end, row(_HY), row(_HX))
    nx, ny = jnp.where(on_end, row(_COS), -row(_SIN)), jnp.where(on_end, row(_SIN), row(_COS))
    if len(world.cylinders):
        post, r = kind == _POST, jnp.maximum(row(_HX), 1e-6)
        ex, ey = at.along / r, at.across / r
        away = jnp.sqrt(ex * ex + ey * ey)
        round_face = post & ((away - 1) * r > qz)
        upright = jnp.where(post, round_face, upright)
        u = jnp.where(round_face, jnp.arctan2(ey, ex) * r, u)
        v = jnp.where(round_face, at.z - row(_LOW), v)
        half = jnp.where(post, 1e3, half)
        nx, ny = jnp.where(post, ex / away, nx), jnp.where(post, ey / away, ny)
    if world.field.values.size:
        wall = kind == _WALL
        a, b, way = _wall_face(world, rays, jnp.where(jnp.isfinite(depth), depth, 0.0))
        nx, ny, u = jnp.where(wall, a, nx), jnp.where(wall, b, ny), jnp.where(wall, way, u)
        v, upright, half = jnp.where(wall, at.z, v), upright | wall, jnp.where(wall, 1e3, half)
    nx, ny, nz = jnp.where(upright, nx, 0.0), jnp.where(upright, ny, 0.0), jnp.where(upright, 0.0, 1.0)
    facing = nx * rays.dx + ny * rays.dy + nz * rays.dz
    sign = jnp.where(facing > 0, -1.0, 1.0)
    cosine = jnp.abs(facing) / jnp.sqrt(rays.dx * rays.dx + rays.dy * rays.dy + rays.dz * rays.dz)
    face = Face(
        material=row(_MATERIAL).astype(jnp.int32), u=u, v=v, half=half, top=row(_HIGH) - row(_LOW), upright=upright,
        side=on_end == (row(_HY) > row(_HX)), pixel=depth / rays.focal / jnp.maximum(cosine, 0.12),
    )  # fmt: skip
    return face, (sign * nx, sign * ny, sign * nz), cosine


Colour = tuple[Array, Array, Array]


def _mix(a: Colour, b: Colour, share: Array) -> Colour:
    return a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share, a[2] + (b[2] - a[2]) * share


def _sky(scenery: Scenery, up: Array) -> tuple[Colour, Colour]:
    """Colour of the sky in directions of this sine of elevation, and of the air at the horizon."""
    sky = tuple(scenery.sky_colour[k] for k in range(3))
    air = tuple(0.5 * c + 0.45 for c in sky)
    share = jnp.clip(3.0 * up, 0.0, 1.0)
    return tuple(a + (c - a) * share for a, c in zip(air, sky, strict=True)), air  # pyright: ignore[reportReturnType]


def surface_colour(world: World, table: Array, rays: Rays, hits: Hits) -> Colour:
    """Colour of the first opaque surfaces, `[h, w]` for each channel."""
    scenery, rows = world.scenery, once(jnp.take(table.T, hits.n, axis=1, mode="clip"))
    sky = jnp.isinf(hits.depth)
    depth = jnp.where(sky, 1.0, hits.depth)

    def row(k: int) -> Array:
        return rows[k]

    length = jnp.sqrt(rays.dx * rays.dx + rays.dy * rays.dy + rays.dz * rays.dz)
    at = _point(row, rays, depth)
    face, (nx, ny, nz), _ = once(_face(row, world, rays, at, depth, hits.painted))
    gain, dark, light = once(textures.paint(face, lambda k: row(_LOOK + k), scenery.texture_seed))
    own = gain * row(_R), gain * row(_G), gain * row(_B)
    own = _mix(own, (row(_LOOK), row(_LOOK + 1), row(_LOOK + 2)), dark)
    lamp = (row(_LOOK + 3), row(_LOOK + 4), row(_LOOK + 5))
    own = _mix(own, lamp, light)
    sun = scenery.sun
    lit = scenery.ambient + (1 - scenery.ambient) * jnp.maximum(nx * sun[0] + ny * sun[1] + nz * sun[2], 0.0)
    lit = jnp.where(row(_MATERIAL) == CEILING, 0.3 + 0.5 * scenery.ambient + light, lit)  # lamps shine
    corner = jnp.where(face.upright, 0.72 + 0.28 * jnp.clip(at.z / 0.4, 0.0, 1.0), 1.0)
    up = rays.dz / length
    clear = jnp.exp(-(scenery.fog + HAZE) * depth * length)
    lit, clear = once((WHITE * lit * corner * jnp.exp(1.1 * jnp.minimum(at.z, 0.0)), clear))
    above, air = _sky(scenery, up)
    mirror = 0.3 + 0.6 * jnp.clip(0.5 + 4.0 * up, 0.0, 1.0)
    own = _mix((own[0] * lit, own[1] * lit, own[2] * lit), (mirror, mirror, mirror), row(_LOOK + 12) * (1 - light))
    own = _mix(air, own, clear)
    return _mix(own, above, sky.astype(jnp.float32))


def veil_colour(world: World, table: Array, rays: Rays, veil: Veil, behind: Array, under: Colour) -> Colour:
    """What a veil makes of the colour behind it, whose surface lies at a depth."""
    scenery, rows = world.scenery, once(jnp.take(table.T, veil.n, axis=1, mode="clip"))

    def row(k: int) -> Array:
        return rows[k]

    seen = veil.depth < behind
    depth = jnp.where(seen, veil.depth, 1.0)
    last = jnp.minimum(jnp.where(seen, veil.last, 1.0), behind)
    length = jnp.sqrt(rays.dx * rays.dx + rays.dy * rays.dy + rays.dz * rays.dz)
    at, mid = _point(row, rays, depth), _point(row, rays, 0.5 * (depth + last))
    face, _, cosine = _face(row, world, rays, at, depth, jnp.zeros_like(seen))
    material = face.material
    grass = material == Material.GRASS
    # Towards the edges and the top a plant thins out.
    side = jnp.where(
        row(_KIND) == _POST,
        row(_HX) - jnp.sqrt(mid.along * mid.along + mid.across * mid.across),
        jnp.minimum(row(_HX) - jnp.abs(mid.along), row(_HY) - jnp.abs(mid.across)),
    )
    tall = row(_HIGH) - row(_LOW)
    margin = jnp.minimum(0.35, 0.6 * jnp.minimum(row(_HX), row(_HY)))
    thin = jnp.clip(1 - side / margin, 0.0, 1.0)
    thin = jnp.maximum(thin, jnp.clip(1 - (row(_HIGH) - mid.z) / (jnp.where(grass, 0.45, 0.25) * tall), 0.0, 1.0))
    bush = textures.leaves(face.u + row(_CX), face.v + row(_CY), scenery.texture_seed)
    blade = textures.blades(at.x, at.y, at.z, scenery.texture_seed)
    thick = jnp.where(grass, blade[0], bush[0]) - textures.SPARSE * thin - 0.1
    bright = jnp.where(grass, blade[1], bush[1])
    needed = -jnp.log(jnp.maximum(thick, 1e-4)) / jnp.maximum(jnp.asarray(EXTINCTION)[material], 1e-3)
    met = jnp.clip(((last - depth) * length - needed) / 0.04 + 0.5, 0.0, 1.0)
    lit = scenery.ambient + (1 - scenery.ambient) * jnp.maximum(scenery.sun[2], 0.0) * 0.8
    lit = WHITE * lit * bright * (1 - 0.45 * jnp.clip(needed / 0.35, 0.0, 1.0))
    plant = (row(_R) * lit, row(_G) * lit, row(_B) * lit)

    up = rays.dz / length
    trim, sheen = textures.pane(face, scenery.texture_seed)
    mirror = 0.4 + 0.5 * jnp.clip(0.5 + 3.0 * up, 0.0, 1.0)
    shine = jnp.clip(0.08 + 0.7 * (1 - cosine) ** 5 + sheen, 0.0, 0.9)
    tinted = tuple(a * (0.35 + 0.55 * row(k)) for a, k in zip(under, (_R, _G, _B), strict=True))
    glass = _mix(tinted, (mirror, mirror, mirror), shine)  # pyright: ignore[reportArgumentType]
    glass = _mix(glass, (0.12 * lit, 0.12 * lit, 0.13 * lit), trim)

    _, air = _sky(scenery, up)
    clear = jnp.exp(-(scenery.fog + HAZE) * depth * length)
    pane = material == Material.GLASS
    solid = _mix(air, plant, clear)
    share = jnp.where(seen, jnp.where(pane, 1.0, met), 0.0)
    return _mix(under, tuple(jnp.where(pane, a, b) for a, b in zip(glass, solid, strict=True)), share)  # pyright: ignore[reportArgumentType]
