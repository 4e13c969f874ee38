"""Builds the native kernels; everything else about the package is in pyproject.toml.

The kernels are plain C++ with a C interface, compiled once per instruction set and chosen at run time. There is no
Python API in them, so they need a C++ compiler and nothing else.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent
SOURCES = sorted((ROOT / "core/native").glob("*.cpp"))
X86 = platform.machine() in ("x86_64", "AMD64")
TARGETS = (
    {"avx2": ["-march=x86-64-v3"], "avx512": ["-march=x86-64-v4", "-mprefer-vector-width=512"]}
    if X86
    else {"generic": []}
)
# No -ffast-math: it folds away the rounding trick in exp2, and sets flush-to-zero for the whole process.
FLAGS = ["-std=c++17", "-O3", "-fopenmp", "-fPIC", "-fvisibility=hidden", "-Wall", "-Wextra", "-Wno-psabi"]
FLAGS += ["-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-ffp-contract=fast"]

NO_COMPILER = """
C++ compiler: expected g++ or clang++ on PATH (or CXX set), got none.
  Debian/Ubuntu: apt-get install g++      Fedora: dnf install gcc-c++      macOS: xcode-select --install
  To go without, set RSAVATAR_NATIVE=0: a torch-only renderer is used then, several hundred times slower.
"""


def compiler() -> str:
    """The C++ compiler's command, or an error that says what to install."""
    found = next((c for c in (os.environ.get("CXX"), "g++", "clang++", "c++") if c and shutil.which(c)), None)
    if not found:
        raise SystemExit(NO_COMPILER)
    return found


def run(command: list[str]) -> None:
    """Run a compiler command; its own message is the error."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"native kernels: {' '.join(command)}\n{done.stderr}")


class BuildKernels(build_ext):
    """``rsavatar/render/_kernels_<target>.so``, one for each instruction set."""

    @property
    def folder(self) -> Path:
        """Where the libraries go in the build tree."""
        return Path(self.build_lib) / "rsavatar/render"

    def build_extension(self, ext: Extension) -> None:
        """Compile every source for every target, side by side, and link."""
        if os.environ.get("RSAVATAR_NATIVE") == "0":
            return
        cxx, temp = compiler(), Path(self.build_temp)
        self.folder.mkdir(parents=True, exist_ok=True)
        jobs = []
        for target, march in TARGETS.items():
            (temp / target).mkdir(parents=True, exist_ok=True)
            jobs += [[cxx, *FLAGS, *march, "-c", str(s), "-o", str(temp / target / f"{s.stem}.o")] for s in SOURCES]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(run, jobs))
        for target in TARGETS:
            objects = [str(temp / target / f"{s.stem}.o") for s in SOURCES]
            run([cxx, "-shared", "-fopenmp", *objects, "-o", str(self.folder / f"_kernels_{target}.so")])

    def get_ext_filename(self, fullname: str) -> str:
        """The first target's library stands for the extension."""
        return f"rsavatar/render/_kernels_{next(iter(TARGETS))}.so"

    def copy_extensions_to_source(self) -> None:
        """Of an in-place or editable build."""
        for library in self.folder.glob("_kernels_*.so"):
            place = ROOT / "core/rsavatar/render" / library.name
            fresh = place.with_suffix(".new")
            shutil.copy2(library, fresh)
            fresh.replace(place)  # a running job keeps the library that it has loaded


class BuildPackage(build_py):
    """Takes the preset files, which live beside the package, into it."""

    def run(self) -> None:
        """As usual, then the presets."""
        super().run()
        if not self.editable_mode:
            shutil.copytree(
                ROOT / "core/experiments", Path(self.build_lib) / "rsavatar/experiments", dirs_exist_ok=True
            )


setup(
    ext_modules=[Extension("rsavatar.render._kernels", [str(s.relative_to(ROOT)) for s in SOURCES])],
    cmdclass={"build_ext": BuildKernels, "build_py": BuildPackage},
)
