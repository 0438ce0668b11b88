"""Shared set-up: float64 available, rank promotion forbidden, shapes and types checked at run time.

Compiling is most of what the tests do, and what they compile runs once on small shapes. So the
compiler optimises nothing, here and in the processes that tests start.
"""

import atexit
import ctypes
import gc
import importlib
import os
from importlib.metadata import version
from pathlib import Path

# Read as NumPy is imported. Other threads of BLAS would spin while they wait.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from jaxtyping import install_import_hook

import tests.support.type_checks  # noqa: F401  (found by its name, below)

# Each worker has one core: a module in many parts, to be compiled at once, is only more work.
COMPILER = ["--xla_backend_optimization_level=0", "--xla_cpu_parallel_codegen_split_count=1"]
# What the passes over loops find saves nothing in loops of a few rounds: a seventh of the time.
LOOPS = "simplify-while-loops", "while-loop-constant-sinking", "while-loop-invariant-code-motion"
COMPILER.append(f"--xla_disable_hlo_passes={','.join(LOOPS)}")
if version("jax").startswith("0.10."):  # removed later, and XLA stops at a flag it does not know
    # Fusions as LLVM's loops instead of MLIR's: a third of the time to compile a filter.
    COMPILER.append("--xla_cpu_use_fusion_emitters=false")
# Each of them once, in a worker of pytest-xdist too: the cache's keys hold the flags as they stand.
FLAGS = [*os.environ.get("XLA_FLAGS", "").split(), *COMPILER]
os.environ["XLA_FLAGS"] = " ".join(dict.fromkeys(FLAGS))
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# The workers and the processes that tests start share what they compile through the cache, small
# programs too.
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"

# Python compiles what is imported for the first time. Workers that begin at two ends share this.
if os.environ.get("PYTEST_XDIST_WORKER", "gw0")[-1] in "13579":
    for name in ("bokeh.plotting", "matplotlib.figure", "pandas", "scipy.signal", "scipy.stats"):
        importlib.import_module(name)

# Every annotated shape and type is checked, in the tests alone.
install_import_hook("gnio_jax", "tests.support.type_checks.when_called")

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
# What is shared out among devices is shared out on every machine.
jax.config.update("jax_num_cpu_devices", 2)

# Tracing makes objects by the million, and hardly any of them in cycles.
gc.set_threshold(100_000, 50, 100)

# The files that take longest, in this order: begun first, they leave no worker alone at the end.
LONGEST = (
    "test_parallel.py",
    "test_installed.py",
    "tables/test_make.py",
    "training/test_recordings.py",
    "training/test_window_task.py",
    "calibration/test_calibrate.py",
    "training/test_through_filter.py",
    "filtering/test_derivatives.py",
    "filtering/test_tracker.py",
    "evaluation/test_estimate.py",
    "filtering/test_consistency.py",
    "filtering/test_smoother.py",
    "filtering/test_considered.py",
    "filtering/test_scan.py",
    "training/test_loop.py",
    "filtering/test_run_odometry.py",
    "models/test_contract.py",
    "evaluation/test_evaluate.py",
    "apps/live/test_command.py",
    "data/readers/test_oxiod.py",
    "test_docs.py",
    "data/test_fuzz.py",
)


def pytest_configure(config):
    """A worker ends at once: JAX would take seconds to free what its process holds."""
    if hasattr(config, "workerinput"):
        atexit.register(os._exit, 0)


def pytest_collection_modifyitems(items):
    tests = Path(__file__).parent
    places = {tests / name: position for position, name in enumerate(LONGEST)}
    gone = [str(path) for path in places if not path.exists()]
    assert not gone, f"tests/conftest.py: LONGEST names what is not there: {gone}"
    items.sort(key=lambda item: places.get(item.path, len(LONGEST)))


MOST_MEMORY, MOST_MAPS = 1.4e9, 30_000
"""Bytes of a worker, and its memory maps: Linux grants a process 65,530, and XLA crashes without a
word where they end."""


@pytest.fixture(scope="module", autouse=True)
def programs_that_fit():
    """Compiled programs are let go before they fill the memory.

    What stays, no collection of garbage looks at again.
    """
    yield
    if used_too_much():
        gc.unfreeze()
        jax.clear_caches()
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)  # what is free returns to the system
    gc.collect()
    gc.freeze()


def used_too_much():
    """Whether this worker holds more than it should; never, where there is no /proc to ask."""
    process = Path("/proc/self")
    if not process.exists():
        return False
    resident = int((process / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return resident > MOST_MEMORY or (process / "maps").read_bytes().count(b"\n") > MOST_MAPS


@pytest.fixture(scope="session")
def recordings():
    """The folder of real recordings, $GNIO_DATA/<name>; tests that ask for it are skipped, and say
    so, without it."""
    root = os.environ.get("GNIO_DATA")
    if not root or not Path(root).is_dir():
        pytest.skip(
            "real recordings: set GNIO_DATA to a folder that holds oxiod/, tlio_layout/, ..."
        )
    return Path(root)
