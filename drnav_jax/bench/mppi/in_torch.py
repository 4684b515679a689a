"""The task by `pytorch_mppi`, with dynamics and cost as its user would write them in torch. Extra `bench`.

Float32 on the CPU, in inference mode; of several ways to write them those that took the least time. The noise is
drawn afresh in every command, as the package has it.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from drnav_jax.bench.mppi.task import Task, Update, price_of_noise


class Controller:
    """`pytorch_mppi.MPPI` on a task.

    Args:
        task: What to do.
        num_samples: K.

    Raises:
        ImportError: If torch or pytorch_mppi is not installed.
    """

    def __init__(self, task: Task, num_samples: int) -> None:
        """Make the controller."""
        import pytorch_mppi  # pyright: ignore[reportMissingImports]
        import torch  # pyright: ignore[reportMissingImports]

        tensor: Callable[[Any], Any] = lambda a: torch.tensor(np.asarray(a, np.float32))  # noqa: E731
        height, width = task.cost.shape
        per_cell, dt, layers = 1.0 / task.resolution, task.dt, tensor(task.layers)
        (most_v, most_w), (goal_x, goal_y) = map(float, task.reach), map(float, task.goal - task.origin)

        def dynamics(state: Any, control: Any) -> Any:
            x, y, yaw, v, w = state.unbind(1)
            v = torch.clamp(control[:, 0], v - most_v, v + most_v)
            w = torch.clamp(control[:, 1], w - most_w, w + most_w)
            moved = dt * v
            return torch.stack([x + moved * torch.cos(yaw), y + moved * torch.sin(yaw), yaw + dt * w, v, w], dim=1)

        def cost(state: Any, control: Any) -> Any:
            del control
            x, y = state[:, 0], state[:, 1]
            col, row = ((a * per_cell).long().clamp_(0, n - 1) for a, n in ((x, width), (y, height)))
            price = layers.index_select(0, row * width + col)
            return torch.hypot(x - goal_x, y - goal_y) + price[:, 0] + price[:, 1] * (dt * state[:, 3].abs())

        self._torch, self._task, self._control = torch, task, tensor(task.control)
        self._state = tensor([*(task.pose[:2] - task.origin), task.pose[2], *task.twist])
        self._mppi = pytorch_mppi.MPPI(
            dynamics, cost, 5, torch.diag(tensor(task.sigma**2)), num_samples=num_samples, horizon=len(task.control),
            lambda_=task.temperature, U_init=self._control.clone(),
        )  # fmt: skip
        self._sample = self._mppi._sample_noise

    def use_threads(self, num: int) -> None:
        """Let torch use that many threads, in the whole process."""
        self._torch.set_num_threads(num)

    def command(self) -> Any:
        """One command from the task's controls, with fresh noise; the controls `[T, 2]` (tensor)."""
        with self._torch.inference_mode():
            self._mppi.U = self._control
            self._mppi.command(self._state, shift_nominal_trajectory=False)
        return self._mppi.U

    def update(self, eps: np.ndarray) -> Update:
        """The update with this noise `[T, 2, K]`."""
        scaled = np.ascontiguousarray(np.moveaxis(eps, 2, 0) * self._task.sigma)
        self._mppi._sample_noise = lambda shape: self._torch.tensor(scaled)
        try:
            control = self.command().numpy()
        finally:
            self._mppi._sample_noise = self._sample
        return Update(control, self._mppi.cost_total.numpy() - price_of_noise(self._task, eps))
