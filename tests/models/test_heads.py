"""Heads: blocks against NumPy, grid positions, and what cells may read."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_network as reference
from small_network import filled

from drnav_jax.models.heads import CELL_OUTPUTS, Block, GridHead, GridSpec, TokenHead, WayHead, coordinates

pytestmark = pytest.mark.relaxed  # flax
GRID = GridSpec(widths=(8, 8, 8), blocks=(1, 1, 1), num_heads=2)


def built(net, *args):
    params = filled(jax.eval_shape(net.init, jax.random.key(0), *args)["params"])
    return jax.jit(lambda p, *a: net.apply({"params": p}, *a)), params


def convolve(params, x):
    """3 x 3, from the kernel as rows of the nine neighbours, first row first."""
    kernel = np.float64(params["around"]["kernel"]).reshape(3, 3, x.shape[-1], -1)
    return reference.convolve(x, kernel, 1, 1) + np.float64(params["around"]["bias"])


def test_a_block_is_its_formula():
    x = np.random.default_rng(0).normal(size=(2, 5, 7, 3)).astype(np.float32)
    apply, params = built(Block(), x)
    inner = np.maximum(convolve(params["first"], reference.layer_norm(params["norm"], x)), 0)
    np.testing.assert_allclose(apply(params, x), x + 0.5 * convolve(params["second"], inner), rtol=1e-3, atol=1e-4)


def test_coordinates():
    got = coordinates((3, 5))
    assert got.shape == (3, 5, 3) and got.dtype == np.float32
    np.testing.assert_allclose(got[1, 2], [0, 0, 0])
    np.testing.assert_allclose(got[0, 4], [-1, 1, 2**0.5], rtol=1e-6)
    np.testing.assert_allclose(got[2, 1], [1, -0.5, 1.25**0.5], rtol=1e-6)


def grid_inputs(seed=0):
    rng = np.random.default_rng(seed)
    f32 = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    mask = np.array([[1, 1, 0], [0, 0, 0]], bool)
    return f32(2, 16, 24, 4), f32(2, 8, 12, 3), f32(2, 3, 8), mask, f32(2, 5)


def test_the_grid_head_reads_all_it_is_given_and_no_missing_token():
    args = grid_inputs()
    apply, params = built(GridHead(GRID), *args)
    cells, seen = apply(params, *args)
    assert cells.shape == (2, 16, 24, len(CELL_OUTPUTS)) and seen.shape == (2, 16 * 2 * 3)
    assert np.isfinite(cells).all() and np.isfinite(seen).all()
    known, lifted, tokens, mask, joint = args
    moved = lambda *changed: np.abs(np.asarray(apply(params, *changed)[0]) - np.asarray(cells)).max(axis=(1, 2, 3))  # noqa: E731
    assert (moved(known + 1, lifted, tokens, mask, joint) > 1e-3).all()
    assert (moved(known, lifted + 1, tokens, mask, joint) > 1e-3).all()
    assert (moved(known, lifted, tokens, mask, joint + 1) > 1e-3).all()
    one = tokens + np.array([[0.0], [1.0], [0.0]], np.float32) * np.arange(8, dtype=np.float32)
    np.testing.assert_array_equal(moved(known, lifted, one, mask, joint) > 1e-3, [True, False])
    missing = tokens + np.array([[0.0], [0.0], [50.0]], np.float32)
    np.testing.assert_array_equal(moved(known, lifted, missing, mask, joint), [0, 0])


def test_frames_do_not_mix():
    args = grid_inputs()
    apply, params = built(GridHead(GRID), *args)
    both = apply(params, *args)
    swapped = apply(params, *(a[::-1] for a in args))
    for a, b in zip(both, swapped, strict=True):
        np.testing.assert_allclose(a, np.asarray(b)[::-1], rtol=1e-4, atol=1e-5)  # the same sums, elsewhere in a batch


def test_the_token_head_fills_a_grid_that_is_not_square():
    joint = np.random.default_rng(0).normal(size=(2, 5)).astype(np.float32)
    apply, params = built(TokenHead((16, 24), width=8), joint)
    cells = np.asarray(apply(params, joint))
    assert cells.shape == (2, 16, 24, len(CELL_OUTPUTS))
    assert np.ptp(cells, axis=(1, 2)).min() > 0 and np.abs(cells[0] - cells[1]).max() > 0


def test_the_way_head():
    seen = np.random.default_rng(0).normal(size=(3, 5)).astype(np.float32)
    apply, params = built(WayHead(6), seen)
    want = reference.dense(params["out"], reference.silu(reference.dense(params["inner"], seen)))
    np.testing.assert_allclose(apply(params, jnp.asarray(seen)), want, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("changes", [
    {"widths": (0, 8, 8)}, {"blocks": (1, -1, 1)},
    {"widths": (8, 8, 10), "num_heads": 4},
])  # fmt: skip
def test_what_cannot_be_is_refused(changes):
    with pytest.raises(ValueError, match="grid head|last width"):
        GridSpec(**changes)
