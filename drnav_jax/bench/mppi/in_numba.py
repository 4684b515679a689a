"""The task in Numba: one loop over the samples, shared by threads, that keeps each robot in registers. Extra `bench`."""

import inspect
import math
from collections.abc import Callable

import numpy as np

from drnav_jax.bench.mppi.task import Task, Update, weighted


def use_threads(num: int) -> None:
    """Let that many threads share the samples, as far as there are processors."""
    import numba  # pyright: ignore[reportMissingImports]

    numba.set_num_threads(min(num, numba.config.NUMBA_NUM_THREADS))


def updater(task: Task) -> Callable[[np.ndarray], Update]:
    """A function from the noise `[T, 2, K]` to the update.

    Raises:
        ImportError: If Numba is not installed.
    """
    import numba  # pyright: ignore[reportMissingImports]

    def roll(eps, control, sigma, reach, twist, pose, goal, layers, height, width, per_cell, dt):
        num_steps, _, num = eps.shape
        running = np.empty(num, np.float32)
        for k in numba.prange(num):
            x, y, yaw = pose
            v, w = twist
            total = np.float32(0.0)
            for t in range(num_steps):
                v = min(max(control[t, 0] + sigma[0] * eps[t, 0, k], v - reach[0]), v + reach[0])
                w = min(max(control[t, 1] + sigma[1] * eps[t, 1, k], w - reach[1]), w + reach[1])
                x += v * dt * math.cos(yaw)
                y += v * dt * math.sin(yaw)
                yaw += w * dt
                col = min(max(int(x * per_cell), 0), width - 1)
                row = min(max(int(y * per_cell), 0), height - 1)
                cell = row * width + col
                dx, dy = x - goal[0], y - goal[1]
                total += math.sqrt(dx * dx + dy * dy) + layers[cell, 0] + layers[cell, 1] * abs(v) * dt
            running[k] = total
        return running

    # unwrapped: under a shape-checking import hook (jaxtyping's) it is not a plain function, and Numba reads no other.
    # Fast: sums and products may be reordered, and nothing here is infinite or NaN.
    program = numba.njit(parallel=True, fastmath=True)(inspect.unwrap(roll))
    height, width = task.cost.shape
    pose = (np.float32(task.pose[0] - task.origin[0]), np.float32(task.pose[1] - task.origin[1]), task.pose[2])
    given = (
        task.control, task.sigma, task.reach, (task.twist[0], task.twist[1]), pose, task.goal - task.origin,
        task.layers, height, width, np.float32(1.0 / task.resolution), np.float32(task.dt),
    )  # fmt: skip

    def update(eps: np.ndarray) -> Update:
        running = program(eps, *given)
        return Update(weighted(task, eps, running), running)

    return update
