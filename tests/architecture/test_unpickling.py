"""A pickle is a program. What reads one is in three files, and none of them runs what a pickle names."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted([*(ROOT / "core" / "rsavatar").rglob("*.py"), *(ROOT / "services").rglob("*.py")])
SOURCES = {str(file.relative_to(ROOT)): ast.parse(file.read_text("utf-8")) for file in FILES}
UNPICKLERS = {"core/rsavatar/body/unpickle.py", "core/rsavatar/data/npy.py"}  # each with a list of names that it admits
PICKLES = {"pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}


def calls(tree: ast.AST, *names: str) -> list[ast.Call]:
    """Calls of ``module.function``, by the words as they are written."""
    last = {name.rpartition(".")[2] for name in names}
    found = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "attr", None) in last]
    return [call for call in found if ast.unparse(call.func) in names]


def word(call: ast.Call, name: str) -> str | None:
    """What a keyword argument says; None without one."""
    return next((ast.unparse(k.value) for k in call.keywords if k.arg == name), None)


def test_only_the_restricted_readers_unpickle() -> None:
    for name, tree in SOURCES.items():
        used = {ast.unparse(c.func) for c in calls(tree, "pickle.load", "pickle.loads", "marshal.loads", "joblib.load")}
        assert not used, (name, used)
        classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
        unpicklers = {c.name for c in classes if any("Unpickler" in ast.unparse(base) for base in c.bases)}
        assert not unpicklers or name in UNPICKLERS, (name, unpicklers)
        imported = {a.name.partition(".")[0] for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
        assert imported & PICKLES <= {"pickle"}, name


def test_every_restricted_reader_lists_what_it_admits() -> None:
    for name in UNPICKLERS:
        classes = [node for node in ast.walk(SOURCES[name]) if isinstance(node, ast.ClassDef)]
        kinds = [c for c in classes if any("Unpickler" in ast.unparse(base) for base in c.bases)]
        assert kinds, name
        assert all("find_class" in {f.name for f in kind.body if isinstance(f, ast.FunctionDef)} for kind in kinds), (
            name
        )


def test_numpy_and_torch_are_told_to_unpickle_nothing() -> None:
    for name, tree in SOURCES.items():
        for call in calls(tree, "np.load", "numpy.load", "np.lib.format.read_array"):
            assert word(call, "allow_pickle") in {None, "False"}, (name, call.lineno)  # numpy's own word is no
        for call in calls(tree, "torch.load"):
            assert word(call, "weights_only") == "True", (name, call.lineno)
