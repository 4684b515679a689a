"""The ground truth of a world, on its grid, kept in a folder by content hash (host code).

What a robot of radius R must know of a scene and no sensor shows: where it may drive, which cells are dead ends and how
deep they lie (`labels`), and what is known of each pocket (`pockets`). Labels are defined on F, where the robot's
centre may be; here they are grown by R over cells of less clearance, so that a pocket is filled up to its walls.

Drops and glass bound free space like walls, grass does not: a scene's grid holds what stops a robot and nothing else.
"""

import contextlib
import dataclasses
import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float16, UInt16
from scipy import ndimage

from drnav_jax.worlds.labels import LabelSpec, clearance_of, dead_ends
from drnav_jax.worlds.paths import trip_cells
from drnav_jax.worlds.pockets import Pockets, pockets
from drnav_jax.worlds.world import Scene, distance_field

_SOURCES = ("cuts", "labels", "pockets", "truth")  # a change of these makes what was kept stale
_FAR = 100.0  # [m] clearance is cut off here


@dataclasses.dataclass(frozen=True)
class TruthSpec:
    """What the ground truth is for.

    Attributes:
        radius: R of the robot [m].
        mouth: Widest mouth of interest [m]; None = 5 m where outside is free, else 2.5 m (a building).
        room_area: Pockets of at least this area count as rooms [m^2].
        resolution: Finer grids are made this coarse [m]; labels need no finer one.
    """

    radius: float = 0.25
    mouth: float | None = None
    room_area: float = 6.0
    resolution: float = 0.1

    def __post_init__(self) -> None:
        """Check ranges."""
        LabelSpec(radius=self.radius, **({} if self.mouth is None else {"mouth": self.mouth}))
        if not self.room_area >= 0:
            raise ValueError(f"room_area must be >= 0 m^2, got {self.room_area}.")
        if not self.resolution > 0:
            raise ValueError(f"resolution must be > 0 m, got {self.resolution}.")


class GroundTruth(NamedTuple):
    """One world's truth on a grid; NumPy arrays on the host."""

    label: Bool[np.ndarray, "H W"]  # True = dead end, grown up to the walls
    depth: Float16[np.ndarray, "H W"]  # [m] beyond the mouth of the outermost pocket
    gap: Float16[np.ndarray, "H W"]  # [m] of the narrowest gate that cuts the cell off, else inf
    pocket: UInt16[np.ndarray, "H W"]  # k + 1 for row k of `pockets`; 0 = none
    traversable: Bool[np.ndarray, "H W"]  # nothing there stops a robot
    standable: Bool[np.ndarray, "H W"]  # F: the robot's centre may be there
    defined: Bool[np.ndarray, "H W"]  # within R of what can be reached of F: where labels mean something
    clearance: Float16[np.ndarray, "H W"]  # [m] to what stops a robot, at most 100; < 0 in it
    pockets: Pockets
    origin: Float[np.ndarray, "2"]  # world x, y of the outer corner of cell (0, 0) [m]
    resolution: float  # edge of a cell [m]
    radius: float  # R [m]
    outside_is_free: bool  # whether one may drive beyond the grid


def truth(
    scene: Scene,
    spec: TruthSpec = TruthSpec(),  # noqa: B008 (immutable)
    *,
    trip_path: Float[np.ndarray, "L 2"] | None = None,
    cache: str | os.PathLike | None = None,
) -> GroundTruth:
    """Ground truth of a scene: goal-free, or for one trip.

    Args:
        scene: Any world.
        spec: The robot, and what is of interest.
        trip_path: x, y [m] of the corners of the shortest way from start to goal: then it is no dead end.
        cache: Folder in which results are kept; a file that is damaged or of something else is replaced.

    Raises:
        ValueError: If the path does not touch the grid.
    """
    file = None
    if cache is not None:
        file = Path(cache) / f"{_key(scene, spec, trip_path)}.npz"
        kept = _read(file)
        if kept is not None:
            return kept
    made = _make(scene, spec, trip_path)
    if file is not None:
        _write(file, made)
    return made


def _make(scene: Scene, spec: TruthSpec, trip_path: np.ndarray | None) -> GroundTruth:
    occupied, resolution = _coarse(scene, spec.resolution)
    cells = None
    if trip_path is not None:
        cells = trip_cells(trip_path, scene.origin, resolution)
        cells = cells[((cells >= 0) & (cells < np.asarray(occupied.shape))).all(axis=1)]
        if not len(cells):
            raise ValueError(f"{scene.name}: the trip's path lies off the grid; is it in world coordinates [m]?")
    mouth = spec.mouth or (5.0 if scene.outside_is_free else 2.5)
    labels = dead_ends(occupied, resolution, LabelSpec(radius=spec.radius, mouth=mouth), trip_path=cells)
    clearance = clearance_of(occupied, resolution)
    standable = clearance > spec.radius
    reachable = _reachable(standable, scene.outside_is_free, cells)
    # growing must not reach out of the mouth: only over cells where no robot's centre can be
    label, near = labels.label, np.indices(occupied.shape)
    if label.any():
        distance, near = _nearest(label)
        label = label | (~standable & (distance * resolution <= spec.radius))
    of = lambda values, fill: np.where(label, values[tuple(near)], fill)  # noqa: E731
    return GroundTruth(
        label=label,
        depth=of(labels.depth, 0).astype(np.float16),
        gap=of(labels.gap, np.inf).astype(np.float16),
        pocket=of(labels.pocket, 0).astype(np.uint16),
        traversable=~occupied,
        standable=standable,
        defined=~occupied & (_nearest(reachable)[0] * resolution <= spec.radius),
        clearance=np.clip(clearance, -1.0, _FAR).astype(np.float16),
        pockets=pockets(
            labels, occupied, scene.origin, resolution, radius=spec.radius, room_area=spec.room_area
        ),
        origin=np.asarray(scene.origin, np.float64),
        resolution=float(resolution),
        radius=float(spec.radius),
        outside_is_free=bool(scene.outside_is_free),
    )


def _nearest(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [cells] `[H, W]` of each cell to the mask, and the cell `[2, H, W]` of it that is nearest."""
    found: Any = ndimage.distance_transform_edt(~mask, return_indices=True)
    return found


def _reachable(standable: np.ndarray, outside_is_free: bool, cells: np.ndarray | None) -> np.ndarray:
    """The parts of F on which there are robots: what a trip's cells touch, else what outside does, else the largest."""
    part = np.zeros([n + 2 for n in standable.shape], np.int32)
    ndimage.label(np.pad(standable, 1, constant_values=outside_is_free), output=part)
    outside, inside = part[0, 0], part[1:-1, 1:-1]
    if cells is not None:
        met = inside[tuple(cells.T)]
    elif outside_is_free:
        met = outside
    else:
        met = np.argmax(np.bincount(inside[standable], minlength=2)[1:]) + 1
    return standable & np.isin(inside, met)


def _coarse(scene: Scene, resolution: float) -> tuple[np.ndarray, float]:
    """The grid of a scene at a resolution, or its own where that is no finer."""
    if scene.resolution >= resolution - 1e-6:
        return scene.occupied, scene.resolution
    shape = tuple(int(n * scene.resolution / resolution) for n in scene.occupied.shape)
    centres = [((np.arange(n) + 0.5) * resolution / scene.resolution - 0.5) for n in shape]
    fine = distance_field(scene.occupied, scene.resolution)
    field = ndimage.map_coordinates(fine, np.meshgrid(*centres, indexing="ij"), order=1, mode="nearest")
    return field <= 0, resolution


def interior(closed: GroundTruth, opened: GroundTruth) -> Bool[np.ndarray, "H W"]:
    """Cells, free in both twins, whose label differs between them: where the twins' question is asked.

    Raises:
        ValueError: If the two are not on one grid.
    """
    grids = [(t.label.shape, *np.round(t.origin, 6).tolist(), t.resolution) for t in (closed, opened)]
    if grids[0] != grids[1]:
        raise ValueError(f"twins must share a grid, got (shape, origin, resolution) {grids[0]} and {grids[1]}.")
    return (closed.label != opened.label) & closed.traversable & opened.traversable


def _key(scene: Scene, spec: TruthSpec, trip_path: np.ndarray | None) -> str:
    """Hash of all that the truth depends on, this code included."""
    digest = hashlib.sha256()
    for name in _SOURCES:
        digest.update((Path(__file__).parent / f"{name}.py").read_bytes())
    path = None if trip_path is None else np.asarray(trip_path, np.float64).tolist()
    about = (spec, scene.occupied.shape, scene.origin, scene.resolution, scene.outside_is_free, path)
    digest.update(repr(about).encode())
    digest.update(np.packbits(scene.occupied).tobytes())
    return digest.hexdigest()[:32]


def _flat(made: GroundTruth) -> dict[str, np.ndarray]:
    """Fields by name; those of the pockets as `pockets.NAME`."""
    fields: dict[str, Any] = made._asdict()
    fields |= {f"pockets.{name}": value for name, value in fields.pop("pockets")._asdict().items()}
    return {name: np.asarray(value) for name, value in fields.items()}


def _seal(key: str, fields: dict[str, np.ndarray]) -> str:
    """Hash of a file's name and content."""
    digest = hashlib.sha256(key.encode())
    for name in sorted(fields):
        value = np.ascontiguousarray(fields[name])
        digest.update(f"{name} {value.dtype.str} {value.shape}".encode() + value.tobytes())
    return digest.hexdigest()


def _read(file: Path) -> GroundTruth | None:
    """What a file holds, or None if it is not there, damaged, or not what its name says."""
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            fields = {name: archive[name] for name in archive.files}
        seal = fields.pop("seal").item()
        if seal != _seal(file.stem, fields):
            return None
        of_pockets = {name: fields.pop(f"pockets.{name}") for name in Pockets._fields}
        scalars = {name: fields.pop(name).item() for name in ("resolution", "radius", "outside_is_free")}
        return GroundTruth(pockets=Pockets(**of_pockets), **scalars, **fields)
    except Exception:  # a damaged archive raises whatever it likes; the truth can always be made anew
        return None


def _write(file: Path, made: GroundTruth) -> None:
    """Write under a temporary name, then rename: whoever reads sees all of it or nothing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    fields: Any = _flat(made)
    handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.stem}-", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as stream:
            np.savez_compressed(stream, seal=np.asarray(_seal(file.stem, fields)), **fields)
        os.replace(name, file)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise
