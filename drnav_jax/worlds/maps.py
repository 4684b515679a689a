"""Worlds out of map images: map_server yaml and floor plans.

A file that cannot be read as what it claims to be is a `ValueError` that names the file, what is
wrong with it and what to do. Where free cells touch the border of a map, a ring of walls one cell
wide is added around it (and the origin moved out by a cell): nothing is known beyond the border, so
nothing may see or drive there. World coordinates are not changed by that.

map_server's occupancy (Nav2), with g the grey value of a pixel in 0..1:

    p = 1 - g, or g if `negate`                                                            (1)
    trinary: p >= occupied_thresh -> 100;  p <= free_thresh -> 0;  else -1                 (2)
    scale:   round(100 (p - free_thresh) / (occupied_thresh - free_thresh)), cut to 0..100 (3)
    raw:     the pixel (0..255) itself if <= 100, else -1                                  (4)

and -1 wherever a pixel is not opaque (trinary, scale). Unknown cells count as obstacles, as do
cells that reach occupied_thresh; what `scale` and `raw` leave in between can be driven on.
"""

import math
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image
from scipy import ndimage

from drnav_jax.worlds.world import Scene, from_grid

REQUIRED = ("image", "resolution", "origin", "occupied_thresh", "free_thresh")
MAX_YAW = 1e-6  # [rad] a map's origin may be turned by this much


def read_text(path: Path) -> str:
    """The text of a file; a `ValueError` that names it if there is none."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such file; check the path.") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file; is it the right one?") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}).") from None


def _read_image(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Grey value `[H, W]` in 0..255 (top row first) and whether each pixel is opaque."""
    if not path.is_file():
        raise ValueError(f"{path}: there is no such image; check the path.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                image.load()
                opaque = np.ones((image.height, image.width), bool)
                if image.mode == "F":
                    raise ValueError("grey values of type float have no stated range")
                if image.mode.startswith("I"):  # 16 bits; convert("L") would cut them off at 255
                    return np.asarray(image).astype(np.float64) / 257.0, opaque
                if "A" in image.getbands() or "transparency" in image.info:
                    rgba = image.convert("RGBA")
                    opaque = np.asarray(rgba)[..., 3] == 255
                    grey = rgba.convert("RGB").convert("L")
                else:
                    grey = image.convert("L")
                return np.asarray(grey, np.float64), opaque
    except Exception as error:  # decoders raise whatever they like on a broken file
        raise ValueError(
            f"{path}: cannot be read as an image ({error}); save it as 8-bit grey PNG or PGM."
        ) from None


def check_resolution(value: Any, where: str) -> float:
    """A cell's edge [m]; a `ValueError` if it is not a finite number > 0."""
    number = read_number(value, where, "resolution")
    if number <= 0:
        raise ValueError(f"{where}: resolution must be > 0 m per cell, got {value!r}.")
    return number


def read_number(value: Any, where: str, key: str) -> float:
    """A finite float; YAML 1.1 reads `5e-2` as text, so text that is a number will do."""
    try:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise ValueError
        number = float(value)
    except (ValueError, OverflowError):
        raise ValueError(f"{where}: {key} must be a number, got {value!r}.") from None
    if not math.isfinite(number):
        raise ValueError(f"{where}: {key} must be finite, got {value!r}.")
    return number


def map_scene(
    name: str, occupied: np.ndarray, origin: tuple[float, float], resolution: float, **fields: Any
) -> Scene:
    """The scene of a map (row 0 at the smallest y), closed at its border."""
    border = (occupied[0], occupied[-1], occupied[:, 0], occupied[:, -1])
    if not all(edge.all() for edge in border):
        occupied = np.pad(occupied, 1, constant_values=True)
        origin = (origin[0] - resolution, origin[1] - resolution)
    return Scene(
        name=name,
        world=from_grid(occupied, origin, resolution),
        occupied=occupied,
        origin=origin,
        resolution=resolution,
        outside_is_free=False,
        **fields,
    )


def need_free(occupied: np.ndarray, where: str, hint: str) -> None:
    """Refuse a map in which nothing can be driven on."""
    if occupied.all():
        raise ValueError(f"{where}: no cell of the map is free; {hint}")


def _map_header(path: Path) -> Mapping[str, Any]:
    try:
        header = yaml.safe_load(read_text(path))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        if str(path) in str(error):
            raise
        line = " ".join(str(error).split())
        raise ValueError(f"{path}: not valid YAML ({line}).") from None
    if not isinstance(header, Mapping):
        raise ValueError(f"{path}: expected keys and values, got {str(header)[:60]!r}.")
    missing = [key for key in REQUIRED if header.get(key) is None]
    if missing:
        raise ValueError(f"{path}: lacks {', '.join(missing)}; needed are {', '.join(REQUIRED)}.")
    return header


def load_occupancy(path: str | os.PathLike) -> tuple[np.ndarray, tuple[float, float], float]:
    """A map_server map as `nav_msgs/OccupancyGrid` has it (equations 1-4).

    Args:
        path: The yaml file; the image is looked up relative to it.

    Returns:
        Occupancy `[H, W]` int8 (-1 unknown, 0..100; row 0 at the smallest y), the world position of
        the outer corner of cell (0, 0) [m], and the edge of a cell [m].

    Raises:
        ValueError: If a file is missing or malformed, a key is missing or of the wrong type, or the
            map is turned against the world.
    """
    path = Path(path)
    where = str(path)
    header = _map_header(path)
    resolution = check_resolution(header["resolution"], where)
    origin = header["origin"]
    if not isinstance(origin, list | tuple) or len(origin) != 3:
        raise ValueError(f"{where}: origin must be [x, y, yaw], got {origin!r}.")
    x, y, yaw = (read_number(value, where, "origin") for value in origin)
    if abs(math.remainder(yaw, 2 * math.pi)) > MAX_YAW:
        raise ValueError(
            f"{where}: the origin's yaw is {yaw} rad; turned maps are not read. "
            "Rotate the image and set it to 0."
        )
    occupied_at = read_number(header["occupied_thresh"], where, "occupied_thresh")
    free_at = read_number(header["free_thresh"], where, "free_thresh")
    if not 0 <= free_at < occupied_at <= 1:
        raise ValueError(
            f"{where}: thresholds must be 0 <= free_thresh < occupied_thresh <= 1, "
            f"got {free_at} and {occupied_at}."
        )
    negate = header.get("negate", 0)
    if negate not in (0, 1):
        raise ValueError(f"{where}: negate must be 0 or 1, got {negate!r}.")
    mode = header.get("mode", "trinary")
    if mode not in ("trinary", "scale", "raw"):
        raise ValueError(f"{where}: mode must be trinary, scale or raw, got {mode!r}.")
    if not isinstance(header["image"], str):
        raise ValueError(f"{where}: image must be a file name, got {header['image']!r}.")

    grey, opaque = _read_image(path.parent / header["image"])
    if mode == "raw":
        pixel = np.rint(grey)
        values = np.where(pixel <= 100, pixel, -1)
    else:
        p = (grey if negate else 255.0 - grey) / 255.0
        if mode == "trinary":
            values = np.where(p >= occupied_at, 100, np.where(p <= free_at, 0, -1))
        else:
            values = np.clip(np.rint(100 * (p - free_at) / (occupied_at - free_at)), 0, 100)
        values = np.where(opaque, values, -1)
    return values[::-1].astype(np.int8), (x, y), resolution


def load_map_server(path: str | os.PathLike) -> Scene:
    """The world of a map_server yaml; unknown cells are solid, there is no trip yet.

    Raises:
        ValueError: As `load_occupancy`, or if no cell is free.
    """
    values, origin, resolution = load_occupancy(path)
    header = _map_header(Path(path))
    # `scale` has p >= occupied_thresh at 100, `raw` holds 100 p.
    limit = 100 * float(header["occupied_thresh"]) if header.get("mode") == "raw" else 100
    occupied = (values < 0) | (values >= limit)
    need_free(occupied, str(path), "check negate and the thresholds.")
    return map_scene(Path(path).stem, occupied, origin, resolution)


def _distance(mask: np.ndarray) -> np.ndarray:
    """Distance [cells] of each cell of a mask to the nearest cell that is not in it."""
    return np.asarray(ndimage.distance_transform_edt(mask))


def _fill_outside(occupied: np.ndarray, resolution: float, gap: float, where: str) -> np.ndarray:
    """Walls plus whatever a disc of diameter `gap` [m] sweeps that rolls in from the border."""
    radius = gap / 2 / resolution
    ring = math.ceil(radius) + 2
    passable = _distance(~np.pad(occupied, ring)) - 0.5 > radius
    # The padding is one part with number 1, as the label of the first cell met.
    parts = np.empty(passable.shape, np.int32)
    ndimage.label(passable, output=parts)
    if parts.max() < 2:
        raise ValueError(f"{where}: gaps wider than {gap} m let the outside in; widen that.")
    swept = _distance(parts != 1) <= radius + 0.5
    return occupied | swept[ring:-ring, ring:-ring]


def load_floor_plan(
    path: str | os.PathLike, resolution: float, outside_gap: float | None = None
) -> Scene:
    """The world of an image in which light pixels (luminance >= 0.5, opaque) are free.

    Args:
        path: The image; its lower left corner becomes the world's origin.
        resolution: Edge of a pixel [m].
        outside_gap: Where the surroundings of the building are light too: what can be reached from
            the image's border through gaps wider than this [m] is filled. None fills nothing.

    Raises:
        ValueError: If the image cannot be read, nothing in it is free, or a number is not > 0.
    """
    resolution = check_resolution(resolution, str(path))
    grey, opaque = _read_image(Path(path))
    occupied = ~((grey >= 127.5) & opaque)[::-1]
    need_free(occupied, str(path), "free space must be the light part of the image.")
    if outside_gap is not None:
        gap = read_number(outside_gap, str(path), "outside_gap")
        if gap <= 0:
            raise ValueError(f"{path}: outside_gap must be > 0 m, got {outside_gap}.")
        occupied = _fill_outside(occupied, resolution, gap, str(path))
    return map_scene(Path(path).stem, occupied, (0.0, 0.0), resolution)
