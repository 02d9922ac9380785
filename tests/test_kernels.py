"""Compiled kernels: what a checkout says of them, Ctrl-C, no compiler."""

from __future__ import annotations

import os
import pathlib
import signal
import subprocess
import sys
import threading
import time
import zipfile

import numpy as np
import pytest

from jaxcal import compiled
from jaxcal.selection.policy.kernel import look_ahead

ROOT = pathlib.Path(__file__).parents[1]


@pytest.fixture
def package(tmp_path):
    """A package with one kernel, compiled."""
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "some_kernel.py").write_text("import cython\n")
    module = f"some_kernel{compiled.EXTENSION_SUFFIXES[0]}"
    (folder / module).touch()
    os.utime(folder / "some_kernel.py", (1, 1))
    return folder


def test_nothing_is_said_of_a_kernel_that_is_up_to_date(package, capsys):
    compiled.check(package)
    assert capsys.readouterr().err == ""


def test_one_line_names_a_kernel_older_than_its_source(package, capsys):
    later = time.time() + 10
    os.utime(package / "some_kernel.py", (later, later))
    compiled.check(package)
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "package/some_kernel.py" in said
    assert f"pip install --no-deps -e {package.parent}" in said


def test_a_kernel_that_was_never_compiled_is_an_error(package):
    next(package.glob("*.so")).unlink()
    with pytest.raises(
        ImportError, match=r"not compiled: package/some_kernel\.py; run"
    ):
        compiled.check(package)


def test_ctrl_c_ends_a_kernel(rng):
    y = rng.normal(size=(8, 60_000))
    active = np.ones(60_000, bool)
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    began = time.perf_counter()
    with pytest.raises(KeyboardInterrupt):
        look_ahead(y, active, True, 40, False, None, np.empty((4, 60_000)))
    assert time.perf_counter() - began < 0.3 + 1.0


@pytest.mark.slow
def test_a_machine_without_a_compiler_builds_the_wheel(tmp_path):
    """The package ziglang compiles; needs a package index."""
    tools = tmp_path / "bin"
    tools.mkdir()
    environment = {k: v for k, v in os.environ.items() if k != "CC"}
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path, ROOT],
        env=environment | {"PATH": str(tools)},
        check=True,
    )
    names = zipfile.ZipFile(next(tmp_path.glob("*.whl"))).namelist()
    assert any(name.startswith("jaxcal/selection/policy/kernel.") for name in names)
    assert not [name for name in names if name.endswith(("kernel.py", ".pxd"))]


def test_the_first_answers_load_no_package_of_scipy():
    """Its packages take 0.3 to 1 s to load; kernels call BLAS all the same."""
    code = """
import sys
import numpy as np
from jaxcal import select
candidates = np.random.default_rng(0).random((50, 3))
for arguments in ((4,), (6,), (6, "exchange"), (4, "policy")):
    select(candidates, *arguments)
print([m for m in ("scipy.linalg", "scipy.spatial") if m in sys.modules])
import scipy.linalg.cython_blas
print(callable(scipy.linalg.cython_blas.__pyx_capi__.get), scipy.linalg.det([[2.0]]))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == ["[]", "True 2.0"]
