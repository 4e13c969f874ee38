"""The house's rules that a program can check."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = [p for top in ("core", "services") for p in (ROOT / top).rglob("*") if p.suffix in (".py", ".cpp", ".h")]

PYTHON = [p for p in SOURCES if p.suffix == ".py" and "migrations" not in p.parts]  # a migration is a list of columns


def test_import_contracts_hold() -> None:
    command = [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_are_short_and_named_for_what_they_are(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 500
    assert path.stem not in ("utils", "common", "manager", "helpers", "misc")


@pytest.mark.parametrize("path", PYTHON, ids=lambda p: str(p.relative_to(ROOT)))
def test_functions_are_short(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            length = (node.body[-1].end_lineno or 0) - node.body[0].lineno + 1
            assert length <= 60, f"{node.name}: {length} lines"


def test_importing_the_words_of_the_core_needs_no_torch() -> None:
    words = "rsavatar.spec, rsavatar.catalog, rsavatar.events, rsavatar.errors, rsavatar.report.tables, rsavatar.client"
    code = f"import {words}, sys; sys.exit(any(m in sys.modules for m in ('torch', 'numpy', 'cv2')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
