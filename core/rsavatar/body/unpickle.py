"""Reads the arrays out of a legacy SMPL pickle without running anything that the pickle names.

A pickle is a program: it may import any name and call it. This unpickler knows the few names that SMPL's files need,
and turns scipy matrices and chumpy arrays into plain arrays by itself; every other name is refused.
"""

from __future__ import annotations

import codecs
import importlib
import pickle
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from rsavatar.errors import BodyError, expected

_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_NUMERIC = ("numpy.core.numeric", "numpy._core.numeric")
_NUMPY = {
    **{
        (module, name): ("numpy._core.multiarray", name)
        for module in _MULTIARRAY
        for name in ("_reconstruct", "scalar")
    },
    **{(module, "_frombuffer"): ("numpy._core.numeric", "_frombuffer") for module in _NUMERIC},
    ("numpy", "ndarray"): ("numpy", "ndarray"),
}
_SPARSE = {
    (f"scipy.sparse{module}", f"{kind}_matrix"): kind
    for kind in ("csc", "csr")
    for module in ("", f".{kind}", f"._{kind}")
}


class _AbstractParts:
    """Stands for an object of another package: keeps the pickled state, does nothing."""

    __slots__ = ("state",)
    state: Mapping[str, object]

    def __setstate__(self, state: object) -> None:
        self.state = state if isinstance(state, Mapping) else {}


class _Csc(_AbstractParts):
    """scipy's compressed-column matrix."""

    __slots__ = ()


class _Csr(_AbstractParts):
    """scipy's compressed-row matrix."""

    __slots__ = ()


class _Chumpy(_AbstractParts):
    """chumpy's array; the numbers are under "x"."""

    __slots__ = ()


class _Reconstruct:
    """copyreg._reconstructor for the stand-ins only."""

    __slots__ = ()

    def __call__(self, kind: object, *_: object) -> object:
        for known in (_Csc, _Csr, _Chumpy):
            if kind is known:
                return known()
        raise BodyError(expected("body pickle reconstructor", "a scipy matrix or a chumpy array", kind))


class _Encode:
    """_codecs.encode, with which Python 3 writes bytes into old pickle protocols; latin1 only."""

    __slots__ = ()

    def __call__(self, text: str, encoding: str = "latin1") -> bytes:
        if encoding != "latin1":
            raise BodyError(expected("body pickle text encoding", "latin1", encoding))
        return codecs.latin_1_encode(text)[0]


class _Dtype:
    """numpy.dtype as old files call it: with 0 and 1 where numpy wants False and True."""

    __slots__ = ()

    def __call__(self, code: str, align: int = 0, copy: int = 1) -> np.dtype[Any]:
        return np.dtype(code, align=bool(align), copy=bool(copy))


class _Object:
    """The word ``object``, an argument of the reconstructor."""

    __slots__ = ()


_OWN: dict[tuple[str, str], object] = {
    **{key: {"csc": _Csc, "csr": _Csr}[kind] for key, kind in _SPARSE.items()},
    ("chumpy.ch", "Ch"): _Chumpy,
    ("copy_reg", "_reconstructor"): _Reconstruct(),
    ("copyreg", "_reconstructor"): _Reconstruct(),
    ("__builtin__", "object"): _Object,
    ("builtins", "object"): _Object,
    ("_codecs", "encode"): _Encode(),
    ("numpy", "dtype"): _Dtype(),
}


class _ArrayUnpickler(pickle.Unpickler):
    """Finds only the names listed above."""

    def find_class(self, module_name: str, global_name: str, /) -> object:
        key = (module_name, global_name)
        if key in _OWN:
            return _OWN[key]
        if key in _NUMPY:
            module, name = _NUMPY[key]
            return getattr(importlib.import_module(module), name)
        wanted = "numpy arrays, scipy csc/csr matrices or chumpy.ch.Ch"
        raise BodyError(expected("body pickle content", wanted, f"the name {module_name}.{global_name}, refused"))


def load_arrays(file: IO[bytes]) -> object:
    """What a pickle of arrays holds: numpy arrays, plain Python values, and parts for ``dense``.

    **Convention**: text of Python 2 is read as latin1.

    Raises:
        BodyError: if the pickle names anything else (which is not run), or is damaged.
    """
    try:
        return _ArrayUnpickler(file, encoding="latin1").load()
    except BodyError:
        raise
    except Exception as error:  # a damaged pickle raises nearly anything
        raise BodyError(expected("body pickle", "a readable file", f"{type(error).__name__}: {error}")) from error


def dense(name: str, value: object) -> npt.NDArray[np.float64]:
    """A numeric array out of what ``load_arrays`` or an .npz gave: array, sparse matrix or chumpy array, as float64.

    Raises:
        BodyError: if it is none of them, or its parts do not fit together.
    """
    if isinstance(value, np.ndarray) and value.dtype == object and value.shape == ():
        value = value.item()
    try:
        if isinstance(value, _Chumpy):
            value = value.state["x"]
        if isinstance(value, (_Csc, _Csr)):
            return _dense_of_sparse(value)
        return np.asarray(value, np.float64)
    except (AttributeError, TypeError, ValueError, IndexError, KeyError) as error:
        raise BodyError(expected(f"body {name}", "an array of numbers", f"{type(value).__name__}: {error}")) from error


def _dense_of_sparse(parts: _Csc | _Csr) -> npt.NDArray[np.float64]:
    """The matrix of a compressed-column (csc) or compressed-row (csr) triple; entries of equal place add up."""
    state = parts.state
    shape = state["_shape"] if "_shape" in state else state["shape"]
    rows, columns = (int(n) for n in shape)  # type: ignore[attr-defined]  # checked by the caller's except
    data, minor, starts = (np.asarray(state[key]).ravel() for key in ("data", "indices", "indptr"))
    major = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    out = np.zeros((rows, columns))
    np.add.at(out, (minor, major) if isinstance(parts, _Csc) else (major, minor), data)
    return out
