"""What surfaces are made of: what stops a robot, what returns a LiDAR beam, and how a camera sees it.

A beam that runs the length l through a material of extinction k comes out again with the probability

    P = exp(-k l)                                                                              (1)

so a wall has k = inf, glass k = 0 (the beam passes, though a robot does not), and leaves lie between. What the camera
knows and LiDAR does not - glass or air, bush or tall grass, painted edge or drop - occurs both where a way is open and
where it is closed (`families`), so neither sensor gives the answer away by itself.

A drop is a box below the ground (z_max = 0): over its footprint there is no ground above z_min. A stripe is paint: a flat
box that nothing meets.
"""

import enum
from typing import NamedTuple

import numpy as np


class Material(enum.IntEnum):
    """Index into the rows of `TABLE`."""

    WALL = 0
    BRICK = 1
    WOOD = 2
    METAL = 3
    CONCRETE = 4
    GLASS = 5
    BUSH = 6
    GRASS = 7
    CAR = 8
    STRIPE = 9
    DROP = 10
    TILES = 11
    CARPET = 12
    ASPHALT = 13
    LAWN = 14
    GRAVEL = 15


class Row(NamedTuple):
    """One material."""

    blocks: bool  # a robot cannot enter it: entering is a collision
    extinction: float  # k of eq. 1 [1/m]
    flat: bool = False  # paint or floor: no beam meets it, whatever its height


TABLE: dict[Material, Row] = {
    Material.WALL: Row(True, np.inf),
    Material.BRICK: Row(True, np.inf),
    Material.WOOD: Row(True, np.inf),
    Material.METAL: Row(True, np.inf),
    Material.CONCRETE: Row(True, np.inf),
    Material.GLASS: Row(True, 0.0),
    Material.BUSH: Row(True, 5.0),
    Material.GRASS: Row(False, 3.0),
    Material.CAR: Row(True, np.inf),
    Material.STRIPE: Row(False, 0.0, flat=True),
    Material.DROP: Row(True, 0.0),
    Material.TILES: Row(False, 0.0, flat=True),
    Material.CARPET: Row(False, 0.0, flat=True),
    Material.ASPHALT: Row(False, 0.0, flat=True),
    Material.LAWN: Row(False, 0.0, flat=True),
    Material.GRAVEL: Row(False, 0.0, flat=True),
}
FLOORS = (Material.CONCRETE, Material.TILES, Material.CARPET, Material.ASPHALT, Material.LAWN, Material.GRAVEL)
BLOCKS = np.array([TABLE[m].blocks for m in Material])  # [M] bool
EXTINCTION = np.array([TABLE[m].extinction for m in Material], np.float32)  # [M] [1/m]
