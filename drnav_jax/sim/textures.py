"""Procedural textures: what the surfaces of each material look like, per pixel and without an image.

A texture is drawn in metres on its face: u to the side from the face's middle, v up from its lower edge (on level faces
both are level). It says how the surface's own colour is changed,

    albedo = mix(mix(gain colour, dark, m_dark), light, m_light)                               (1)

with the dark and the light of its material (mortar, tyres, lamps). Lines and bands are drawn by the share of the pixel
that they cover, and what repeats within one pixel fades to its mean, so that far walls do not flicker.

Every pixel of an image evaluates every texture and keeps one: on a CPU that is cheaper than to branch. The random
patterns, which cost most, are shared: each material only says how fine they are.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from drnav_jax.grids import once
from drnav_jax.types import Scalar
from drnav_jax.worlds.materials import Material

CEILING, SKY = len(Material), len(Material) + 1  # what only a camera sees; they follow the materials
SPARSE = 0.35  # [] where vegetation is ragged: of its noise, the share that lets light through


class Face(NamedTuple):
    """Where each pixel's ray meets a surface; all `[h, w]`."""

    material: Array  # int
    u: Array  # to the side, from the middle [m]
    v: Array  # up from the lower edge [m]
    half: Array  # half the width of the face [m]; inf = no edges
    top: Array  # height of the face [m]
    upright: Array  # bool: a wall, not a floor
    side: Array  # bool: a long side of its box (of a car: with wheels)
    pixel: Array  # width of the pixel on the surface [m]


class Look(NamedTuple):
    """One material: eq. 1's dark and light, and how fine and how strong its two random patterns are."""

    dark: tuple[float, float, float] = (0.1, 0.1, 0.1)
    light: tuple[float, float, float] = (1.0, 1.0, 1.0)
    coarse: tuple[float, float, float] = (1.2, 1.2, 0.06)  # patches per metre in u and in v, strength
    fine: tuple[float, float, float] = (9.0, 9.0, 0.05)
    shine: float = 0.0  # share of the light that is a mirror image of the sky


_LOOKS: dict[int, Look] = {
    Material.WALL: Look(dark=(0.3, 0.3, 0.3)),
    Material.BRICK: Look(light=(0.72, 0.69, 0.64), fine=(22.0, 22.0, 0.12)),
    Material.WOOD: Look(dark=(0.16, 0.09, 0.05), light=(0.85, 0.82, 0.7), coarse=(13.0, 0.6, 0.14), fine=(45.0, 1.5, 0.2)),
    Material.METAL: Look(dark=(0.07, 0.07, 0.08), light=(1.0, 0.75, 0.3), fine=(70.0, 0.6, 0.12), shine=0.35),
    Material.CONCRETE: Look(dark=(0.2, 0.2, 0.2), coarse=(1.6, 1.6, 0.16), fine=(14.0, 14.0, 0.1)),
    Material.CAR: Look(dark=(0.05, 0.06, 0.08), coarse=(1.0, 1.0, 0.0), fine=(1.0, 1.0, 0.0), shine=0.18),
    Material.STRIPE: Look(dark=(0.05, 0.05, 0.05), fine=(12.0, 12.0, 0.12)),
    Material.DROP: Look(dark=(0.02, 0.02, 0.02), coarse=(1.6, 1.6, 0.2), fine=(14.0, 14.0, 0.12)),
    Material.TILES: Look(dark=(0.3, 0.3, 0.3)),
    Material.CARPET: Look(coarse=(2.0, 2.0, 0.08), fine=(60.0, 60.0, 0.25)),
    Material.ASPHALT: Look(coarse=(0.8, 0.8, 0.15), fine=(40.0, 40.0, 0.22)),
    Material.LAWN: Look(coarse=(2.5, 2.5, 0.35), fine=(18.0, 18.0, 0.35)),
    Material.GRAVEL: Look(coarse=(3.0, 3.0, 0.15), fine=(20.0, 20.0, 0.45)),
    CEILING: Look(dark=(0.45, 0.45, 0.45), fine=(25.0, 25.0, 0.06)),
    SKY: Look(coarse=(1.0, 1.0, 0.0), fine=(2.6, 2.6, 0.0)),
}
_ROWS = [_LOOKS.get(k, Look()) for k in range(SKY + 1)]
LOOKS = np.array([[*r.dark, *r.light, *r.coarse, *r.fine, r.shine] for r in _ROWS], np.float32)  # [M, 13]


def hashed(x: Array, y: Array, seed: Scalar) -> Array:
    """A random number in [0, 1) for each pair of whole numbers x, y (given as floats)."""
    n = x.astype(jnp.int32).astype(jnp.uint32) * jnp.uint32(0x27D4EB2D)
    n = (n ^ (n >> 15)) + y.astype(jnp.int32).astype(jnp.uint32) * jnp.uint32(0x9E3779B1)
    n = n + jnp.asarray(seed, jnp.int32).astype(jnp.uint32) * jnp.uint32(0x85EBCA6B)
    n = (n ^ (n >> 16)) * jnp.uint32(0xC2B2AE35)
    n = (n ^ (n >> 13)) * jnp.uint32(0x27D4EB2F)
    return (n >> 8).astype(jnp.int32).astype(jnp.float32) * (1.0 / 2**24)


def noise(x: Array, y: Array, seed: Scalar) -> Array:
    """Smooth random pattern in 0..1 with one bump per unit."""
    left, low = jnp.floor(x), jnp.floor(y)
    ax, ay = x - left, y - low
    ax, ay = ax * ax * (3 - 2 * ax), ay * ay * (3 - 2 * ay)
    a, b = hashed(left, low, seed), hashed(left + 1, low, seed)
    c, d = hashed(left, low + 1, seed), hashed(left + 1, low + 1, seed)
    return (a + (b - a) * ax) * (1 - ay) + (c + (d - c) * ax) * ay


def _drawn(seed: Scalar, what: int) -> Array:
    """One random number in [0, 1) for the whole world."""
    whole = jnp.asarray(seed, jnp.int32).astype(jnp.float32)
    return hashed(whole, whole, what)


def _share(x: Array) -> Array:
    return jnp.clip(x, 0.0, 1.0)


def _lines(x: Array, period: Scalar, width: float, pixel: Array) -> Array:
    """Share of the pixel that lines at the multiples of `period` cover."""
    away = jnp.abs(x - period * jnp.round(x / period))
    sharp = _share((0.5 * width - away) / pixel + 0.5)
    return sharp + (width / period - sharp) * _share(2 * pixel / period - 0.5)


def _band(x: Array, low: Scalar, high: Scalar, pixel: Array) -> Array:
    """Share of the pixel between two values of x."""
    return _share((x - low) / pixel + 0.5) * _share((high - x) / pixel + 0.5)


def _only(where: Array, share: Array) -> Array:
    return jnp.where(where, share, 0.0)


def _disc(x: Array, y: Array, radius: float, pixel: Array) -> Array:
    return _share((radius - jnp.sqrt(x * x + y * y)) / pixel + 0.5)


def _all(*shares: Array) -> Array:
    """Covered by any of several shapes: 1 - the product of what each leaves free."""
    free = 1.0
    for share in shares:
        free = free * (1 - share)
    return jnp.asarray(1 - free)


Pattern = tuple[Array, Array, Array]  # gain, m_dark, m_light


def _brick(face: Face, seed: Scalar) -> Pattern:
    course = 0.11 * (0.8 + 0.6 * _drawn(seed, 3))  # [m] height of a course, of the whole world
    length = 2.8 * course
    row = jnp.floor(face.v / course)
    x = face.u + 0.5 * length * (row - 2 * jnp.floor(row / 2))
    tone = hashed(jnp.floor(x / length), row, seed) - 0.5
    joint = _all(_lines(x, length, 0.022, face.pixel), _lines(face.v, course, 0.022, face.pixel))
    return 1.0 + 0.5 * tone * _share(1.5 - face.pixel / course), jnp.zeros_like(joint), 0.85 * joint


def _wood(face: Face, seed: Scalar) -> Pattern:
    board = jnp.floor(face.u / 0.2 + 0.5)
    tone = hashed(board, board, seed) - 0.5
    door = (face.half > 0.3) & (face.half < 0.75) & (face.top > 1.7) & face.upright
    rim = _share((0.06 - face.half + jnp.abs(face.u)) / face.pixel + 0.5)
    edge = _all(rim, _band(face.v, face.top - 0.06, 9.0, face.pixel))
    inset = jnp.abs(jnp.abs(face.u) - face.half + 0.18) < jnp.maximum(0.012, 0.4 * face.pixel)
    inset = inset & (face.v > 0.2) & (face.v < face.top - 0.2)
    handle = _band(face.u, face.half - 0.17, face.half - 0.07, face.pixel) * _band(face.v, 0.96, 1.06, face.pixel)
    of_door = jnp.maximum(_only(inset, jnp.full_like(edge, 0.5)), 0.55 * edge)
    joints = jnp.where(door, of_door, 0.7 * _lines(face.u + 0.1, 0.2, 0.014, face.pixel))
    return 1.0 + jnp.where(door, 0.0, 0.4 * tone), joints, jnp.where(door, handle, 0.0)


def _metal(face: Face) -> Pattern:
    # Two leaves that meet in a seam, a dark frame, and a panel with two lit buttons on the frame: a lift.
    x, door = jnp.abs(face.u), (face.half > 0.4) & (face.half < 1.8) & (face.top > 1.6) & face.upright
    seam = _band(face.u, -0.018, 0.018, face.pixel)
    frame = _all(_share((x - face.half + 0.1) / face.pixel + 0.5), _band(face.v, face.top - 0.12, 9.0, face.pixel))
    frame = _all(frame, 0.5 * _band(x, face.half - 0.16, face.half, face.pixel))
    centre = face.half - 0.13
    panel = _band(face.u, centre - 0.07, centre + 0.07, face.pixel) * _band(face.v, 0.95, 1.3, face.pixel)
    button = _all(*(_disc(face.u - centre, face.v - at, 0.035, face.pixel) for at in (1.05, 1.2)))
    dark = _all(seam, 0.7 * frame, 0.9 * panel)
    return 1.0 - 0.12 * _share((x - 0.06) / -0.1 + 0.6), jnp.where(door, dark, 0.0), jnp.where(door, button, 0.0)


def _car(face: Face) -> Pattern:
    # One box is a whole car, or its body (low) or its cabin (short): windows lie in the upper part of what is tall.
    x, pixel, half, top = jnp.abs(face.u), face.pixel, face.half, face.top
    tall, side, front = top > 0.75, face.side, ~face.side
    sill = top * jnp.where(top > 1.1, 0.56, jnp.where(tall, 9.0, 0.15))
    lean = _only(side, 0.9 * (face.v - sill))  # the panes lean in
    inner = half - jnp.where(side, 0.18 * half, 0.12) - lean
    pillars = _only(side, _all(*(_band(face.u, at - 0.05, at + 0.05, pixel) for at in (-0.25, 0.55))))
    panes = _band(face.v, sill, 0.9 * top, pixel) * _share((inner - x) / pixel + 0.5) * (1 - pillars)
    tyre, hub = (_only(side & tall, _disc(x - 0.62 * half, face.v - 0.3, r, pixel)) for r in (0.33, 0.17))
    below = _only(tall, _band(face.v, -1.0, 0.2, pixel))
    lamp = _only(front & tall, _band(x, half - 0.4, half - 0.1, pixel) * _band(face.v, 0.6, 0.75, pixel))
    plate = _only(front & tall, _band(x, -1.0, 0.26, pixel) * _band(face.v, 0.38, 0.5, pixel))
    seam = _only(side, 0.6 * _lines(face.u, 0.75, 0.02, pixel) * _band(face.v, 0.25, sill, pixel))
    level = _band(x, -1.0, half - 0.15, pixel)  # the roof: a rim, and lighter
    return (
        jnp.where(face.upright, 1.0, 0.9 + 0.2 * level),
        _only(face.upright, _all(panes, tyre, 0.85 * below, seam)),
        _only(face.upright, _all(0.55 * hub, lamp, 0.8 * plate)),
    )


def _floor(face: Face, edge: float, joint: float, seed: Scalar) -> tuple[Array, Array]:
    """Square plates: random tone of each around 0, and the joints between them."""
    tone = hashed(jnp.floor(face.u / edge), jnp.floor(face.v / edge), seed) - 0.5
    return tone * _share(1.5 - face.pixel / edge), _all(
        _lines(face.u, edge, joint, face.pixel), _lines(face.v, edge, joint, face.pixel)
    )


def paint(face: Face, look: Callable[[int], Array], seed: Scalar) -> tuple[Array, Array, Array]:
    """Eq. 1 for each pixel: gain, m_dark and m_light `[h, w]`.

    Args:
        face: Where the rays meet surfaces.
        look: Column k of the rows of `LOOKS` of each pixel's material, `[h, w]`.
        seed: Of the world [] int.
    """
    n1 = noise(face.u * look(6), face.v * look(7), seed) - 0.5
    n2 = noise(face.u * look(9) + 31.0, face.v * look(10), seed) - 0.5
    fade1, fade2 = (_share(1.5 - face.pixel * jnp.maximum(look(k), look(k + 1))) for k in (6, 9))
    # What is too fine for the pixel still leaves some grain.
    spots = once(2 * n1 * look(8) * fade1 + 2 * n2 * look(11) * jnp.maximum(fade2, 0.25))
    wall, none = face.upright, jnp.zeros_like(spots)
    plate, joint = _floor(face, 0.4, 0.016, seed)
    panel, gap = _floor(face, 0.6, 0.03, seed)
    lamp = (_cell(face.u / 0.6, 3) & _cell(face.v / 0.6, 2)).astype(jnp.float32)
    slab = _only(wall, _all(_lines(face.u, 1.2, 0.02, face.pixel), _lines(face.v, 1.2, 0.02, face.pixel)))
    skirting = _only(wall, 0.45 * _band(face.v, -1.0, 0.1, face.pixel))
    slant = jnp.sin((face.u + face.v) * (np.pi / 0.22))  # black where > 0
    patterns: dict[int, Pattern] = {
        Material.WALL: (none + 1, skirting, none),
        Material.BRICK: _brick(face, seed),
        Material.WOOD: _wood(face, seed),
        Material.METAL: _metal(face),
        Material.CONCRETE: (none + 1, 0.5 * slab, none),
        Material.CAR: _car(face),
        Material.STRIPE: (none + 1, _share(0.5 + slant * 0.07 / face.pixel), none),
        Material.DROP: (none + 1, 0.5 * slab, none),
        Material.TILES: (1 + 0.16 * plate, 0.6 * joint, none),
        Material.CARPET: (1 + 0.1 * panel, none, none),
        CEILING: (1 + 0.04 * panel, 0.5 * gap, lamp),
    }
    gain, dark, light = none + 1, none, none
    for material, pattern in patterns.items():
        here = face.material == material
        gain, dark, light = (jnp.where(here, a, b) for a, b in zip(pattern, (gain, dark, light), strict=True))
    return gain + spots, dark, light


def _cell(x: Array, every: int) -> Array:
    """Whether the whole number below x is a multiple of `every`."""
    whole = jnp.floor(x)
    return whole - every * jnp.floor(whole / every) == 0


def leaves(u: Array, v: Array, seed: Scalar) -> tuple[Array, Array]:
    """Bush: how thick the foliage is at a place on its face, 0..1 around 1/2, and how bright it is (in clumps)."""
    big, small = noise(4.0 * u, 4.0 * v, seed), noise(15.0 * u, 15.0 * v + 7.0, seed)
    return 0.5 * big + 0.5 * small, 0.3 + 0.8 * big * big + 0.8 * small * small


def blades(x: Array, y: Array, z: Array, seed: Scalar) -> tuple[Array, Array]:
    """Grass: how thick it is at a place, 0..1 around 1/2, and how bright: upright streaks."""
    tuft, blade = noise(5.0 * x, 5.0 * y, seed), noise(22.0 * x + 1.2 * z, 22.0 * y - 0.8 * z, seed)
    thin = noise(70.0 * x + 3.0 * z, 70.0 * y - 2.0 * z, seed)
    return 0.25 * tuft + 0.4 * blade + 0.35 * thin, 0.45 + 0.35 * tuft + 0.45 * blade + 0.4 * thin


def pane(face: Face, seed: Scalar) -> tuple[Array, Array]:
    """Glass: share of the pixel that the pane's trim covers, and how much of the light is sheen beyond the mirror's."""
    x, top = jnp.abs(face.u), face.top
    edges = face.upright & (face.half < 1e2) & (face.half > 0.2)  # the thin side of a pane has none
    trim = _all(
        _share((0.035 - face.half + x) / face.pixel + 0.5),
        _band(face.v, -1.0, 0.06, face.pixel),
        _band(face.v, top - 0.035, 9.0, face.pixel),
    )
    slant = face.u + 0.55 * face.v
    streak = _band(slant - 1.9 * jnp.round(slant / 1.9), -0.16, 0.05, face.pixel)
    streak = _all(streak, _band(slant - 1.9 * jnp.round(slant / 1.9), 0.12, 0.2, face.pixel))
    # Some glass has a frosted band at the height of the eyes.
    marked = _drawn(seed, 5) < 0.5
    dots = jnp.where(marked, _band(face.v, 1.3, 1.4, face.pixel) * (1 - 0.6 * _lines(face.u, 0.2, 0.06, face.pixel)), 0.0)
    return jnp.where(edges, trim, 0.0), 0.2 * streak + 0.4 * jnp.where(edges, dots, 0.0)
