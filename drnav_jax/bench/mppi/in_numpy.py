"""The task in NumPy, over all samples and, but for the limited accelerations, all steps at once, on one thread."""

from collections.abc import Callable

import numpy as np

from drnav_jax.bench.mppi.task import Task, Update, weighted


def rollout(task: Task) -> Callable[[np.ndarray], np.ndarray]:
    """A function from the noise `[T, 2, K]` to the running costs `[K]`."""
    layers, reach, (height, width) = task.layers, task.reach[:, None], task.cost.shape
    u, sigma, dt = task.control[:, :, None], task.sigma[:, None], np.float32(task.dt)
    per_cell = np.float32(1.0 / task.resolution)
    start = task.pose[:2] - task.origin

    def run(eps: np.ndarray) -> np.ndarray:
        speeds = u + sigma * eps
        last = np.broadcast_to(task.twist[:, None], speeds.shape[1:])
        for now in speeds:
            np.maximum(now, last - reach, out=now)
            np.minimum(now, last + reach, out=now)
            last = now
        v, w = speeds[:, 0], speeds[:, 1]
        yaw = np.cumsum(w, axis=0) * dt
        yaw = np.concatenate([np.zeros_like(yaw[:1]), yaw[:-1]]) + task.pose[2]
        x = start[0] + np.cumsum(v * np.cos(yaw), axis=0) * dt
        y = start[1] + np.cumsum(v * np.sin(yaw), axis=0) * dt
        col = np.clip((x * per_cell).astype(np.int32), 0, width - 1)
        row = np.clip((y * per_cell).astype(np.int32), 0, height - 1)
        price = layers.take(row * width + col, axis=0)
        beyond = task.goal - task.origin
        away = np.sqrt(np.square(x - beyond[0]) + np.square(y - beyond[1]))
        return np.sum(away + price[..., 0] + price[..., 1] * (np.abs(v) * dt), axis=0)

    return run


def updater(task: Task) -> Callable[[np.ndarray], Update]:
    """A function from the noise `[T, 2, K]` to the update."""
    run = rollout(task)

    def update(eps: np.ndarray) -> Update:
        running = run(eps)
        return Update(weighted(task, eps, running), running)

    return update
