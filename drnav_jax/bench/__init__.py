"""Times of the parts next to their rivals, measured in turn within one run: `drnav bench`."""

from drnav_jax.bench.suite import run, table

__all__ = ["run", "table"]
