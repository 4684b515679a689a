"""How calls are timed next to each other, and by what slow hours are told from slow code."""

import os
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp


def interleaved(calls: list[Callable[[], object]], repeats: int, *, rest: float = 0.0) -> list[float]:
    """Median time [s] of each call; the calls take turns, so that a slow moment hits them all.

    Args:
        calls: What is timed.
        repeats: How often each is, after one round that warms up.
        rest: Pause before each [s]: threads of some libraries spin for a while before they sleep.
    """
    times: list[list[float]] = [[] for _ in calls]
    for k in range(repeats + 1):
        for call, spent in zip(calls, times, strict=True):
            if rest:
                time.sleep(rest)
            start = time.perf_counter()
            jax.block_until_ready(call())
            if k:  # the first round warms up
                spent.append(time.perf_counter() - start)
    return [statistics.median(spent) for spent in times]


def matmul() -> Callable[[], jax.Array]:
    """A 1024^3 float32 product, ready to be timed in turn with other calls."""
    square = jax.random.normal(jax.random.key(0), (1024, 1024), jnp.float32)
    product = jax.jit(lambda a: a @ a)
    return lambda: product(square)


def cores() -> int:
    """Processors that this process may use: the threads of XLA's pool."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
