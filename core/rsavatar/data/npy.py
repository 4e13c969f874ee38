"""Reading ``.npy`` files that hold pickled dictionaries, without running what a pickle may carry."""

from __future__ import annotations

import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy._core import multiarray, numeric

from rsavatar.errors import DataError, expected


def _dtype(code: str, align: int = 0, copy: int = 1) -> np.dtype[Any]:
    """numpy.dtype as files of all ages call it: old ones write 0 and 1 where numpy wants False and True."""
    return np.dtype(code, align=bool(align), copy=bool(copy))


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """_codecs.encode, with which Python 3 writes bytes into old pickle protocols; latin1 only."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"text encoded as {encoding}, which is not plain data")
    return text.encode("latin1")


_ADMITTED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): _dtype,
    ("collections", "OrderedDict"): OrderedDict,
    ("_codecs", "encode"): _encode,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): multiarray._reconstruct for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): multiarray.scalar for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): numeric._frombuffer for core in ("core", "_core")},  # type: ignore[attr-defined]  # not in numpy's stubs
}


class _PlainUnpickler(pickle.Unpickler):
    """Admits numpy arrays and scalars and built-in containers; every other name is refused and not imported."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ADMITTED:
            raise pickle.UnpicklingError(f"the name {module}.{name}, which is not plain data")
        return _ADMITTED[module, name]


def load_plain(path: Path) -> Any:
    """What ``numpy.save`` wrote, object arrays included: a 0-d object array gives the object itself.

    Only numpy arrays, numbers, strings and built-in containers come out of a pickle; a pickle that names anything
    else is refused and nothing of it runs. Pickles of Python 2 are read as latin-1.

    Raises:
        DataError: if the file is missing, truncated, no ``.npy`` file, or holds more than plain data.
    """
    try:
        with path.open("rb") as file:
            return _read(file)
    except FileNotFoundError:
        raise DataError(expected(str(path), "a file", "nothing there")) from None
    except pickle.UnpicklingError as error:
        raise DataError(expected(str(path), "a .npy file of numpy arrays and plain containers", error)) from error
    except Exception as error:  # a damaged pickle raises nearly anything
        raise DataError(expected(str(path), "a complete .npy file", f"{type(error).__name__}: {error}")) from error


def _read(file: BinaryIO) -> Any:
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    if not dtype.hasobject:
        file.seek(0)
        return np.load(file, allow_pickle=False)
    held = _PlainUnpickler(file, encoding="latin1").load()
    return held.item() if shape == () and isinstance(held, np.ndarray) else held
