"""`python -m drnav_jax.cli`."""

import sys

from drnav_jax.cli import main

sys.exit(main())
