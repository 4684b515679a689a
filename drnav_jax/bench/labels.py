"""Ground truth: the dead ends of one grid."""

import time

import numpy as np

from drnav_jax.worlds.labels import dead_ends


def label_time(repeats: int, size: int = 400, num_walls: int = 60) -> float:
    """CPU time [ms] to label a grid of 0.1 m cells full of walls, which has more gates than a floor of its size; the least.

    Args:
        repeats: How often it is done.
        size: Cells along an edge.
        num_walls: 0.3 m thick, 2 to 12 m long.
    """
    rng = np.random.default_rng(0)
    occupied = np.zeros((size, size), bool)
    for _ in range(num_walls):
        (i, j), long = rng.integers(0, size, 2), rng.integers(20, 120)
        rows, columns = (3, long) if rng.random() < 0.5 else (long, 3)
        occupied[i : i + rows, j : j + columns] = True
    took = []
    for _ in range(repeats):
        begin = time.process_time()
        dead_ends(occupied, 0.1)
        took.append(time.process_time() - begin)
    return 1e3 * min(took)
