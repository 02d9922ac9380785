"""Shared fixtures. Silent broadcasting is the commonest bug here, so it is an error."""

from __future__ import annotations

import atexit
import os
import pathlib
import shutil
import signal
import tempfile

# A shell that runs the tests in the background has SIGINT ignored, and every program
# that a test starts and interrupts would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# One cache of compiled programs for every test process, so subprocess tests start fast.
_CACHE = pathlib.Path(__file__).parent.parent / ".cache" / "jax"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # see runtime/cache.py

# Threads of numpy wait for one another on a busy core: 35 s for what takes one .6.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Locks of each test process are its own: a stop asks, and ends, who holds a bus, which
# may be a test in another process, or a device that this computer moves.
os.environ["JAXCAL_RIG_LOCKS"] = tempfile.mkdtemp(prefix="jaxcal-locks-")
atexit.register(shutil.rmtree, os.environ["JAXCAL_RIG_LOCKS"], ignore_errors=True)

import hypothesis
import jax
import numpy as np
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")

# A loaded machine is slow, not wrong: no example has a deadline. `make test` draws the
# same examples every time; `make test-all` draws new ones (--hypothesis-profile=new).
hypothesis.settings.register_profile("same", deadline=None, derandomize=True)
hypothesis.settings.register_profile("new", deadline=None)
hypothesis.settings.load_profile("same")


# Folders of tests in which a warning that no test expects is an error; wanted: all.
MENDED = (
    *("calibration", "commands", "docs", "evaluation", "information", "models"),
    *("selection", "tables"),
)
# What a calibration that is not good is told is what many of these tests are about.
NOT_GOOD = ("calibration", "models")


def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.parent.name in MENDED:  # before what tests and modules say
            ignored = ["ignore::jaxcal.CalibrationWarning"]
            for rule in ignored * (item.path.parent.name in NOT_GOOD) + ["error"]:
                item.add_marker(pytest.mark.filterwarnings(rule), append=False)


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Compiled programs hold memory maps, of which Linux allows 65,530 a process: one
    that runs every slow test would abort."""
    yield
    maps = pathlib.Path("/proc/self/maps")
    if maps.exists() and len(maps.read_text().splitlines()) > 20_000:
        jax.clear_caches()


@pytest.fixture
def key() -> jax.Array:
    return jax.random.key(0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
