"""Builds the kernels with a driver under sanitizers, and runs it: ``make check-native``.

``address``: AddressSanitizer and UndefinedBehaviorSanitizer, with the real OpenMP. ``thread``: ThreadSanitizer, with
plain threads in OpenMP's place (threads.cpp says why), so it checks what the kernels share and how they split their
loops, not libgomp itself.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
KERNELS = ROOT / "core/native"
BUILD = ROOT / "build/sanitize"
FLAGS = ["-std=c++17", "-O1", "-g", "-fno-omit-frame-pointer", "-fopenmp", "-Wno-psabi"]
FLAGS += ["-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-ffp-contract=fast"]
FLAGS += ["-march=x86-64-v3"] if platform.machine() in ("x86_64", "AMD64") else []
KINDS = {
    "address": ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"],
    "thread": ["-fsanitize=thread"],
}


def compiler() -> str | None:
    """GCC, or None: the stand-in for OpenMP speaks GCC's interface."""
    return shutil.which(os.environ.get("CXX", "g++"))


def supported(kind: str) -> str:
    """Empty, or why this machine cannot do it."""
    cxx = compiler()
    if not cxx:
        return "no g++ on this machine"
    BUILD.mkdir(parents=True, exist_ok=True)
    probe = [cxx, *FLAGS, *KINDS[kind], "-x", "c++", "-", "-o", str(BUILD / f"probe-{kind}")]
    done = subprocess.run(probe, input="int main() {}", capture_output=True, text=True, check=False)
    return f"this compiler has no {kind} sanitizer" if done.returncode else ""


def build(kind: str) -> Path:
    """The driver's path; what has not changed since the last build is not compiled again."""
    sources = [
        *sorted(KERNELS.glob("*.cpp")),
        HERE / "driver.cpp",
        *([HERE / "threads.cpp"] if kind == "thread" else []),
    ]
    newest = max(p.stat().st_mtime for p in (*KERNELS.glob("*.h"), Path(__file__)))
    folder = BUILD / kind
    folder.mkdir(parents=True, exist_ok=True)

    def compile_one(source: Path) -> Path:
        made = folder / f"{source.stem}.o"
        if not made.exists() or made.stat().st_mtime < max(newest, source.stat().st_mtime):
            subprocess.run([str(compiler()), *FLAGS, *KINDS[kind], "-c", str(source), "-o", str(made)], check=True)
        return made

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = [str(p) for p in pool.map(compile_one, sources)]
    # the stand-in takes libgomp's place: without -fopenmp nothing else brings it
    flags = [f for f in FLAGS if f != "-fopenmp" or kind != "thread"]
    driver = folder / "driver"
    subprocess.run([str(compiler()), *flags, *KINDS[kind], *objects, "-pthread", "-o", str(driver)], check=True)
    return driver


def run(kind: str) -> subprocess.CompletedProcess[str]:
    """The driver, built and run; its status is 0 where the sanitizers found nothing and all results agreed."""
    # leaks: libgomp keeps its pool of threads
    options = {"ASAN_OPTIONS": "detect_leaks=0", "TSAN_OPTIONS": "halt_on_error=1"}
    return subprocess.run(
        [str(build(kind))], env={**os.environ, **options}, capture_output=True, text=True, check=False
    )


def main() -> int:
    """Both kinds; status 1 where one failed."""
    failed = False
    for kind in KINDS:
        reason = supported(kind)
        done = None if reason else run(kind)
        print(f"{kind}: {reason or (done and done.stdout + done.stderr)}".rstrip())
        failed |= bool(done and done.returncode)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
