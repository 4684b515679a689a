"""Where sensors sit: fixed transforms of a bag's tf messages.

A transform of frame a in frame b takes points p_a to

    p_b = R p_a + t                                                                                       (1)

Mounts are taken for fixed: of each pair of frames the first transform counts.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float


class Rigid(NamedTuple):
    """Eq. 1."""

    rotation: np.ndarray  # [3, 3]
    translation: np.ndarray  # [3] [m]

    def __matmul__(self, other: "Rigid") -> "Rigid":
        """First `other`, then this."""
        return Rigid(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def of(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points in the other frame [m]."""
        return points @ self.rotation.T + self.translation

    def inverse(self) -> "Rigid":
        """The way back."""
        return Rigid(self.rotation.T, -self.rotation.T @ self.translation)


IDENTITY = Rigid(np.eye(3), np.zeros(3))


def rotation_of(q: Any) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of a quaternion message (x, y, z, w).

    Raises:
        ValueError: If it is no rotation.
    """
    x, y, z, w = q.x, q.y, q.z, q.w
    n = x * x + y * y + z * z + w * w
    if not abs(n - 1.0) < 0.1:
        raise ValueError(f"({x}, {y}, {z}, {w}) is no rotation: a quaternion must have length 1.")
    s = 2.0 / n
    return np.array([
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ])  # fmt: skip


def yaw_of(q: Any) -> float:
    """Heading [rad] of a quaternion message."""
    r = rotation_of(q)
    return float(np.arctan2(r[1, 0], r[0, 0]))


class Tree:
    """Frames and what lies between them."""

    def __init__(self) -> None:
        """Without frames."""
        self.edges: dict[tuple[str, str], Rigid] = {}

    def add(self, message: Any) -> None:
        """Take the transforms of a tf message in."""
        for stamped in message.transforms:
            parent, child = stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")
            if (parent, child) in self.edges:
                continue
            t = stamped.transform.translation
            put = Rigid(rotation_of(stamped.transform.rotation), np.array([t.x, t.y, t.z]))
            self.edges[parent, child], self.edges[child, parent] = put, put.inverse()

    def between(self, target: str, source: str) -> Rigid | None:
        """What takes points from one frame to another; None if nothing connects them."""
        reached, fresh = {source: IDENTITY}, [source]
        while fresh:
            at = fresh.pop()
            for (parent, child), put in self.edges.items():
                if child == at and parent not in reached:
                    reached[parent] = put @ reached[at]
                    fresh.append(parent)
        return reached.get(target)

    def frames(self) -> list[str]:
        """Names of all frames."""
        return sorted({name for pair in self.edges for name in pair})
