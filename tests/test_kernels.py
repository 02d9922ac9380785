"""Compiled kernels: what a checkout says of them, Ctrl-C, no compiler."""

from __future__ import annotations

import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from unittest import mock

import pytest

from jaxcal import compiled

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
    assert f"{sys.executable} -m pip install --no-deps -e {package.parent}" in said


def test_a_kernel_that_was_never_compiled_is_an_error(package):
    next(package.glob("*.so")).unlink()
    with pytest.raises(
        ImportError, match=r"not compiled: package/some_kernel\.py; run"
    ):
        compiled.check(package)


def test_who_calls_no_kernel_minds_none(package, monkeypatch):
    """`jaxcal-rig stop` loads this package before it stops a drive."""
    later = time.time() + 10
    os.utime(package / "some_kernel.py", (later, later))
    gone = mock.Mock(write=mock.Mock(side_effect=OSError))
    monkeypatch.setattr(sys, "stderr", gone)
    compiled.check(package)
    assert gone.write.called
    monkeypatch.undo()
    next(package.glob("*.so")).unlink()
    monkeypatch.setenv(compiled.UNCHECKED, "1")
    compiled.check(package)
    assert (
        f'os.environ["{compiled.UNCHECKED}"]' in (ROOT / "rig/__init__.py").read_text()
    )


# Calls that take minutes, each in another compiled loop.
LONG = """
# JAX has Python call it after every collection of garbage, and Python drops
# whatever is raised there, a KeyboardInterrupt too.
import gc
gc.disable()
import numpy as np
import jaxcal
from jaxcal.selection.policy.policy_kernel import look_ahead

rng = np.random.default_rng(0)
rows, blocks = rng.random((2000, 3)), rng.normal(size=(300, 3, 12))
sphere = rng.normal(size=(2000, 9))
sphere /= np.linalg.norm(sphere, axis=1)[:, None]
y, active = rng.normal(size=(8, 60_000)), np.ones(60_000, bool)
calls = {
    "exchange of rows": lambda: jaxcal.select(rows, 9, "exchange", restarts=10**7),
    "exchange of blocks": lambda: jaxcal.select(
        blocks=blocks, k=9, method="exchange", restarts=10**7, criterion="A"
    ),
    "exchange for E": lambda: jaxcal.select(
        blocks=blocks, k=9, method="exchange", restarts=10**7, criterion="E"
    ),
    "branch and bound": lambda: jaxcal.select(
        blocks=blocks, k=9, method="exact", criterion="A", time_limit=300
    ),
    "branch and bound of E": lambda: jaxcal.select(
        blocks=blocks, k=9, method="exact", criterion="E", time_limit=300
    ),
    "volumes": lambda: jaxcal.select(sphere, 10, "exact", time_limit=300),
    "look-ahead": lambda: look_ahead(
        y, active, True, 40, False, np.empty((4, 60_000))
    ),
}
for name, call in calls.items():
    print(name, flush=True)
    try:
        call()
        print("ended by itself", flush=True)
    except KeyboardInterrupt:
        print("stopped", flush=True)
"""


def test_ctrl_c_ends_every_compiled_loop():
    with subprocess.Popen(
        [sys.executable, "-c", LONG], stdout=subprocess.PIPE, text=True
    ) as child:
        stopped = []
        for name in child.stdout:
            time.sleep(0.15)
            child.send_signal(signal.SIGINT)
            began = time.perf_counter()
            said = child.stdout.readline().strip()
            assert (name.strip(), said) == (name.strip(), "stopped")
            # Within 0.1 s; the rest is for machines where other tests run.
            assert time.perf_counter() - began < 0.1 + 0.9, name
            stopped.append(name)
        assert len(stopped) == LONG.count('": lambda')


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
    assert any(
        name.startswith("jaxcal/selection/policy/policy_kernel.") for name in names
    )
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


def test_several_threads_may_load_kernels_at_once():
    """One took the modules of BLAS that another was about to load."""
    code = """
import sys, threading
from jaxcal import compiled
sys.setswitchinterval(1e-6)
kernels = ["exchange.exchange_kernel", "exact.branch_kernel"] * 8
names = [f"jaxcal.selection.{kernel}" for kernel in kernels]
start = threading.Barrier(len(names))
def load(name):
    start.wait()
    try:
        compiled.kernel(name)
    except Exception as error:
        print(name, repr(error))
threads = [threading.Thread(target=load, args=[name]) for name in names]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout == ""


@pytest.mark.parametrize(
    "platform, flags, expected",
    [
        ("win-amd64", "", "x86_64 True ['-m', 'ziglang', 'cc', '-target', "
         "'x86_64-windows-gnu'] ['-lpython3']"),
        ("win-arm64", "", "aarch64 False ['-m', 'ziglang', 'cc', '-target', "
         "'aarch64-windows-gnu'] ['-lpython3']"),
        ("macosx-11.0-arm64", "", "aarch64 False ['-undefined', 'dynamic_lookup']"),
        ("macosx-11.0-arm64", "-arch x86_64", "x86_64 True ['-undefined', "
         "'dynamic_lookup']"),
        ("linux-aarch64", "", "aarch64 False ['-lm']"),
    ],
)  # fmt: skip
def test_kernels_are_for_the_processor_that_the_wheel_is_for(platform, flags, expected):
    """Not for the one that builds: cibuildwheel and crossenv set these."""
    code = """if True:
        import hatch_build as b
        windows = b.WINDOWS and b.compiler() is None and "-fPIC" not in b.FLAGS
        link = [flag[:9] for flag in b._link() if flag[:2] in ("-l", "-u")]
        link = b._link()[1:] if b.MACOS else link
        print(b.machine(), b.X86, *([b._zig()[1:]] if windows else []), link)
    """
    given = {"_PYTHON_HOST_PLATFORM": platform, "ARCHFLAGS": flags, "CC": ""}
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | given, cwd=ROOT,
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.strip() == expected


SANITIZED = """
    information/test_whitening.py models/test_serial_chain.py adaptive/test_fit_ahead.py
    adaptive/test_lookahead.py selection/test_inference.py selection/test_exchange.py
    selection/test_exact_criteria.py selection/test_exact_complement.py
    selection/test_exact_few_readings.py selection/test_volume.py
    selection/test_travel.py
"""


@pytest.mark.slow
def test_sanitizers_of_addresses_and_undefined_behaviour_report_nothing(tmp_path):
    """Every kernel, built with GCC's, under the quick tests that call it."""
    libraries = [
        subprocess.run(
            ["gcc", f"-print-file-name={name}.so"], capture_output=True, text=True
        ).stdout.strip()
        for name in ("libasan", "libubsan")
        if shutil.which("gcc")
    ]
    if not libraries or not all(pathlib.Path(path).is_absolute() for path in libraries):
        pytest.skip("GCC's sanitizers are not on this machine")
    for folder in ("jaxcal", "tests", "benchmarks", "examples", "checkpoints"):
        ignored = shutil.ignore_patterns("*.so", "__pycache__")
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=ignored)
    for name in ("pyproject.toml", "hatch_build.py", "README.md"):
        shutil.copy(ROOT / name, tmp_path)
    flags = "-fsanitize=address,undefined -fno-omit-frame-pointer -g1"
    subprocess.run(
        [sys.executable, "hatch_build.py"], cwd=tmp_path, check=True,
        env={**os.environ, "CC": "gcc", "CFLAGS": flags},
    )  # fmt: skip
    log = tmp_path / "report"
    checked = {
        "LD_PRELOAD": " ".join(libraries),
        "ASAN_OPTIONS": f"detect_leaks=0:log_path={log}",
        "UBSAN_OPTIONS": f"print_stacktrace=1:log_path={log}",
        "PYTHONMALLOC": "malloc",
        "PYTHONPATH": str(tmp_path),
        "OPENBLAS_NUM_THREADS": "1",
    }
    files = [f"tests/{name}" for name in SANITIZED.split()]
    options = ["-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not slow"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *files], cwd=tmp_path,
        env={**os.environ, **checked}, capture_output=True, text=True,
    )  # fmt: skip
    reports = [path.read_text() for path in tmp_path.glob("report.*")]
    assert not reports, "\n".join(reports)[:5000]
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
