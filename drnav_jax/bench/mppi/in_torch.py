"""The task by `pytorch_mppi`, with dynamics and cost as its user would write them in torch. Extra `bench`.

Float32 on the CPU, in inference mode, two table entries per cell in one row, limits of both speeds in one clamp. The noise
is drawn afresh in every command, as the package has it.
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
        per_cell, dt = 1.0 / task.resolution, task.dt
        layers, reach, goal = tensor(task.layers), tensor(task.reach), tensor(task.goal - task.origin)

        def dynamics(state: Any, control: Any) -> Any:
            pose, speeds = state[:, :3], state[:, 3:]
            speeds = torch.clamp(control, speeds - reach, speeds + reach)
            yaw, moved = pose[:, 2], dt * speeds[:, 0]
            step = torch.stack([moved * torch.cos(yaw), moved * torch.sin(yaw), dt * speeds[:, 1]], dim=1)
            return torch.cat([pose + step, speeds], dim=1)

        def cost(state: Any, control: Any) -> Any:
            del control
            place = state[:, :2]
            cell = (place * per_cell).long()
            price = layers[cell[:, 1].clamp(0, height - 1) * width + cell[:, 0].clamp(0, width - 1)]
            return torch.linalg.vector_norm(place - goal, dim=1) + price[:, 0] + price[:, 1] * (dt * state[:, 3].abs())

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
