"""A disc robot that drives like a unicycle, with inertia, grip and contact forces: MuJoCo's physics in JAX (MJX).

One compiled model serves all worlds: a robot of three joints (x, y, yaw) and a few obstacles, whose places and sizes
are replaced in each call by those nearest to the robot. The plane is enough: all obstacles are upright, and whatever
its height, one that stops a robot stops it. At the robot's height a cylinder is a sphere of the same radius, so the
contacts of MJX's fast pairs, sphere-box and sphere-sphere, are exact.

Three velocity servos act in the robot's frame: along it on the set-point u_v, across it on 0 (wheels roll, they do not
skid), and about it on u_omega. The set-points follow the command as fast as the acceleration limits allow. With the
mass M = mass + payload, a servo pushes with

    F = k ((1 - slip) u - w),   |F| <= grip M g,   k = M / h (1 - exp(-h / T)),   T = lag M / mass      (1)

where w is the robot's own speed and h the time step: this k gives, step by step, exactly the first-order response of
time constant T, and is stable for every lag (0 = at once, as across the robot). The yaw servo has the inertia in place
of M. An obstacle is met where its distance becomes negative; it is a stiff spring and damper without friction that
stops the robot within two steps, so what it enters stays below v_max h and a bit.

Importing this module does not import MuJoCo; the first step does.
"""

import contextlib
import dataclasses
import functools
import importlib
import io
import threading
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from drnav_jax.geometry import wrap_angle
from drnav_jax.sim.kinematic import FaultParams
from drnav_jax.sim.solids import BEYOND, Solids, collect, nearest
from drnav_jax.types import Command, RobotParams, Scalar
from drnav_jax.worlds.world import World

GRAVITY = 9.81  # [m/s^2]
MAX_SPEED = 20.0  # [m/s] and [rad/s]; only a robot that begins deep inside an obstacle is ever thrown out so fast
HALF_HEIGHT = 10.0  # [m] of the model's boxes: no contact is ever with their tops

_IMPORT = threading.Lock()


@dataclasses.dataclass(frozen=True)
class MjxSpec:
    """Sizes of the model.

    Attributes:
        timestep: h [s].
        num_boxes: Boxes that a world may have, a grid's walls included.
        num_posts: Cylinders that a world may have.
        near_boxes: Boxes that the model holds: those nearest to the robot at the beginning of a tick.
        near_posts: Cylinders that it holds.
        max_contacts: Contacts that are solved: the deepest.
        iterations: Newton iterations of the contact solver, which starts from the motion without contacts (from rest,
            MuJoCo's warm start here, one iteration ends anywhere). One is exact for one contact; among several at a
            time, paths stay within 5 cm in 5 s of those with many, and two or three are as good as many.
        ls_iterations: Iterations of its line search.
    """

    timestep: float = 0.0125
    num_boxes: int = 2048
    num_posts: int = 1024
    near_boxes: int = 8
    near_posts: int = 4
    max_contacts: int = 4
    iterations: int = 1
    ls_iterations: int = 4

    def __post_init__(self) -> None:
        """Check sizes."""
        if not 0 < self.timestep <= 0.05:
            raise ValueError(f"timestep must lie in (0, 0.05] s, got {self.timestep}.")
        counts = dataclasses.asdict(self)
        del counts["timestep"]
        for name, count in counts.items():
            if count < 1:
                raise ValueError(f"{name} must be >= 1, got {count}.")

    def steps_in(self, dt: float) -> int:
        """Time steps in a tick of `dt` [s].

        Raises:
            ValueError: If the tick is no multiple of the time step.
        """
        count = round(dt / self.timestep)
        if count < 1 or abs(count * self.timestep - dt) > 1e-6 * dt:
            raise ValueError(f"a tick must be a multiple of MjxSpec.timestep, got {dt} s and {self.timestep} s.")
        return count


class MjxParams(NamedTuple):
    """The robot's body and motors; its size and limits are `RobotParams`, its slip is in `FaultParams`."""

    lag: Scalar = 0.05  # [] time constant of the drive, unladen [s]
    turn_lag: Scalar = 0.05  # [] time constant of turning, unladen [s]
    mass: Scalar = 20.0  # [] unladen [kg]
    payload: Scalar = 0.0  # [] [kg], in the middle: mass and inertia grow alike
    grip: Scalar = 0.8  # [] coefficient of friction of the tyres on the ground


class Body(NamedTuple):
    """What the physics carries besides the pose."""

    velocity: Array  # [3] of the joints: x', y' in the world [m/s], yaw' [rad/s]
    setpoint: Array  # [2] u of eq. 1 [m/s, rad/s]
    contact: Array  # [] bool, whether it touched anything during the last tick
    depth: Array  # [] deepest it was inside an obstacle during the last tick [m]
    sound: Array  # [] bool; False once a state that was not finite had to be replaced by the last one that was


def uniform(key: PRNGKeyArray, low: Any, high: Any) -> Any:
    """Parameters drawn uniformly between two sets of them, leaf by leaf: `MjxParams`, `FaultParams` and the like."""
    ends, shape = jax.tree.flatten((low, high))
    half = len(ends) // 2
    drawn = [
        jax.random.uniform(k, jnp.shape(a), jnp.float32, a, b)
        for k, a, b in zip(jax.random.split(key, half), ends[:half], ends[half:], strict=True)
    ]
    return jax.tree.unflatten(jax.tree.structure(low), drawn)


def solids_of(worlds: list[World], spec: MjxSpec = MjxSpec()) -> Solids:  # noqa: B008 (immutable)
    """What stops a robot in each world of a batch, NumPy `[B, ...]`; see `solids.collect`.

    Raises:
        ValueError: If a world has more boxes or cylinders than the model takes; says how many and what to do.
    """
    return collect(worlds, spec.num_boxes, spec.num_posts)


def load() -> tuple[Any, Any]:
    """The modules `mujoco` and `mujoco.mjx`, imported without their talk on stdout."""
    with _IMPORT, contextlib.redirect_stdout(io.StringIO()):
        return importlib.import_module("mujoco"), importlib.import_module("mujoco.mjx")


def xml(spec: MjxSpec) -> str:
    """The model in MuJoCo's own format, with a robot of 1 kg and 1 kg m^2; see `fitted` for what is replaced."""
    solid = f'pos="{BEYOND} 0 0" contype="0" conaffinity="1" condim="1"'
    solids = [f'<geom type="box" size="1 1 {HALF_HEIGHT}" {solid}/>'] * spec.near_boxes
    solids += [f'<geom type="sphere" size="1" {solid}/>'] * spec.near_posts
    servo = 'site="axle" biastype="affine" gainprm="1" biasprm="0 0 -1" forcelimited="true" forcerange="-1 1"'
    return f"""
<mujoco>
  <option timestep="{spec.timestep}" gravity="0 0 0" integrator="Euler" solver="Newton" cone="pyramidal"
          iterations="{spec.iterations}" ls_iterations="{spec.ls_iterations}">
    <flag eulerdamp="disable" warmstart="disable"/>
  </option>
  <default><geom solref="{2 * spec.timestep} 1" solimp="0.9 0.95 0.001"/></default>
  <custom><numeric name="max_contact_points" data="{spec.max_contacts}"/></custom>
  <worldbody>
    {"".join(solids)}
    <body name="robot">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <joint name="yaw" type="hinge" axis="0 0 1"/>
      <geom type="sphere" size="0.25" contype="1" conaffinity="0" condim="1"/>
      <site name="axle"/>
    </body>
  </worldbody>
  <actuator>
    <general name="along" gear="1 0 0 0 0 0" {servo}/>
    <general name="across" gear="0 1 0 0 0 0" {servo}/>
    <general name="about" gear="0 0 0 0 0 1" {servo}/>
  </actuator>
</mujoco>"""


@functools.lru_cache(maxsize=16)
def model(spec: MjxSpec) -> tuple[Any, Any]:
    """The MJX model of a spec and its empty data, made once."""
    mujoco, mjx = load()
    with jax.ensure_compile_time_eval(), _mjx_promotion():
        made = mjx.put_model(mujoco.MjModel.from_xml_string(xml(spec)))
        return made, mjx.make_data(made)


@contextlib.contextmanager
def _mjx_promotion() -> Iterator[None]:
    """MJX relies on JAX's default promotion, whatever the caller has set."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def servos(spec: MjxSpec, params: MjxParams, robot: RobotParams, faults: FaultParams) -> dict[str, Array]:
    """Eq. 1 in the model's terms: gains `[3]` on set-point and speed, and force limits `[3]`; mass and inertia."""
    f32 = functools.partial(jnp.asarray, dtype=jnp.float32)
    mass = jnp.maximum(f32(params.mass), 1e-3)
    total = jnp.maximum(mass + f32(params.payload), 1e-3)
    inertia = 0.5 * total * f32(robot.radius) ** 2  # a disc
    lags = jnp.stack([f32(params.lag), f32(0.0), f32(params.turn_lag)]) * total / mass
    weight = jnp.stack([total, total, inertia])
    gain = weight / spec.timestep * -jnp.expm1(-spec.timestep / jnp.maximum(lags, 1e-6))
    slip = jnp.stack([f32(faults.slip_v), f32(0.0), f32(faults.slip_omega)])
    force = f32(params.grip) * total * GRAVITY
    # Turning, the wheels push at the rim.
    return {
        "setpoint_gain": gain * (1 - slip),
        "speed_gain": gain,
        "limit": jnp.stack([force, force, force * f32(robot.radius)]),
        "mass": total,
        "inertia": inertia,
    }


def fitted(spec: MjxSpec, params: MjxParams, robot: RobotParams, faults: FaultParams, near: Solids) -> Any:
    """The MJX model with this robot and these obstacles (`solids.nearest`)."""
    made, _ = model(spec)
    servo = servos(spec, params, robot, faults)
    nb, np_ = near.boxes.shape[0], near.posts.shape[0]
    radius = jnp.asarray(robot.radius, jnp.float32)
    place = jnp.concatenate([near.boxes[:, :2], near.posts[:, :2], jnp.zeros((1, 2), jnp.float32)])
    half_yaw = jnp.concatenate([0.5 * near.boxes[:, 2], jnp.zeros(np_ + 1, jnp.float32)])
    zero = jnp.zeros_like(half_yaw)
    size = jnp.concatenate([
        jnp.concatenate([near.boxes[:, 3:5], jnp.full((nb, 1), HALF_HEIGHT, jnp.float32)], axis=1),
        jnp.tile(near.posts[:, 2:], (1, 3)),
        jnp.broadcast_to(radius, (1, 3)),
    ])  # fmt: skip
    of_robot = jnp.asarray([False, True])  # bodies are the world and the robot
    mass = jnp.where(of_robot, servo["mass"], 0.0)
    # What the contact solver scales stiffness with: MuJoCo's mean over x, y (free) and z (fixed), and over angles.
    light = jnp.stack([2 / (3 * servo["mass"]), 1 / (3 * servo["inertia"])])
    gain = jnp.zeros_like(made.actuator_gainprm)
    return made.replace(
        geom_pos=jnp.concatenate([place, zero[:, None]], axis=1),
        geom_quat=jnp.stack([jnp.cos(half_yaw), zero, zero, jnp.sin(half_yaw)], axis=1),
        geom_size=size,
        geom_rbound=jnp.linalg.norm(size, axis=1),
        body_mass=mass,
        body_subtreemass=jnp.broadcast_to(servo["mass"], (2,)),
        body_inertia=jnp.where(of_robot[:, None], servo["inertia"], 0.0) * jnp.ones((1, 3), jnp.float32),
        body_invweight0=jnp.where(of_robot[:, None], light[None], 0.0),
        dof_invweight0=jnp.stack([1 / servo["mass"], 1 / servo["mass"], 1 / servo["inertia"]]),
        actuator_gainprm=gain.at[:, 0].set(servo["setpoint_gain"]),
        actuator_biasprm=gain.at[:, 2].set(-servo["speed_gain"]),
        actuator_forcerange=jnp.stack([-servo["limit"], servo["limit"]], axis=1),
    )


def init() -> Body:
    """A body at rest."""
    zero = jnp.zeros((), jnp.float32)
    return Body(
        velocity=jnp.zeros(3, jnp.float32), setpoint=jnp.zeros(2, jnp.float32), contact=jnp.asarray(False), depth=zero,
        sound=jnp.asarray(True),
    )  # fmt: skip


@functools.partial(jax.jit, static_argnames=("spec", "dt"))
def step(
    spec: MjxSpec,
    params: MjxParams,
    robot: RobotParams,
    solids: Solids,
    pose: Float[Array, "3"],
    body: Body,
    command: Command,
    dt: float = 0.1,
    faults: FaultParams = FaultParams(),  # noqa: B008 (immutable)
) -> tuple[Float[Array, "3"], Float[Array, "2"], Body]:
    """Drive for one tick.

    Args:
        spec: Sizes.
        params: Body and motors.
        robot: Radius and limits; the command is clipped to them, a command that is not a number counts as zero.
        solids: Of this world.
        pose: x, y, yaw [m, rad].
        body: From `init` or the last tick.
        command: The twist asked for.
        dt: The tick [s], a multiple of the time step; static.
        faults: Slip.

    Returns:
        (pose, twist, body) after the tick: yaw in [-pi, pi); the twist is that of the wheels, slip or not. All of it is
        finite if `pose` is: a state that is not is replaced by the last one, at rest, and `body.sound` says so.
    """
    _, mjx = load()
    _, empty = model(spec)
    steps, h = spec.steps_in(dt), spec.timestep
    fit = fitted(spec, params, robot, faults, nearest(solids, pose[:2], spec.near_boxes, spec.near_posts))
    v, omega = (jnp.where(jnp.isnan(u), 0.0, u) for u in (command.v, command.omega))
    target = jnp.stack([
        jnp.clip(v, robot.v_min, robot.v_max), jnp.clip(omega, -robot.w_max, robot.w_max)
    ])  # fmt: skip
    most = jnp.stack([jnp.asarray(a, jnp.float32) * h for a in (robot.a_max, robot.alpha_max)])

    def substep(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], Array]:
        q, speed, setpoint = carry
        setpoint = jnp.clip(target, setpoint - most, setpoint + most)
        ctrl = jnp.stack([setpoint[0], jnp.zeros((), jnp.float32), setpoint[1]])
        with _mjx_promotion():
            data = mjx.step(fit, empty.replace(qpos=q, qvel=speed, ctrl=ctrl))
        # The distance is that at the beginning of the step.
        met = jnp.min(data._impl.contact.dist)
        return (data.qpos, jnp.clip(data.qvel, -MAX_SPEED, MAX_SPEED), setpoint), met

    origin = jnp.stack([jnp.zeros((), jnp.float32), jnp.zeros((), jnp.float32), pose[2]])
    (q, velocity, setpoint), met = jax.lax.scan(substep, (origin, body.velocity, body.setpoint), None, length=steps)
    moved = jnp.stack([pose[0] + q[0], pose[1] + q[1], wrap_angle(q[2])])
    fine = jnp.all(jnp.isfinite(moved)) & jnp.all(jnp.isfinite(velocity)) & jnp.all(jnp.isfinite(setpoint))
    pose = jnp.where(fine, moved, pose)
    new = Body(
        velocity=jnp.where(fine, velocity, 0.0),
        setpoint=jnp.where(fine, setpoint, 0.0),
        contact=fine & jnp.any(met < 0),
        depth=jnp.where(fine, jnp.maximum(-jnp.min(met), 0.0), 0.0),
        sound=body.sound & fine,
    )
    return pose, _twist(pose, new, faults), new


def _twist(pose: Array, body: Body, faults: FaultParams) -> Array:
    """What the wheels do: the robot's own speed, and what slips."""
    along = jnp.cos(pose[2]) * body.velocity[0] + jnp.sin(pose[2]) * body.velocity[1]
    slip = jnp.stack([jnp.asarray(s, jnp.float32) for s in (faults.slip_v, faults.slip_omega)])
    return jnp.stack([along, body.velocity[2]]) + slip * body.setpoint
