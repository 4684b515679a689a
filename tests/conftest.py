"""What holds for every test: the device, the compile cache, shape checks and strict promotion."""

import contextlib
import os
import signal
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# Before the first import of jax, which reads them once.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# The suite compiles thousands of programs and runs each for milliseconds: without LLVM's optimizer and the newer loop
# emitters it takes well under half the time. An XLA_FLAGS that is set wins, also an empty one (`make test-all`).
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false")

import hypothesis  # noqa: E402
import jax  # noqa: E402
import jaxtyping  # noqa: E402
import pytest  # noqa: E402

# Every program is cached, however small: the suite compiles many and runs each for milliseconds.
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".jax_cache"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

# Shapes in signatures are checked at each call. Holds for modules imported from here on, so no
# module of the package may be imported above this line. NamedTuples pass through vmap, scan and
# tree.map unchecked; a dataclass that is a pytree with jaxtyping fields would be checked when it
# is rebuilt there, and fail.
jaxtyping.install_import_hook("drnav_jax", "beartype.beartype")

# The first example compiles, so a deadline says nothing; derandomized, because the same commit
# shall give the same result.
hypothesis.settings.register_profile("drnav", deadline=None, derandomize=True)
hypothesis.settings.load_profile("drnav")


# Files that take longest, longest first: two workers that take whole files end together only if none begins late.
LONGEST = (
    "test_evaluate", "test_cli", "test_step", "test_gather", "test_readme", "test_driving", "test_cli_learn",
    "test_navigator", "test_job", "test_network", "test_fusion", "test_labels", "test_mjx", "test_families",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """Longest files first; all else stays in order."""
    rank = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(LONGEST)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Runs a test's body without implicit dtype or rank promotion, unless it is marked `relaxed`.

    Fixtures stay outside: one that both kinds share must not depend on which test came first.
    """
    with contextlib.ExitStack() as stack:
        if item.get_closest_marker("relaxed") is None:
            stack.enter_context(jax.numpy_dtype_promotion("strict"))
            stack.enter_context(jax.numpy_rank_promotion("raise"))
        return (yield)


@pytest.fixture(scope="module", autouse=True)
def forget_programs():
    """Drops compiled programs once they hold many memory mappings, of which Linux grants a process 65,530."""
    yield
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > 40_000:
        jax.clear_caches()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recordings, maps and scans; the test is skipped where there is none."""
    named = os.environ.get("DRNAV_DATA")
    folder = Path(named).expanduser() if named else ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        where = f"DRNAV_DATA={named}" if named else "../shared/data beside the checkout"
        pytest.skip(f"needs real input data: {where} is not there; set DRNAV_DATA to its folder.")
    return folder


@pytest.fixture
def ctrl_c():
    """Ctrl-C raises KeyboardInterrupt, also where this process was started with SIGINT ignored (a background job)."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
