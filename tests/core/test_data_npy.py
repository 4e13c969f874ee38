"""Plain data comes out of pickled .npy files, code never runs."""

from __future__ import annotations

import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsavatar.data.npy import load_plain
from rsavatar.errors import DataError
from tests.core.subject_files import save_object


class Touches:
    """Unpickled naively, it creates a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_containers_of_arrays_come_back(tmp_path: Path, protocol: int) -> None:
    held = {
        "K": [np.eye(3), np.float64(2.5)],
        "ims": [{"ims": ["a", "b"]}],
        "o": OrderedDict(x=np.arange(3, dtype="f4")),
    }
    with (tmp_path / "a.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        pickle.dump(np.array(held, dtype=object), file, protocol=protocol)
    got = load_plain(tmp_path / "a.npy")
    assert np.array_equal(got["K"][0], np.eye(3))
    assert got["K"][1] == 2.5
    assert got["ims"] == [{"ims": ["a", "b"]}]
    assert got["o"]["x"].dtype == np.float32


def test_files_of_old_numpy_are_read_without_a_warning(tmp_path: Path) -> None:
    """Up to numpy 1.x the module was numpy.core, and dtypes were pickled with 0 and 1 for False and True."""
    content = pickle.dumps(np.array({"Th": np.arange(3.0)}, dtype=object), protocol=2)
    old = content.replace(b"numpy._core.multiarray\n", b"numpy.core.multiarray\n").replace(
        b"\x89\x88\x87", b"K\0K\1\x87"
    )
    assert old.count(b"numpy.core") == 1
    assert old.count(b"K\0K\1\x87") == 2
    with (tmp_path / "a.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        file.write(old)
    assert np.array_equal(load_plain(tmp_path / "a.npy")["Th"], [0, 1, 2])


def test_plain_arrays_come_back(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.arange(6.0).reshape(2, 3))
    assert np.array_equal(load_plain(tmp_path / "a.npy"), np.arange(6.0).reshape(2, 3))


def test_code_is_refused_and_does_not_run(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    save_object(tmp_path / "a.npy", {"K": Touches(trace)})
    with pytest.raises(DataError, match=r"a\.npy.*not plain data"):
        load_plain(tmp_path / "a.npy")
    assert not trace.exists()


@pytest.mark.parametrize("name", ["builtins.eval", "os.system", "numpy.load", "numpy.f2py.crackfortran.myeval"])
def test_every_other_name_is_refused(tmp_path: Path, name: str) -> None:
    module, _, attribute = name.rpartition(".")
    with (tmp_path / "a.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        file.write(f"c{module}\n{attribute}\n(S'1'\ntR.".encode())
    with pytest.raises(DataError, match="not plain data"):
        load_plain(tmp_path / "a.npy")


def test_missing_truncated_and_foreign_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.npy: expected a file, got nothing"):
        load_plain(tmp_path / "none.npy")
    save_object(tmp_path / "cut.npy", {"K": np.zeros(100)})
    content = (tmp_path / "cut.npy").read_bytes()
    for length in (3, 60, len(content) // 2, len(content) - 1):
        (tmp_path / "cut.npy").write_bytes(content[:length])
        with pytest.raises(DataError, match=r"cut\.npy"):
            load_plain(tmp_path / "cut.npy")
