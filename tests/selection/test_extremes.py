"""Kernels write within their arrays, whatever the inputs."""

from __future__ import annotations

import os
import pathlib
import shutil
import subprocess
import sys

import pytest

EXTREMES = pathlib.Path(__file__).parent / "extremes.py"


@pytest.mark.slow  # a minute
def test_no_kernel_writes_outside_its_arrays():
    tool = shutil.which("valgrind")
    if tool is None:
        pytest.skip("valgrind is not there")
    done = subprocess.run(
        [tool, "--undef-value-errors=no", "--quiet",
         sys.executable, str(EXTREMES)],
        env={**os.environ, "PYTHONMALLOC": "malloc", "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=1800, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    # Of the dynamic loader it says what is not so.
    wrong = [part for part in done.stderr.split("== \n") if "kernel.cpython" in part]
    assert not wrong, wrong[0]
    assert done.stdout.endswith("end\n")
