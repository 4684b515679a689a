"""What figures were measured on."""

import platform
import re
from pathlib import Path
from typing import Any

import jax

from drnav_jax.bench.timing import cores


def machine() -> dict[str, Any]:
    """What this was measured on."""
    info = Path("/proc/cpuinfo")
    named = re.search(r"model name\s*:\s*(.*)", info.read_text() if info.exists() else "")
    return {
        "cores": cores(),
        "cpu": named[1] if named else platform.processor() or platform.machine(),
        "platform": platform.platform(),
        "device": jax.default_backend(),
        "jax": jax.__version__,
        "python": platform.python_version(),
    }
