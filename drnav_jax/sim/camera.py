"""Pinhole cameras, ray-cast against a world: images and depth.

What the rays meet is found in `sight`, its colours in `shading`. Then comes the sensor: with the light L of a pixel,

    value = curve(gain L (1 - vignette rho^2)) + noise                                          (1)

clipped to 0..1. The gain of each channel is the scenery's exposure with the jitter of this image, rho the distance from
the image's middle (1 in the corners); the curve bends what is brighter than `KNEE` towards white, so that it keeps its
texture; the noise grows with the value.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from drnav_jax.grids import once
from drnav_jax.sim.shading import Colour, surface_colour, table_of, veil_colour
from drnav_jax.sim.sight import Veil, meet, rays_of
from drnav_jax.types import CameraRig, RigSpec, Scalar
from drnav_jax.worlds.world import World

KNEE = 0.6  # [] value from which on the curve bends; below, it is the identity

_f32 = functools.partial(jnp.asarray, dtype=jnp.float32)


class CameraParams(NamedTuple):
    """The image sensor. Jitters differ from camera to camera and from image to image."""

    noise_std: Scalar = 0.012  # [] standard deviation of a channel of a pixel (of 0..1) at half brightness
    exposure_jitter: Scalar = 0.08  # [] standard deviation of the gain, relative
    white_jitter: Scalar = 0.02  # [] of the gain of each channel
    vignette: Scalar = 0.15  # [] share of light lost in the corners
    blur: Scalar = 0.0  # [] weight of each neighbour along rows and columns, 0..1/3


def _sensor(params: CameraParams, exposure: Scalar, colour: Array, key: PRNGKeyArray) -> Array:
    """From light `[3, h, w]` to pixel values `[3, h, w]` in 0..1."""
    h, w = colour.shape[1:]
    gain_key, noise_key = jax.random.split(key)
    jitter = jax.random.normal(gain_key, (4,), jnp.float32)
    gain = exposure * jnp.exp(_f32(params.exposure_jitter) * jitter[3] + _f32(params.white_jitter) * jitter[:3])
    across = np.linspace(-1, 1, w)[None, :] ** 2 + np.linspace(-1, 1, h)[:, None] ** 2 if h * w > 1 else np.zeros((1, 1))
    light = colour * gain[:, None, None] * (1 - _f32(params.vignette) * 0.5 * _f32(across))[None]
    blur = _f32(params.blur)
    for axis, size in ((1, h), (2, w)):
        ahead = jax.lax.slice_in_dim(light, 1, size, axis=axis), jax.lax.slice_in_dim(light, size - 1, size, axis=axis)
        back = jax.lax.slice_in_dim(light, 0, 1, axis=axis), jax.lax.slice_in_dim(light, 0, size - 1, axis=axis)
        light = (1 - 2 * blur) * light + blur * (jnp.concatenate(ahead, axis) + jnp.concatenate(back, axis))
    light = jnp.minimum(light, KNEE) + (1 - KNEE) * (1 - jnp.exp(-jnp.maximum(light - KNEE, 0.0) / (1 - KNEE)))
    light = once(light)
    # The sum of a word's four bytes is nearly normal: to 3.4 standard deviations, which is enough for a sensor.
    bits = jax.random.bits(noise_key, (3, h, w), jnp.uint32)
    a, b, c, d = (((bits >> k) & 0xFF).astype(jnp.int32) for k in (0, 8, 16, 24))
    normal = (a + b + c + d - 510).astype(jnp.float32) * (1 / 147.8)
    grain = _f32(params.noise_std) * (0.5 + light)
    return jnp.clip(light + grain * normal, 0.0, 1.0)


def _is_level(spec: RigSpec, level: bool | None) -> bool:
    return all(m.pitch == 0 and m.roll == 0 for m in spec.mounts) if level is None else level


def _device(world: World) -> World:
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32 if np.issubdtype(a.dtype, np.floating) else jnp.int32), world)


@functools.partial(jax.jit, static_argnames=("spec", "level"))
def render(
    spec: RigSpec,
    params: CameraParams,
    world: World,
    rig: CameraRig,
    pose: Float[Array, "3"],
    key: PRNGKeyArray,
    *,
    level: bool | None = None,
) -> Float[Array, "cameras h w 3"]:
    """The images of a rig.

    Cameras are drawn one after another. For many frames use `jax.lax.map` (or threads) rather than `jax.vmap`: what is
    out of a camera's view is skipped, which the lanes of a vmap cannot do each for itself.

    Args:
        spec: Number of cameras and size of the images.
        params: The sensor.
        world: What is seen.
        rig: Where the cameras sit and look.
        pose: x, y, yaw of `base_link` in the world's frame [m, rad].
        key: Randomness of these images.
        level: Whether no camera of `rig` is pitched or rolled (several times as fast); None: as the spec's mounts say.
            Of a level spec whose `rig` is perturbed in pitch or roll, say False.

    Returns:
        RGB in 0..1.
    """
    world, pose = _device(world), _f32(pose)
    flat, table = _is_level(spec, level), table_of(world)
    exposure = world.scenery.exposure

    def one(each: tuple[CameraRig, PRNGKeyArray]) -> Array:
        camera, its_key = each
        rays = rays_of(flat, spec.shape, camera, pose)
        hits = meet(flat, world, rays, spec.shape)
        colour = surface_colour(world, table, rays, hits)
        if len(world.boxes) + len(world.cylinders):
            # A loop, and not one after the other: it compiles once.
            veils = jax.tree.map(lambda a, b: jnp.stack([a, b]), hits.second, hits.first)

            def over(under: Colour, veil: Veil) -> tuple[Colour, None]:
                draw = functools.partial(veil_colour, world, table, rays, veil, hits.depth)
                return jax.lax.cond(jnp.any(veil.depth < hits.depth), draw, lambda colour: colour, under), None

            colour, _ = jax.lax.scan(over, colour, veils)
        image = _sensor(params, exposure, once(jnp.stack(colour)), its_key)
        return jnp.moveaxis(image, 0, -1)

    if not spec.mounts:
        return jnp.zeros((0, *spec.shape, 3), jnp.float32)
    return jax.lax.map(one, (jax.tree.map(_f32, rig), jax.random.split(key, len(spec.mounts))))


@functools.partial(jax.jit, static_argnames=("spec", "level", "veils"))
def depth(
    spec: RigSpec, world: World, rig: CameraRig, pose: Float[Array, "3"], *, level: bool | None = None, veils: bool = False
) -> Float[Array, "cameras h w"]:
    """Depth along the optical axis (not along the ray) of the first surface that is seen, exact.

    Args:
        spec: Number of cameras and size of the images.
        world: What is seen.
        rig: Where the cameras sit and look.
        pose: x, y, yaw of `base_link` in the world's frame [m, rad].
        level: As in `render`.
        veils: Whether the surfaces of panes and plants count; otherwise what lies behind them.

    Returns:
        Depths [m]; inf in the sky.
    """
    world, pose = _device(world), _f32(pose)
    flat = _is_level(spec, level)

    def one(camera: CameraRig) -> Array:
        hits = meet(flat, world, rays_of(flat, spec.shape, camera, pose), spec.shape)
        return jnp.minimum(hits.depth, hits.first.depth) if veils else hits.depth

    if not spec.mounts:
        return jnp.zeros((0, *spec.shape), jnp.float32)
    return jax.lax.map(one, jax.tree.map(_f32, rig))
