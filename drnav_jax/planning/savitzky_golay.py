"""Nav2's smoothing of MPPI's control sequence: a Savitzky-Golay filter of 9 taps and second order.

    u~_t = sum_{j=-4}^{4} a_j u_{t+j},   a = (-21, 14, 39, 54, 59, 54, 39, 14, -21) / 231                                (1)

which is the value at t of the parabola fitted to the nine. On the left the sequence is continued by the last four commands
that were sent, on the right by its last value, which itself is kept. Sequences too short to smooth are left alone.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

TAPS = (-21.0, 14.0, 39.0, 54.0, 59.0, 54.0, 39.0, 14.0, -21.0)
HISTORY = 4
MIN_STEPS = 21


def smooth(sequence: Float[Array, "T n"], history: Float[Array, "4 n"]) -> Float[Array, "T n"]:
    """Equation (1) along the first axis.

    Args:
        sequence: T controls.
        history: The last four commands that were sent, the newest last.
    """
    steps = sequence.shape[0]
    if steps < MIN_STEPS:
        return sequence
    last = sequence[-1:]
    padded = jnp.concatenate([history, sequence, jnp.repeat(last, HISTORY, axis=0)])
    smoothed = sum(tap / 231.0 * padded[k : k + steps - 1] for k, tap in enumerate(TAPS))
    return jnp.concatenate([jnp.asarray(smoothed), last])
