"""What the command line sets for its process."""

import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from drnav_jax.cli import process

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


@pytest.fixture
def sigterm():
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


def test_sigterm_ends_as_ctrl_c_does(sigterm):
    process.end_as_interrupted()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)


def test_a_thread_leaves_signals_alone(sigterm):
    before = signal.getsignal(signal.SIGTERM)
    with ThreadPoolExecutor(1) as pool:
        pool.submit(process.end_as_interrupted).result()
    assert signal.getsignal(signal.SIGTERM) is before
