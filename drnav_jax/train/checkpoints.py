"""Checkpoints by orbax: written whole or not at all, the last few and the best kept."""

from pathlib import Path
from typing import Any

import jax

from drnav_jax.train.step import TrainState


class Checkpoints:
    """Folders `last/STEP` and `best/STEP` under one folder."""

    def __init__(self, folder: Path, keep: int) -> None:
        """Open or make them.

        Args:
            folder: Of the run.
            keep: How many of the last ones stay.
        """
        import orbax.checkpoint as ocp  # the `train` extra

        self._ocp = ocp
        make = lambda name, options: ocp.CheckpointManager((folder / name).absolute(), options=options)  # noqa: E731
        self._last = make("last", ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=False))
        self._best = make(
            "best",
            ocp.CheckpointManagerOptions(
                max_to_keep=1, best_fn=lambda said: said["score"], best_mode="max", enable_async_checkpointing=False
            ),
        )

    @property
    def latest(self) -> int | None:
        """Step of the last checkpoint; None where there is none."""
        return self._last.latest_step()

    @property
    def best(self) -> int | None:
        """Step of the best one; None where there is none."""
        return self._best.best_step()

    def save(self, state: TrainState) -> None:
        """Keep a state as the last one."""
        self._last.save(int(state.step), args=self._ocp.args.StandardSave(jax.device_get(state)), force=True)

    def offer(self, state: TrainState, score: float) -> None:
        """Keep a state if none before scored higher."""
        held = self._best.best_step()
        if held is not None and int(state.step) <= held:
            return  # gone back to before the best one: it is there already
        args = self._ocp.args.StandardSave(jax.device_get(state))
        self._best.save(int(state.step), args=args, metrics={"score": score}, force=True)

    def load(self, like: TrainState, best: bool = False) -> TrainState:
        """The last (or best) state.

        Args:
            like: A state of the same shapes.
            best: The best one instead.

        Raises:
            ValueError: If there is none, or it is of another network.
        """
        manager = self._best if best else self._last
        step = manager.best_step() if best else manager.latest_step()
        if step is None:
            raise ValueError("there is no checkpoint to go on from: start without --resume.")
        shapes: Any = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), jax.device_get(like))
        try:
            held: Any = manager.restore(step, args=self._ocp.args.StandardRestore(shapes))
            other = [  # orbax pads and cuts arrays of other shapes
                f"{jax.tree_util.keystr(path)} has shape {a.shape}, not {b.shape}"
                for (path, a), b in zip(jax.tree.leaves_with_path(held), jax.tree.leaves(shapes), strict=True)
                if a.shape != b.shape
            ]
            if other:
                raise ValueError(other[0])
            return held
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"checkpoint {step} does not fit this network ({str(error).splitlines()[0]}): train with the settings "
                "it was begun with, or choose another --out."
            ) from None

    def close(self) -> None:
        """Finish what is being written."""
        self._last.close()
        self._best.close()
