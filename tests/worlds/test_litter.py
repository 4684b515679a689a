"""Litter of the worlds that training frames are drawn in."""

import numpy as np
import pytest

from drnav_jax import worlds
from drnav_jax.worlds import litter
from drnav_jax.worlds.clutter import to_polyline
from drnav_jax.worlds.world import signed_distance


def twins(family, seed=3):
    scenes = [worlds.sample(family, seed, "train")]
    return scenes + ([worlds.sample(worlds.twin(family), seed, "train")] if worlds.twin(family) else [])


@pytest.mark.parametrize("family", ["open", "t", "glass"])
def test_litter_is_the_same_in_twins_and_stands_in_nobodys_way(family):
    before = twins(family)
    after = litter.littered(before, np.random.default_rng(5))
    added = [a.world.cylinders[len(b.world.cylinders) :] for a, b in zip(after, before, strict=True)]
    assert 0 < len(added[0]) <= litter.PIECES
    ways = [worlds.check_trip(old, litter.BODY)[1] for old in before]
    near = np.min([to_polyline(added[0][:, :2], way) for way in ways], axis=0)
    assert near.max() < litter.REACH + 8.0, "posts reach on from the first of them"
    for scene, old, way, pieces in zip(after, before, ways, added, strict=True):
        np.testing.assert_array_equal(pieces, added[0])
        np.testing.assert_array_equal(scene.world.cylinders[: len(old.world.cylinders)], old.world.cylinders)
        assert len(scene.world.cylinder_surfaces.material) == len(scene.world.cylinders)
        assert scene.world.cylinder_surfaces.colour.shape == (len(scene.world.cylinders), 3)
        assert (scene.occupied >= old.occupied).all() and scene.occupied.sum() > old.occupied.sum()
        assert to_polyline(pieces[:, :2], way).min() > litter.FREE
        assert signed_distance(old.world, pieces[:, :2]).min() > -old.resolution, "none stands in a wall"
        assert worlds.check_trip(scene, litter.BODY)[0] == pytest.approx(worlds.check_trip(old, litter.BODY)[0], abs=0.3)


@pytest.mark.parametrize("family", ["t", "glass"])
def test_charted_worlds_are_grids_that_differ_where_the_twins_do(family):
    before = twins(family)
    after = litter.charted(before, np.random.default_rng(5))
    for scene, old in zip(after, before, strict=True):
        assert len(scene.world.boxes) == len(scene.world.cylinders) == 0 and scene.strata == ()
        assert (scene.occupied >= old.occupied).all() and scene.occupied.sum() > old.occupied.sum()
        x, y = (scene.origin[k] + (np.arange(scene.occupied.shape[1 - k]) + 0.5) * scene.resolution for k in (0, 1))
        centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        apart = signed_distance(scene.world, centres)
        assert apart[scene.occupied.ravel()].max() < 0.01 and apart[~scene.occupied.ravel()].min() > -0.01
        way = worlds.check_trip(old, litter.BODY)
        assert worlds.check_trip(scene, litter.BODY)[0] == pytest.approx(way[0], abs=0.3)
    closed, opened = (scene.occupied for scene in after)
    assert ((closed != opened) <= (before[0].occupied != before[1].occupied)).all() and (closed != opened).any()


def test_it_follows_the_generator_and_most_of_it_is_new_each_time():
    draw = lambda seed: litter.littered(twins("u"), np.random.default_rng(seed))[0].world.cylinders  # noqa: E731
    np.testing.assert_array_equal(draw(1), draw(1))
    assert draw(1).shape != draw(2).shape or not np.array_equal(draw(1), draw(2))


def test_a_world_without_room_stays_as_it_is():
    scene = worlds.sample("open", 0, "train")
    full = litter.replace(scene, occupied=np.ones_like(scene.occupied))
    assert litter.littered([full], np.random.default_rng(0)) == [full]
