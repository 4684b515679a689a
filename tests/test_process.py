"""What the command line sets for its process."""

import subprocess
import sys

import pytest

SCRIPT = """
import resource, sys
import numpy as np
from drnav_jax.cli.process import keep_memory

if sys.argv[1] == "keep":
    assert keep_memory()
for _ in range(12):
    np.full(32 << 20, 1.0, np.uint8)  # 32 MiB, written and freed
    if _ == 1:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(mode):
    return int(subprocess.run([sys.executable, "-c", SCRIPT, mode], check=True, capture_output=True, text=True).stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere the system's allocator is left alone")
def test_memory_that_was_freed_is_not_faulted_in_again():
    assert faults("keep") < 100, "10 arrays of 8,192 pages"
