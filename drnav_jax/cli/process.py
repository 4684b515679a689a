"""What the command line sets for its whole process, which a library must not do: caches, memory, devices."""

import contextlib
import ctypes
import os
import signal
import sys
import threading
from pathlib import Path

import jax

# glibc's malloc.h
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX, _ARENA_MAX = -1, -2, -4, -8
_PAD = 256 << 20  # [bytes] by which the heap grows at least


def prepare() -> None:
    """What every process does first."""
    cache_programs()
    keep_memory()


def end_as_interrupted() -> None:
    """SIGTERM ends this process as Ctrl-C does, so that what is finished is kept and no worker is left behind."""
    if threading.current_thread() is threading.main_thread():  # no other may say so
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def cache_programs() -> None:
    """Keep compiled programs for the next command, unless somebody has already said where."""
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(root) / "drnav_jax"
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def keep_memory() -> bool:
    """Keep freed memory for the next allocation; whether this system can (Linux with glibc).

    XLA allocates a program's temporary arrays anew at each call. Large ones glibc takes from the kernel and gives back,
    so that every call faults in all its pages again: a third of the CPU time of a training step.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    wanted = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, -1), (_TOP_PAD, _PAD), (_ARENA_MAX, 1))
    return all([mallopt(option, value) == 1 for option, value in wanted])


def use_every_core() -> None:
    """Without an accelerator each core is a device of its own: parts of a batch then never wait for each other."""
    if jax.config.values["jax_platforms"] in ("cpu", None) and jax.config.values["jax_num_cpu_devices"] < 1:
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
