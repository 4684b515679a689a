"""Which worlds a shard's frames are driven and sensed in."""

import dataclasses

import numpy as np
import pytest

from drnav_jax.dataset import gather
from drnav_jax.dataset.shards import DatasetSpec

PLAIN = DatasetSpec(48, "train", 0, ("u", "open"), num_worlds=8, per_world=6)


def made(family, **shares):
    return gather._pair(dataclasses.replace(PLAIN, **shares), family, 4)


@pytest.mark.parametrize("family", ["u", "open"])
def test_a_share_is_littered_or_sensed_as_a_grid(family):
    plain = made(family)[0]
    for shares in ({"litter": 1.0}, {"charted": 1.0}):
        driven, sensed = made(family, **shares)
        assert [scene.name for scene in driven] == [scene.name for scene in sensed] == [scene.name for scene in plain]
        for a, b, c in zip(driven, sensed, plain, strict=True):
            assert b.occupied.sum() > c.occupied.sum()
            if "litter" in shares:
                assert a is b and len(a.world.cylinders) > len(c.world.cylinders)
            else:
                np.testing.assert_array_equal(a.occupied, c.occupied)
                assert b.world.field.values.shape == b.occupied.shape and not c.world.field.values.size
    driven, sensed = made(family)
    assert all(a is b for a, b in zip(driven, sensed, strict=True))


def test_grids_come_in_few_sizes():
    sensed = made("u", charted=1.0)[1][0]
    h, w = sensed.occupied.shape
    padded = gather._padded(sensed.world).field.values
    assert padded.shape[0] == padded.shape[1] in gather.CHARTS and padded.shape[0] >= max(h, w)
    np.testing.assert_array_equal(padded[:h, :w], sensed.world.field.values)


@pytest.mark.parametrize("shares", [{"litter": -0.1}, {"charted": 1.1}, {"litter": 0.6, "charted": 0.5}])
def test_shares_are_shares(shares):
    with pytest.raises(ValueError, match="shares of at most 1 together"):
        dataclasses.replace(PLAIN, **shares)
