"""The loss against loops over cells and frames."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.models import losses
from drnav_jax.models.batch import BEFORE, NEVER, NOW, Targets
from drnav_jax.models.bev import FREE, OCCUPIED, UNKNOWN
from drnav_jax.models.losses import TERMS, LossParams
from drnav_jax.models.network import Outputs

B, H, W = 4, 3, 5
CLOSE = {"rtol": 2e-5, "atol": 1e-6}  # float32 sums of 60 numbers against float64
PARAMS = LossParams(
    before=1.3, never=2.1, interior=3.7, gamma=1.6, unstable=0.3, path=0.7, flag=0.2, traversable=0.4, recoverability=0.6,
    depth=0.9, hidden=4.5, veiled=2.5,
)  # fmt: skip
KNOWN = jnp.asarray(np.random.default_rng(3).choice([FREE, OCCUPIED, UNKNOWN], (B, H, W)), jnp.uint8)


def case(seed=0):
    rng = np.random.default_rng(seed)
    f32 = lambda *s: jnp.asarray(2 * rng.normal(size=s), jnp.float32)  # noqa: E731
    flags = lambda *s, share=0.5: jnp.asarray(rng.random(s) < share)  # noqa: E731
    cells = (B, H, W)
    out = Outputs(
        path=f32(B, 3), flag=f32(B), dead=f32(*cells), traversable=f32(*cells), recoverability=f32(*cells),
        depth=f32(*cells), alpha=jnp.zeros((B, 0)), beta=jnp.zeros((B, 0)),
    )  # fmt: skip
    targets = Targets(
        visibility=jnp.asarray(rng.integers(0, 3, cells), jnp.uint8), dead_end=flags(*cells),
        inside=flags(*cells, share=0.8), valid=flags(*cells, share=0.7), traversable=flags(*cells),
        depth=jnp.asarray(rng.uniform(0, 6, cells), jnp.float16), interior=flags(*cells, share=0.2),
        recoverability=jnp.asarray(rng.random(cells), jnp.float16), path=flags(B, 3), path_stable=flags(B, 3),
        dead_end_flag=flags(B), flag_stable=flags(B), family=None, seed=None, closed=None, strata=None, strata_seen=None,
    )  # fmt: skip
    return out, targets


def bce(z, y):
    z = float(z)
    return -y * -math.log1p(math.exp(-z)) - (1 - y) * -math.log1p(math.exp(z))


def loop(p, out, t):
    """{term: (sum, weight)} from the equations, cell by cell."""
    found = {name: [0.0, 0.0] for name in TERMS}

    def count(name, value, weight):
        found[name][0] += float(value) * weight
        found[name][1] += weight

    for b in range(B):
        for k in range(3):
            count("path", bce(out.path[b, k], float(t.path[b, k])), 1.0 if t.path_stable[b, k] else p.unstable)
        count("flag", bce(out.flag[b], float(t.dead_end_flag[b])), 1.0 if t.flag_stable[b] else p.unstable)
        for c in np.ndindex(H, W):
            c = (b, *c)
            z, y = float(out.dead[c]), float(t.dead_end[c])
            right = 1 / (1 + math.exp(-z)) if y else 1 / (1 + math.exp(z))
            weight = {NOW: 1.0, BEFORE: p.before, NEVER: p.never}[int(t.visibility[c])]
            weight *= 1 + p.interior * bool(t.interior[c])
            valid = float(t.valid[c])
            count("dead", (1 - right) ** p.gamma * bce(z, y), valid * weight)
            wrong = 1.0
            if int(KNOWN[c]) == FREE and not bool(t.traversable[c]):
                wrong = p.hidden
            if int(KNOWN[c]) == OCCUPIED and bool(t.traversable[c]):
                wrong = p.veiled
            count("traversable", bce(out.traversable[c], float(t.traversable[c])), float(t.inside[c]) * wrong)
            count("recoverability", bce(out.recoverability[c], float(t.recoverability[c])), valid)
            off = abs(float(out.depth[c]) - math.log1p(float(t.depth[c])))
            count("depth", 0.5 * off**2 if off <= 0.5 else 0.5 * (off - 0.25), valid * y)
    return found


def test_terms_and_their_total_are_those_of_a_loop():
    out, targets = case()
    terms, want = losses.sums(PARAMS, out, targets, KNOWN), loop(PARAMS, out, targets)
    assert set(terms) == set(TERMS)
    for name in TERMS:
        assert want[name][1] > 0
        np.testing.assert_allclose(terms[name], want[name], err_msg=name, **CLOSE)
    value, each = losses.total(PARAMS, terms)
    share = {"dead": 1.0, "path": 0.7, "flag": 0.2, "traversable": 0.4, "recoverability": 0.6, "depth": 0.9}
    means = {name: s / w for name, (s, w) in want.items()}
    np.testing.assert_allclose(float(value), sum(share[n] * means[n] for n in TERMS), **CLOSE)
    for name in TERMS:
        np.testing.assert_allclose(float(each[name]), means[name], **CLOSE)


def test_without_gamma_it_is_cross_entropy():
    out, targets = case()
    plain = losses.sums(PARAMS._replace(gamma=0.0), out, targets, KNOWN)["dead"]
    want = loop(PARAMS._replace(gamma=0.0), out, targets)["dead"]
    np.testing.assert_allclose(plain, want, **CLOSE)
    focal = losses.sums(PARAMS, out, targets, KNOWN)["dead"]
    assert float(focal[0]) < float(plain[0]) and float(focal[1]) == float(plain[1])


@pytest.mark.long
def test_two_halves_make_the_whole():
    """Values and gradients: devices add weights before they divide."""
    out, targets = case()
    real = lambda tree: jax.tree.map(lambda a: a, tree)  # noqa: E731
    part = lambda tree, s: jax.tree.map(lambda a: a[s], real(tree))  # noqa: E731
    whole, _ = losses.total(PARAMS, losses.sums(PARAMS, out, targets, KNOWN))
    cuts = (slice(0, 1), slice(1, B))  # of unequal size
    halves = [(part(out, s), part(targets, s), KNOWN[s]) for s in cuts]
    weights = [{n: w for n, (_, w) in losses.sums(PARAMS, *h).items()} for h in halves]
    over = {n: weights[0][n] + weights[1][n] for n in TERMS}
    values = [losses.total(PARAMS, losses.sums(PARAMS, *h), over)[0] for h in halves]
    np.testing.assert_allclose(float(values[0] + values[1]), float(whole), **CLOSE)

    def loss(out, targets, known, over=None):
        return losses.total(PARAMS, losses.sums(PARAMS, out, targets, known), over)[0]

    slope = jax.grad(loss)(out, targets, KNOWN)
    parts = [jax.grad(loss)(*h, over) for h in halves]
    joined = jax.tree.map(lambda *a: jnp.concatenate(a), *parts)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **CLOSE), joined, slope)


def test_nothing_to_learn_from_is_a_loss_of_zero():
    out, targets = case()
    none = targets._replace(
        valid=jnp.zeros((B, H, W), bool), inside=jnp.zeros((B, H, W), bool), dead_end=jnp.zeros((B, H, W), bool)
    )
    _, each = losses.total(PARAMS, losses.sums(PARAMS, out, none, KNOWN))
    assert [float(each[n]) for n in ("dead", "traversable", "recoverability", "depth")] == [0, 0, 0, 0]
    slope = jax.grad(lambda o: losses.total(PARAMS, losses.sums(PARAMS, o, none, KNOWN))[0])(out)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope)) and not np.asarray(slope.dead).any()


@pytest.mark.parametrize("gamma", [0.0, 2.0])
def test_sure_and_wrong_or_sure_and_right_is_finite(gamma):
    out, targets = case()
    right = jnp.where(jnp.arange(W) % 2 == 0, 80.0, -80.0)[None, None]
    sure = out._replace(dead=jnp.where(targets.dead_end, 1.0, -1.0) * right)
    params = PARAMS._replace(gamma=gamma)
    value, slope = jax.value_and_grad(lambda o: losses.total(params, losses.sums(params, o, targets, KNOWN))[0])(sure)
    assert np.isfinite(value) and np.isfinite(slope.dead).all()
    pulled = np.asarray(slope.dead)[np.asarray(targets.valid)]
    assert np.abs(pulled).max() > 0


def test_weights_of_the_loss_can_be_swept():
    out, targets = case()

    def loss(interior):
        params = PARAMS._replace(interior=interior)
        return losses.total(params, losses.sums(params, out, targets, KNOWN))[0]

    many = jax.vmap(loss)(jnp.asarray([0.0, 4.0], jnp.float32))
    assert abs(float(many[0] - many[1])) > 1e-3
    np.testing.assert_allclose(many, [loss(0.0), loss(4.0)], **CLOSE)
