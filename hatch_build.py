"""Compile the kernels when the package is built; as a script, in this checkout.

A kernel is a file ``*kernel.py`` in Cython's pure Python mode. It is compiled with the
compiler in CC, the machine's or, where there is none and on Windows, with that of the
package ziglang, which the build then asks for; CFLAGS are added. On x86-64 each module
holds its code twice, for every processor and for those with AVX2 and FMA, and takes the
one that fits when it is loaded.
"""

from __future__ import annotations

import itertools
import os
import pathlib
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = pathlib.Path(__file__).parent.resolve()
SHARED = "jaxcal._shared"  # what Cython would repeat in every module
DIRECTIVES = {
    "language_level": 3,
    "infer_types": True,
    "boundscheck": False,
    "wraparound": False,
    "cdivision": True,
    "initializedcheck": False,
}
# What is built for: of cibuildwheel and crossenv not the machine that builds.
PLATFORM = sysconfig.get_platform()
WINDOWS, MACOS = PLATFORM.startswith("win"), PLATFORM.startswith("macosx")
FLAGS = ["-fno-math-errno", "-fno-trapping-math", "-w"]
FLAGS += [] if WINDOWS else ["-fPIC"]  # clang refuses it there
# Rounds as written, the same on every processor.
EXACT = ["-ffp-contract=off"]
# In a kernel with this line a product and a sum may be one operation, rounded once. The
# order of sums is as written: GCC keeps sums of several lanes in registers only then.
FUSES = "# Products may be fused."
FUSED = ["-ffp-contract=fast"]


def machine() -> str:
    """The processor that is built for, as compilers call it."""
    flags = shlex.split(os.environ.get("ARCHFLAGS", ""))  # macOS
    given = {after for flag, after in itertools.pairwise(flags) if flag == "-arch"}
    if len(given) > 1:
        raise SystemExit(
            f"ARCHFLAGS must name one processor, got {' '.join(sorted(given))}: "
            "build a wheel for each"
        )
    name = given.pop() if given else PLATFORM.rpartition("-")[2]
    if name not in ("x86_64", "amd64", "arm64", "aarch64"):  # universal2, win32
        name = platform.machine().lower()
    return {"amd64": "x86_64", "arm64": "aarch64"}.get(name, name)


X86 = machine() == "x86_64" and sys.maxsize > 2**32
# x86-64-v3 of the psABI: AVX2, FMA, BMI, LZCNT.
CHOICE = """\
#include <Python.h>
#include <cpuid.h>
PyObject *PyInit_NAME_any(void);
PyObject *PyInit_NAME_avx2(void);
static int has_avx2(void) {
    const unsigned fma_movbe_osxsave_avx = 1u << 12 | 1u << 22 | 1u << 27 | 1u << 28;
    const unsigned bmi_avx2_bmi2 = 1u << 3 | 1u << 5 | 1u << 8;
    unsigned a, b, c, d;
    if (!__get_cpuid(1, &a, &b, &c, &d)) return 0;
    if ((c & fma_movbe_osxsave_avx) != fma_movbe_osxsave_avx) return 0;
    __asm__("xgetbv" : "=a"(a), "=d"(d) : "c"(0));
    if ((a & 6) != 6) return 0; /* the system keeps the wide registers */
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d)) return 0;
    if ((b & bmi_avx2_bmi2) != bmi_avx2_bmi2) return 0;
    return __get_cpuid(0x80000001, &a, &b, &c, &d) && (c & 1u << 5); /* lzcnt */
}
PyMODINIT_FUNC PyInit_NAME(void) {
    return has_avx2() ? PyInit_NAME_avx2() : PyInit_NAME_any();
}
"""


def compiler() -> list[str] | None:
    """The command of the machine's C compiler; None where there is none."""
    given = shlex.split(os.environ.get("CC", ""))
    if WINDOWS:
        return given or None
    found = [[name] for name in ("cc", "gcc", "clang") if shutil.which(name)]
    return given or next(iter(found), None)


def _zig() -> list[str]:
    """The compiler of the package ziglang, for any processor of this kind."""
    command = [sys.executable, "-m", "ziglang", "cc"]
    if WINDOWS:
        command += ["-target", f"{machine()}-windows-gnu"]
    elif MACOS:
        command += ["-target", f"{machine()}-macos"]
    elif sys.platform == "linux":
        libc = "gnu.2.28" if platform.libc_ver()[0] == "glibc" else "musl"
        command += ["-target", f"{machine()}-linux-{libc}"]
    return command


def _link() -> list[str]:
    if WINDOWS:  # all symbols must be known
        libraries = pathlib.Path(sys.base_prefix) / "libs"
        version = sysconfig.get_config_var("py_version_nodot")
        return ["-shared", "-s", "-L", str(libraries), f"-lpython{version}"]
    if MACOS:
        return ["-bundle", "-undefined", "dynamic_lookup"]
    return ["-shared", "-s", "-lm"]


def _run(command: list[object]) -> None:
    """Its output only where it fails."""
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"failed: {shlex.join(words)}\n{done.stdout}{done.stderr}")


def build() -> list[pathlib.Path]:
    """Compile what is older than its source; all modules, relative to the checkout."""
    sources = sorted(ROOT.glob("jaxcal/**/*kernel.py"))
    compile_one = _Build().module
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        kernels = [path.relative_to(ROOT) for path in sources]
        return list(pool.map(compile_one, [None, *kernels]))


class _Build:
    """Compiles kernels beside their sources."""

    def __init__(self) -> None:
        self.work = ROOT / "build" / "kernels" / sys.implementation.cache_tag
        found = compiler()
        self.zig = found is None
        headers = pathlib.Path(sysconfig.get_path("include"))
        if not (headers / "Python.h").exists():
            raise SystemExit(
                f"Python.h must be in {headers} to compile jaxcal's kernels: install "
                "the headers of this Python (on Debian and Ubuntu python3-dev)"
            )
        self.cc = [*(found or _zig()), "-I", str(headers)]
        if self.zig and not WINDOWS:
            # Debian's Python.h includes from the folder above, as cc looks it up
            self.cc += ["-idirafter", str(headers.parent)]
        if MACOS and not self.zig:
            self.cc += ["-arch", {"aarch64": "arm64"}.get(machine(), machine())]
        self.cc += shlex.split(os.environ.get("CFLAGS", ""))
        common = [ROOT / "hatch_build.py", *ROOT.glob("jaxcal/**/*.pxd")]
        self.changed = max(path.stat().st_mtime for path in common)

    def module(self, source: pathlib.Path | None) -> pathlib.Path:
        """The module of a kernel; with None, of what all of them share."""
        plain = source.with_suffix("") if source else pathlib.Path(*SHARED.split("."))
        target = plain.with_name(plain.name + sysconfig.get_config_var("EXT_SUFFIX"))
        module = ROOT / target
        changed = self.changed
        if source:
            changed = max(changed, (ROOT / source).stat().st_mtime)
        if module.exists() and module.stat().st_mtime >= changed:
            return target
        code = self.work / plain.with_suffix(".c")
        for path in (code, module):
            path.parent.mkdir(parents=True, exist_ok=True)
        cython = [sys.executable, "-m", "cython", "-3"]
        if source is None:
            _run([*cython, f"--generate-shared={code}"])
            objects = [self._object(code, "", ["-O1", *EXACT])]
        else:
            for key, value in DIRECTIVES.items():
                cython += ["-X", f"{key}={value}"]
            _run([*cython, f"--shared={SHARED}", "-o", code, source])
            fused = FUSES in (ROOT / source).read_text()
            objects = self._objects(code, ["-O3", *(FUSED if fused else EXACT)])
        # Written beside and moved: a process that runs keeps the module it loaded.
        beside = module.with_name(f"{module.name}.{os.getpid()}")
        _run([*self.cc, *objects, "-o", beside, *_link()])
        beside.replace(module)
        return target

    def _objects(self, code: pathlib.Path, flags: list[str]) -> list[pathlib.Path]:
        """One, or one for every processor, one for AVX2 and what chooses."""
        if not X86:
            return [self._object(code, "", flags)]
        name = code.stem
        choice = code.with_name(f"{name}_choice.c")
        choice.write_text(CHOICE.replace("NAME", name))
        # The two names that Cython does not keep to the file.
        dotted = code.relative_to(self.work).with_suffix("").parts
        names = (f"PyInit_{name}", "__pyx_module_is_main_" + "__".join(dotted))
        objects = [self._object(choice, "", flags)]
        avx2 = "-mcpu=x86_64_v3" if self.zig else "-march=x86-64-v3"
        # Processors older than AVX2, of 2013, are not worth the seconds of -O3.
        for kind, more in (("any", ["-O1"]), ("avx2", [avx2])):
            renamed = [f"-D{name}={name}_{kind}" for name in names]
            objects.append(self._object(code, kind, [*flags, *renamed, *more]))
        return objects

    def _object(self, code: pathlib.Path, kind: str, flags: list[str]) -> pathlib.Path:
        to = code.with_name(f"{code.stem}{kind}.o")
        _run([*self.cc, *FLAGS, *flags, "-c", code, "-o", to])
        return to


class KernelHook(BuildHookInterface):
    """What hatchling calls."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """A compiler, where the machine has none."""
        return [] if compiler() else ["ziglang>=0.15,<1"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Beside their sources, also for a wheel: Python started in a checkout imports
        the package that lies there, however jaxcal was installed."""
        if self.target_name != "wheel":
            return
        build_data["pure_python"] = False
        build_data["infer_tag"] = True
        for module in build():
            if version != "editable":
                build_data["force_include"][str(ROOT / module)] = str(module)


if __name__ == "__main__":
    build()
