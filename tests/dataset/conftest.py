import numpy as np
import pytest

from drnav_jax.dataset.frames import Frame, FrameSpec, dtypes
from drnav_jax.sim.lidar import LidarSpec
from drnav_jax.types import FRONT_LEFT_RIGHT, BevSpec, RigSpec

SHARD = 512  # frames of a whole shard
TINY = FrameSpec(rig=RigSpec(FRONT_LEFT_RIGHT[:2], (3, 4)), lidar=LidarSpec(2, 5), bev=BevSpec((4, 6)))


def shapes(spec=TINY):
    n, (rows, columns), p, bev = len(spec.rig.mounts), spec.rig.shape, spec.lidar.num_points, spec.bev.shape
    cells = dict.fromkeys(
        ("local_map", "rule_p", "rule_confidence", "visibility", "dead_end", "inside", "valid", "depth", "traversable",
         "recoverability", "interior"), bev,
    )  # fmt: skip
    one = ("family", "seed", "closed", "behaviour", "strata", "strata_seen", "dead_end_flag", "flag_stable")
    flat = dict.fromkeys(one, ())
    return cells | flat | {
        "images": (n, rows, columns, 3), "image_valid": (n,), "points": (p, 3), "point_valid": (p,), "focal": (n, 2),
        "centre": (n, 2), "position": (n, 3), "rotation": (n, 3, 3), "path": (3,), "path_stable": (3,), "pose": (3,),
    }  # fmt: skip


def random_frames(shard, count=SHARD, num_families=2):
    rng = np.random.default_rng(shard)
    kinds, sizes = dtypes(), shapes()
    fields = {}
    for name in Frame._fields:
        shape = (count, *sizes[name])
        fields[name] = rng.random(shape) < 0.5 if kinds[name] is bool else rng.integers(0, 3, shape).astype(kinds[name])
    fields["family"] = rng.integers(0, num_families, count).astype(np.int32)
    fields["seed"] = shard * SHARD + np.arange(count, dtype=np.int32)  # every frame has another one
    return Frame(**fields)


@pytest.fixture(scope="session")
def make():
    return random_frames
