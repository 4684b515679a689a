"""The fusion network as a predictor: cameras, LiDAR and the known map -> evidence on the rolling window.

The network answers on a grid that turns with the robot; its answer is brought into the window, cell by cell. How much a
cell's answer weighs:

    (1)  confidence(c) = weight · m(twist) · w(c)
    (2)  w = 1 where a sensor has seen the cell free, `unseen` where it has seen one within `NEAR` along x and y, else 0
    (3)  m = 1 while the robot moves or turns, down to `still` when it stands: the same view twice is no second opinion

`weight` < 1 since successive frames are not independent either: it tempers the filter's sum (eq. 5 of the paper). And since
the network reads the map that earlier frames made, what it says `repeats` most of what it said (`filter.dead_end`, eq. 6a).

What it says of traversability, t, corrects the LiDAR's map where the two differ: a cell that LiDAR holds to be free, with
no return in it or beside it, may be a pane of glass, and one that it holds to be occupied may be grass. Within `sight`

    (4)  blocked(c) = m [`pane` - logit t(c)], kept within -`clears`..`closes`     where LiDAR holds c to be free
         blocked(c) = -m logit t(c), kept within -`opens`..`opens`                 where it holds c to be occupied

and 0 elsewhere. Of a pane t is rarely below a half, of floor it is nearly always far above: so `pane` lies above 0 nat. But
in real buildings floor beside thin things is doubted as much, and ways that lead nowhere else were closed; so `closes` is 0
unless one knows the place (the model card has the figures).
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax import geometry, grids
from drnav_jax.models import bev, calibration, geometric, network
from drnav_jax.models.batch import FREE, OCCUPIED, Inputs
from drnav_jax.models.calibration import Calibration
from drnav_jax.models.geometric import GeometricParams
from drnav_jax.models.network import NetworkSpec, Outputs
from drnav_jax.models.weights import Trained
from drnav_jax.types import Evidence, GridMap, LocalMap, Observation, Scalar

NEAR = 2.0  # [m] eq. 2
FAR_GOAL = 1e4  # [m] the rule is asked without a goal, as in training


class FusionParams(NamedTuple):
    """Weights, and how far to trust them."""

    network: Any  # from `network.init` or `weights.load`
    calibration: Calibration = Calibration()
    weight: Scalar = 0.35  # [] of one frame's answer
    repeats: Scalar = 1.0  # [] share of earlier answers that an answer stands for
    unseen: Scalar = 0.6  # [] w of eq. 2
    still: Scalar = 0.1  # [] m of eq. 3 of a robot that stands
    moving: Scalar = 0.2  # [] speed [m/s] and rate [rad/s] from which m = 1
    sight: Scalar = 5.0  # [] eq. 4 [m]
    pane: Scalar = 1.2  # [] eq. 4 [nat]
    closes: Scalar = 0.0  # [] eq. 4 [nat]; 0: none
    clears: Scalar = 2.0  # [] eq. 4 [nat]
    opens: Scalar = 0.0  # [] eq. 4 [nat]; 0: nothing, for a wall taken for grass is a collision
    rule: GeometricParams = GeometricParams()  # an input of the network, and the answer where there is no camera


def params_of(trained: Trained, **changes: Any) -> FusionParams:
    """Parameters from a file of weights."""
    return FusionParams(trained.params, trained.calibration)._replace(**changes)


def inputs_of(spec: NetworkSpec, params: FusionParams, observation: Observation, local_map: LocalMap) -> Inputs:
    """What the network reads, as a batch of one."""
    asked = observation._replace(goal=jnp.full(2, FAR_GOAL, jnp.float32))
    local_map = local_map._replace(closed=None)  # as in training: the map of the LiDAR alone
    rule = geometric.predict(params.rule, asked, local_map)
    at = lambda values: bev.resample(  # noqa: E731
        spec.bev, GridMap(values, local_map.origin, local_map.resolution), observation.pose, 0.0
    )
    fields: dict[str, Any] = {
        "images": observation.images, "image_valid": observation.image_valid, "points": observation.points,
        "point_valid": observation.point_valid, "rig": observation.rig,
        "local_map": bev.classes(spec.bev, local_map, observation.pose),
        "rule_p": at(rule.p_dead), "rule_confidence": at(rule.confidence),
    }  # fmt: skip
    return jax.tree.map(lambda a: jnp.asarray(a)[None], Inputs(**fields))


def answer(spec: NetworkSpec, params: FusionParams, observation: Observation, local_map: LocalMap) -> Outputs:
    """The network's calibrated outputs, without batch axis: ways, flag, cells in the robot's frame, saliency."""
    out = network.apply(spec, params.network, inputs_of(spec, params, observation, local_map))
    return jax.tree.map(lambda a: a[0], calibration.calibrated(params.calibration, out))


def _grown(mask: Array, cells: int) -> Array:
    """Cells within `cells` of true ones, along rows and columns."""
    n = 2 * cells + 1
    grown = mask.astype(jnp.float32)
    for window in ((n, 1), (1, n)):  # a square one would look at n^2 cells for each
        grown = jax.lax.reduce_window(grown, -jnp.inf, jax.lax.max, window, (1, 1), "SAME")
    return grown > 0


def _moves(params: FusionParams, observation: Observation) -> Float[Array, ""]:
    """Eq. 3."""
    speed = jnp.max(jnp.abs(observation.twist)) / jnp.maximum(params.moving, 1e-3)
    return params.still + (1.0 - params.still) * jnp.minimum(speed, 1.0)


def trust(
    spec: NetworkSpec, params: FusionParams, observation: Observation, known: Array
) -> Float[Array, "h w"]:
    """Eqs. 1 to 3 on the network's grid; `known` holds the classes of `models.bev`."""
    seen = known == FREE
    near = _grown(seen, round(NEAR / spec.bev.resolution)) & (known != OCCUPIED)
    where = jnp.where(seen, 1.0, jnp.where(near, params.unseen, 0.0))
    return (params.weight * _moves(params, observation) * where).astype(jnp.float32)


def blocked(
    spec: NetworkSpec, params: FusionParams, observation: Observation, known: Array, traversable: Array
) -> Float[Array, "h w"]:
    """Eq. 4 on the network's grid, from the logits of t."""
    returned = known == OCCUPIED
    asked = returned | ((known == FREE) & ~_grown(returned, 1))
    x, y = geometry.cell_centres(spec.bev.shape, jnp.asarray(spec.bev.origin, jnp.float32), spec.bev.resolution)
    asked &= (x * x + y * y <= jnp.square(params.sight)) & jnp.isfinite(traversable)
    grass, pane = jnp.clip(-traversable, -params.opens, params.opens), params.pane - traversable
    said = jnp.where(returned, grass, jnp.clip(pane, -params.clears, params.closes))
    return jnp.where(asked & jnp.any(observation.image_valid), _moves(params, observation) * said, 0.0)


def evidence(
    spec: NetworkSpec, pose: Float[Array, "3"], p_dead: Array, confidence: Array, barred: Array, local_map: LocalMap
) -> Evidence:
    """From the network's grid to the window: each of its cells reads the network's cell under its centre."""
    h, w = local_map.occupancy.shape
    x, y = geometry.cell_centres((h, w), local_map.origin, local_map.resolution)
    odom = jnp.stack(jnp.broadcast_arrays(x, y), axis=-1)
    local = geometry.transform(geometry.inverse(pose), odom)
    origin = jnp.asarray(spec.bev.origin, jnp.float32)
    grid = lambda values: GridMap(values, origin, jnp.asarray(spec.bev.resolution, jnp.float32))  # noqa: E731
    return Evidence(
        p_dead=geometry.sample_nearest(grid(p_dead), local, fill=0.0),
        confidence=geometry.sample_nearest(grid(confidence), local, fill=0.0),
        blocked=geometry.sample_nearest(grid(barred), local, fill=0.0),
    )


@functools.cache
def predictor(spec: NetworkSpec) -> Callable[[FusionParams, Observation, LocalMap], Evidence]:
    """The predictor of a network; the same function for the same Spec, so that nothing compiles twice."""

    def predict(params: FusionParams, observation: Observation, local_map: LocalMap) -> Evidence:
        """Evidence of the network; of the geometric rule for a robot without cameras."""
        if not observation.images.shape[0]:
            return geometric.predict(params.rule, observation, local_map)
        out = answer(spec, params, observation, local_map)
        known = bev.classes(spec.bev, local_map, observation.pose)
        sound = jnp.isfinite(out.dead)
        p_dead = jnp.where(sound, jax.nn.sigmoid(out.dead), 0.5)
        confidence = jnp.where(sound, trust(spec, params, observation, known), 0.0)
        barred = blocked(spec, params, observation, known, out.traversable)
        # once, or the network's last layers would be computed anew for each cell of the window
        p_dead, confidence, barred = grids.once((p_dead, confidence, barred))
        found = evidence(spec, observation.pose, p_dead, confidence, barred, local_map)
        return found._replace(repeats=jnp.asarray(params.repeats, jnp.float32))

    return predict
