"""The task that every MPPI of this benchmark does, as plain NumPy arrays.

With c = u + sigma eps the controls of a sample, and v_0, omega_0 measured,

    v_t = clip(c_t, v_{t-1} -+ a dt),  omega alike;   x_t = x_{t-1} + v_t dt cos(yaw_{t-1}),  y alike;
    yaw_t = yaw_{t-1} + omega_t dt                                                                                       (1)
    R = sum_t |x_t - goal| + w_o cost(x_t) / 254 + w_r risk(x_t) |v_t| dt                                                (2)
    J = R + temperature sum_axes 1 / sigma^2 sum_t u_t (c_t - u_t),   w = exp(-(J - min J) / temperature), normalised    (3)
    u <- sum w c                                                                                                         (4)

without smoothing or clamps, which `pytorch_mppi` has not. Costmap and risk hold numbers that every number format in use
here represents exactly, and are read at the cell under the robot's centre.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from drnav_jax.planning import costmap
from drnav_jax.planning.costmap import InflationParams

RADIUS = 0.25  # [m] of the robot
RISK_STEP = 1.0 / 65535.0  # the finest that `mppi_critics.pack` keeps


class Task(NamedTuple):
    """Where the robot is, what it knows, and the numbers of the equations."""

    pose: np.ndarray  # [3] x, y, yaw [m, rad]
    twist: np.ndarray  # [2] v, omega [m/s, rad/s]
    goal: np.ndarray  # [2] [m]
    cost: np.ndarray  # [H, W] float32, whole numbers 0..254
    risk: np.ndarray  # [H, W] float32, multiples of `RISK_STEP` in 0..1
    origin: np.ndarray  # [2] [m]
    resolution: float  # [m]
    control: np.ndarray  # [T, 2] u: v [m/s], omega [rad/s]
    sigma: np.ndarray  # [2] of v [m/s] and of omega [rad/s]
    accelerations: np.ndarray  # [2] a [m/s^2] and that of omega [rad/s^2]
    dt: float = 0.05  # [s]
    temperature: float = 0.3
    cost_weight: float = 1.0  # w_o
    risk_weight: float = 3.0  # w_r [1/m]

    @property
    def reach(self) -> np.ndarray:
        """Most that v [m/s] and omega [rad/s] change in a step `[2]`."""
        return (self.accelerations * self.dt).astype(np.float32)

    @property
    def layers(self) -> np.ndarray:
        """Prices of the cells `[H W, 2]` float32, row by row: w_o cost / 254 per point, w_r risk per metre."""
        both = [self.cost * (self.cost_weight / 254.0), self.risk * self.risk_weight]
        return np.stack([a.ravel() for a in both], axis=1).astype(np.float32)


class Update(NamedTuple):
    """What one update gives."""

    control: np.ndarray  # [T, 2]
    running: np.ndarray  # [K] R of (2)


def price_of_noise(task: Task, eps: np.ndarray) -> np.ndarray:
    """The second part of J (3), `[K]`, of the noise `[T, 2, K]`."""
    pull = (task.temperature / task.sigma * task.control).astype(np.float32)
    return pull.ravel() @ eps.reshape(pull.size, -1)


def weighted(task: Task, eps: np.ndarray, running: np.ndarray) -> np.ndarray:
    """The weights of (3) and the controls of (4), `[T, 2]`, of the noise `[T, 2, K]` and its running costs `[K]`."""
    total = running + price_of_noise(task, eps)
    weight = np.exp((total.min() - total) * np.float32(1.0 / task.temperature))
    mean = (eps.reshape(-1, weight.size) @ weight).reshape(-1, 2) / weight.sum()
    return task.control + task.sigma * mean


def make(num_steps: int = 56, seed: int = 0, size: int = 256, resolution: float = 0.05) -> Task:
    """A robot on its way among boxes, with a dead end to its left.

    Args:
        num_steps: T.
        seed: Of the boxes, the controls and the motion.
        size: Edge of the map [cells].
        resolution: Edge of a cell [m].
    """
    rng = np.random.default_rng(seed)
    occupied = np.zeros((size, size), bool)
    for row, col in rng.integers(0, size - 8, (size * size // 1500, 2)):
        occupied[row : row + 8, col : col + 8] = True
    middle, free = size // 2, int(0.6 / resolution)
    occupied[middle - free : middle + free, middle - free : middle + free] = False
    cells: Any = ndimage.distance_transform_edt(~occupied)
    distance = jnp.asarray(cells * resolution, jnp.float32)
    cost = np.asarray(costmap.inflation(distance, RADIUS, InflationParams()), np.float32)
    centre = (np.arange(size) + 0.5) * resolution - 0.5 * size * resolution
    risk = np.exp(-(np.square(centre - 1.0)[:, None] + np.square(centre - 0.8)[None, :]))
    speeds = np.asarray([0.35, 0.2]) + rng.normal(0, 0.05, (num_steps, 2))
    f32 = lambda a: np.asarray(a, np.float32)  # noqa: E731
    return Task(
        pose=f32([0.012, -0.017, 0.3]), twist=f32([0.3, 0.1]), goal=f32([4.0, 2.5]),
        cost=np.minimum(cost, 254.0), risk=f32(np.round(risk / RISK_STEP) * RISK_STEP),
        origin=np.full(2, -0.5 * size * resolution, np.float32), resolution=resolution,
        control=speeds.astype(np.float32), sigma=f32([0.2, 0.4]), accelerations=f32([3.0, 3.5]),
    )  # fmt: skip
