from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SERVICES = ROOT / "services"
CORE_OF_API = (
    "rsavatar.spec",
    "rsavatar.catalog",
    "rsavatar.errors",
    "rsavatar.events",
    "rsavatar.report",
    "rsavatar.grids",
)
CORE_OF_WORKER = ("rsavatar.experiment", "rsavatar.events", "rsavatar.spec", "rsavatar.errors")
CORE_OF_RENDERER = ("rsavatar.export", "rsavatar.report", "rsavatar.spec", "rsavatar.errors")
HEAVY = ("torch", "numpy", "scipy", "cv2", "matplotlib", "rsavatar.experiment", "rsavatar.render")


def imports_of(file: Path) -> set[str]:
    """Every module that a file imports, late imports included; ``from a import b`` counts as ``a`` and ``a.b``."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def within(module: str, packages: tuple[str, ...]) -> bool:
    return any(module == p or module.startswith(f"{p}.") for p in packages)


@pytest.mark.parametrize(
    "entry", ["services.api.app", "services.worker.app", "services.renderer.__main__", "services.up", "services.demo"]
)
def test_no_process_but_the_child_loads_the_numeric_core(entry: str) -> None:
    code = f"import {entry}, sys; print([m for m in {HEAVY!r} if m in sys.modules])"
    shown = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"


def test_api_and_worker_do_not_know_each_other() -> None:
    for mine, other in (("api", "services.worker"), ("worker", "services.api")):
        for file in (SERVICES / mine).rglob("*.py"):
            assert not any(within(m, (other,)) for m in imports_of(file)), file


def test_the_core_is_entered_by_its_doors() -> None:
    doors = {"api": CORE_OF_API, "store": CORE_OF_API, "worker": CORE_OF_WORKER, "renderer": CORE_OF_RENDERER}
    for part, allowed in doors.items():
        for file in (SERVICES / part).rglob("*.py"):
            core = {m for m in imports_of(file) if within(m, ("rsavatar",))} - {"rsavatar", "rsavatar.__version__"}
            assert all(within(m, allowed) for m in core), (file, core)


def test_sql_is_in_the_store_alone() -> None:
    harmless = ("sqlalchemy.exc", "sqlalchemy.exc.SQLAlchemyError")
    for file in SERVICES.rglob("*.py"):
        if SERVICES / "store" not in file.parents:
            used = {m for m in imports_of(file) if within(m, ("sqlalchemy",))}
            assert used <= set(harmless), (file, used)


def test_the_store_knows_nothing_above_it() -> None:
    for file in (SERVICES / "store").rglob("*.py"):
        above = ("services.api", "services.worker", "services.jobs", "services.up", "services.demo")
        assert not any(within(m, above) for m in imports_of(file)), file


def test_files_and_arguments_stay_small() -> None:
    for file in SERVICES.rglob("*.py"):
        assert len(file.read_text("utf-8").splitlines()) <= 250, file
