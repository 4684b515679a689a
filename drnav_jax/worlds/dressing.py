"""What a seeded world looks like: materials and colours by role, floor, ceiling, light, fog, exposure.

All of it is drawn from generators of their own, one for the place and one for each role, so that neither the geometry
nor the other twin's solids change what a seed looks like:

    colour = clip(one of the material's colours * (1 + gain + tint), 0.03, 0.95),   gain, tint ~ U(-s, s)    (1)

with the spread s of the split and a tint for each channel. Nothing here depends on whether a way is open.
"""

import math
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drnav_jax.worlds.materials import Material as M
from drnav_jax.worlds.solids import TOP, Solid
from drnav_jax.worlds.world import WALL_HEIGHT, Scenery, Surfaces, World, make_world, surfaces

Range = tuple[float, float]

# What: (range of train and val, range of test).
LIGHT: dict[str, tuple[Range, Range]] = {
    "elevation": ((25, 65), (12, 80)),  # of the sun [degrees]
    "ambient": ((0.4, 0.6), (0.3, 0.7)),  # under the sky; it is brighter by `INDOOR` under a ceiling
    "fog": ((0.0, 0.015), (0.0, 0.04)),  # under the sky [1/m]
    "exposure": ((0.85, 1.1), (0.7, 1.25)),
    "spread": ((0.0, 0.1), (0.0, 0.2)),  # s of eq. 1
}
INDOOR = 0.1  # by which the ambient share is higher under a ceiling

ROLES: dict[str, tuple[M, ...]] = {
    "lift": (M.METAL,),
    "frame": (M.METAL, M.WOOD),
    "leaf": (M.WOOD, M.WOOD, M.METAL),
    "pane": (M.GLASS,),
    "hedge": (M.BUSH,),
    "bush": (M.BUSH,),
    "grass": (M.GRASS,),
    "car": (M.CAR,),
    "stripe": (M.STRIPE,),
    "drop": (M.DROP,),
    "trunk": (M.WOOD,),
    "fence": (M.WOOD, M.METAL, M.CONCRETE),
    "crate": (M.WOOD, M.METAL, M.CONCRETE, M.WALL),
    "barrel": (M.METAL, M.CONCRETE, M.WOOD, M.BRICK),
    "heap": (M.CONCRETE, M.WOOD, M.BRICK, M.METAL, M.BUSH),
}
_GREYS = ((0.62, 0.61, 0.58), (0.5, 0.5, 0.49), (0.72, 0.71, 0.67))
COLOURS: dict[M, tuple[tuple[float, float, float], ...]] = {
    M.WALL: (
        (0.78, 0.76, 0.7), (0.82, 0.82, 0.8), (0.7, 0.74, 0.68), (0.74, 0.66, 0.54), (0.62, 0.68, 0.75), (0.75, 0.6, 0.52),
    ),
    M.BRICK: ((0.55, 0.27, 0.2), (0.62, 0.4, 0.28), (0.45, 0.33, 0.28), (0.66, 0.55, 0.42)),
    M.WOOD: ((0.5, 0.33, 0.18), (0.6, 0.45, 0.28), (0.36, 0.24, 0.15), (0.66, 0.62, 0.54)),
    M.METAL: ((0.6, 0.62, 0.64), (0.45, 0.47, 0.5), (0.3, 0.38, 0.46), (0.52, 0.2, 0.16), (0.66, 0.6, 0.5)),
    M.CONCRETE: _GREYS,
    M.GLASS: ((0.72, 0.86, 0.84), (0.7, 0.82, 0.9), (0.82, 0.86, 0.86), (0.66, 0.8, 0.7)),
    M.BUSH: ((0.16, 0.3, 0.12), (0.2, 0.36, 0.14), (0.13, 0.25, 0.15), (0.26, 0.33, 0.14)),
    M.GRASS: ((0.42, 0.52, 0.2), (0.55, 0.55, 0.26), (0.36, 0.5, 0.18), (0.62, 0.56, 0.32)),
    M.CAR: (
        (0.7, 0.1, 0.1), (0.12, 0.2, 0.5), (0.85, 0.85, 0.85), (0.1, 0.1, 0.11), (0.5, 0.52, 0.55), (0.14, 0.34, 0.22),
        (0.75, 0.6, 0.15),
    ),
    M.STRIPE: ((0.9, 0.75, 0.1), (0.9, 0.55, 0.1), (0.88, 0.86, 0.8)),
    M.DROP: ((0.4, 0.4, 0.39), (0.3, 0.3, 0.3), (0.46, 0.43, 0.38)),
    M.TILES: ((0.72, 0.7, 0.64), (0.55, 0.56, 0.58), (0.76, 0.74, 0.72)),
    M.CARPET: ((0.28, 0.3, 0.38), (0.4, 0.26, 0.24), (0.36, 0.37, 0.34)),
    M.ASPHALT: ((0.25, 0.25, 0.26), (0.33, 0.33, 0.33)),
    M.LAWN: ((0.28, 0.42, 0.16), (0.36, 0.45, 0.2), (0.44, 0.42, 0.22)),
    M.GRAVEL: ((0.52, 0.48, 0.42), (0.45, 0.44, 0.42), (0.58, 0.5, 0.38)),
}
STRATA = {M.DROP: "drop", M.GLASS: "glass", M.BUSH: "vegetation", M.GRASS: "vegetation"}
SKIES = ((0.55, 0.72, 0.95), (0.7, 0.75, 0.8), (0.45, 0.62, 0.92), (0.85, 0.8, 0.75))


class Setting(NamedTuple):
    """Where a family lies."""

    indoor: float = 0.0  # probability of a ceiling
    walls: tuple[M, ...] = (M.BRICK, M.CONCRETE, M.WALL, M.WOOD)  # under the sky
    grounds: tuple[M, ...] = (M.ASPHALT, M.CONCRETE, M.GRAVEL, M.LAWN)  # under the sky
    inner_walls: tuple[M, ...] = (M.WALL, M.WALL, M.BRICK, M.CONCRETE, M.WOOD)
    floors: tuple[M, ...] = (M.TILES, M.CARPET, M.CONCRETE)
    ceiling: Range = (WALL_HEIGHT, 3.0)  # [m] height


# The geometry of the first families stays as it was: their walls are WALL_HEIGHT high, and so is their ceiling.
_LOW = Setting(indoor=0.5, ceiling=(WALL_HEIGHT, WALL_HEIGHT))
SETTINGS: dict[str, Setting] = {
    "open": Setting(),
    "u": Setting(),
    "corridor": _LOW,
    "t": _LOW,
    "l": _LOW,
    "t-both": _LOW._replace(ceiling=(WALL_HEIGHT, 3.0)),
    "lobby": Setting(indoor=1.0, floors=(M.TILES, M.TILES, M.CARPET, M.CONCRETE)),
    "room": Setting(indoor=1.0),
    "glass": Setting(indoor=0.8),
    "dock": Setting(
        indoor=0.4,
        walls=(M.CONCRETE, M.BRICK, M.METAL),
        grounds=(M.CONCRETE, M.ASPHALT),
        inner_walls=(M.CONCRETE, M.BRICK, M.WALL),
        floors=(M.CONCRETE,),
    ),
    "cars": Setting(
        indoor=0.3,
        walls=(M.BRICK, M.CONCRETE, M.WOOD),
        grounds=(M.ASPHALT, M.CONCRETE, M.GRAVEL),
        inner_walls=(M.CONCRETE,),
        floors=(M.CONCRETE, M.ASPHALT),
    ),
    "trail": Setting(walls=(M.WOOD, M.BRICK), grounds=(M.GRAVEL, M.LAWN, M.LAWN)),
    "field": Setting(),
    "maze": Setting(),  # some are of hedges
    "office": Setting(indoor=1.0, floors=(M.CARPET, M.CARPET, M.TILES, M.CONCRETE)),
    "site": Setting(),
}


def _colour(material: M, spread: float, rng: np.random.Generator) -> np.ndarray:
    """Equation 1."""
    base = np.array(COLOURS[material][rng.integers(len(COLOURS[material]))])
    gain, tint = rng.uniform(-spread, spread), rng.uniform(-spread, spread, 3)
    return np.clip(base * (1 + gain + tint), 0.03, 0.95)


def _generator(key: Sequence[int], role: str) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence([*key, zlib.crc32(role.encode())]))


class Look:
    """The look of one seed: of the place, and of each role when it is asked for."""

    def __init__(self, setting: Setting, key: Sequence[int], test: bool):
        """The place.

        Args:
            setting: Of the family.
            key: Numbers that name family, split and seed.
            test: Whether to draw from the test split's ranges.
        """
        self._key, self._roles = list(key), {}
        rng = _generator(key, "place")

        def draw(name: str) -> float:
            return rng.uniform(*LIGHT[name][test])

        self.indoor = bool(rng.random() < setting.indoor)
        self.height = float(rng.uniform(*setting.ceiling)) if self.indoor else WALL_HEIGHT
        self._spread = draw("spread")
        walls = setting.inner_walls if self.indoor else setting.walls
        self._wall = walls[rng.integers(len(walls))]
        grounds = setting.floors if self.indoor else setting.grounds
        ground = grounds[rng.integers(len(grounds))]
        elevation, bearing = math.radians(draw("elevation")), rng.uniform(-math.pi, math.pi)
        flat = math.cos(elevation)
        fog, ambient, sky = draw("fog"), draw("ambient"), SKIES[rng.integers(len(SKIES))]
        self.scenery = Scenery(
            ground_material=int(ground),
            ground_colour=_colour(ground, self._spread, rng),
            wall_material=int(self._wall),
            wall_colour=self._of("wall")[1],
            ceiling=self.height if self.indoor else np.inf,
            ceiling_colour=np.clip(0.85 + rng.uniform(-0.1, 0.08) + rng.uniform(-0.03, 0.03, 3), 0, 0.95),
            sun=np.array([flat * math.cos(bearing), flat * math.sin(bearing), math.sin(elevation)]),
            ambient=min(ambient + INDOOR, 1.0) if self.indoor else ambient,
            sky_colour=np.clip(np.array(sky) + rng.uniform(-self._spread, self._spread) / 2, 0, 1),
            fog=0.0 if self.indoor else fog,
            exposure=draw("exposure"),
            texture_seed=int(rng.integers(2**20)),
        )

    def _of(self, role: str) -> tuple[M, np.ndarray]:
        """Material and colour of a role; what closes a way looks as the walls do in two of three worlds."""
        if role not in self._roles:
            rng = _generator(self._key, role)
            name = role.partition(":")[0]
            same = name == "end" and rng.random() < 2 / 3
            if same:
                return self._of("wall")
            choices = (self._wall,) if name == "wall" else (M.BRICK, M.CONCRETE, M.WOOD, M.WALL, M.METAL)
            choices = ROLES.get(name, choices)
            material = choices[rng.integers(len(choices))]
            self._roles[role] = material, _colour(material, self._spread, rng)
        return self._roles[role]

    def surfaces(self, solids: list[Solid]) -> Surfaces:
        """What solids are made of."""
        looks = [self._of(s.role) for s in solids]
        return surfaces(len(looks), [m for m, _ in looks], [c for _, c in looks]) if looks else surfaces(0)

    def strata(self, solids: list[Solid]) -> tuple[str, ...]:
        """What is among solids that one sensor alone cannot judge: of "drop", "glass", "vegetation"."""
        return tuple(sorted({STRATA[m] for m, _ in (self._of(s.role) for s in solids) if m in STRATA}))

    def world(self, solids: list[Solid]) -> World:
        """The world of solids: those up to `TOP` reach the ceiling, or `WALL_HEIGHT` under the sky."""
        groups = ([s for s in solids if s.is_box], [s for s in solids if not s.is_box])
        rows = [[[*s.row[:-1], self.height if s.row[-1] == TOP else s.row[-1]] for s in group] for group in groups]
        return make_world(
            rows[0],
            rows[1],
            box_surfaces=self.surfaces(groups[0]),
            cylinder_surfaces=self.surfaces(groups[1]),
            scenery=self.scenery,
        )
