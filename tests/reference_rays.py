"""One ray at a time, in float64, by the plainest of geometry: what sensors are tested against."""

import math

import numpy as np

from drnav_jax.worlds.materials import Material

MARCH = 1e-3  # [m] steps down a drop


def in_footprint(row, x, y):
    ax, ay = x - row[0], y - row[1]
    along, across = math.cos(row[2]) * ax + math.sin(row[2]) * ay, math.cos(row[2]) * ay - math.sin(row[2]) * ax
    return abs(along) <= row[3] and abs(across) <= row[4]


def box_hit(row, p, d):
    """(enter, leave) of one ray, or None."""
    c, s = math.cos(row[2]), math.sin(row[2])
    ax, ay = p[0] - row[0], p[1] - row[1]
    at = [c * ax + s * ay, c * ay - s * ax, p[2] - (row[5] + row[6]) / 2]
    way = [c * d[0] + s * d[1], c * d[1] - s * d[0], d[2]]
    enter, leave = -math.inf, math.inf
    for a, v, half in zip(at, way, (row[3], row[4], (row[6] - row[5]) / 2), strict=True):
        if abs(v) < 1e-12:
            if abs(a) > half:
                return None
            continue
        enter = max(enter, min((-half - a) / v, (half - a) / v))
        leave = min(leave, max((-half - a) / v, (half - a) / v))
    return (enter, leave) if enter < leave and leave > 0 else None


def post_hit(row, p, d):
    a = d[0] ** 2 + d[1] ** 2
    b = d[0] * (p[0] - row[0]) + d[1] * (p[1] - row[1])
    under = b * b - a * ((p[0] - row[0]) ** 2 + (p[1] - row[1]) ** 2 - row[2] ** 2)
    if under <= 0:
        return None
    heights = sorted(((row[3] - p[2]) / d[2], (row[4] - p[2]) / d[2]))
    enter, leave = max((-b - under**0.5) / a, heights[0]), min((-b + under**0.5) / a, heights[1])
    return (enter, leave) if enter < leave and leave > 0 else None


def trace(world, p, d, veils=False, near=0.0):
    """One ray from p along d (s counts in lengths of d) in a world of boxes and cylinders.

    Args:
        world: No field.
        p: Where it starts `[3]`.
        d: Its direction `[3]`, not level.
        veils: Whether panes and plants end it.
        near: s from which on they do.

    Returns:
        s of the end, and the plants and panes that it passes: (material, enter, leave) each.
    """
    found, passed, drops = [math.inf], [], []
    for rows, looks, hit in (
        (world.boxes, world.box_surfaces, box_hit), (world.cylinders, world.cylinder_surfaces, post_hit)
    ):  # fmt: skip
        for row, material in zip(np.asarray(rows, float), np.asarray(looks.material), strict=True):
            if material == Material.DROP:
                drops.append(row)
            met = hit(row, p, d)
            if material in (Material.DROP, Material.STRIPE) or not met:
                continue
            if material not in (Material.GLASS, Material.BUSH, Material.GRASS):
                found.append(met[0] if met[0] >= 0 else met[1])
            elif met[1] > max(met[0], near):
                passed.append((material, max(met[0], near), met[1]))
    if d[2] > 0:
        end = (float(world.scenery.ceiling) - p[2]) / d[2]
    else:
        end = -p[2] / d[2]
        while any(in_footprint(r, *(p + end * d)[:2]) and (p + end * d)[2] > r[5] for r in drops):
            end += MARCH / np.linalg.norm(d)
    end = min(*found, end)
    if veils:
        return min([end, *(enter for _, enter, _ in passed)]), []
    return end, [(material, enter, min(leave, end)) for material, enter, leave in passed if enter < end]
