"""Reading ``.npy`` files that hold pickled dictionaries, without running what a pickle may carry."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rsavatar.errors import DataError, expected

_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_NUMERIC = ("numpy.core.numeric", "numpy._core.numeric")
_ADMITTED = frozenset(
    [(module, name) for module in _MULTIARRAY for name in ("_reconstruct", "scalar")]
    + [(module, "_frombuffer") for module in _NUMERIC]
    + [("numpy", "ndarray"), ("numpy", "dtype"), ("collections", "OrderedDict"), ("_codecs", "encode")]
)


class _PlainUnpickler(pickle.Unpickler):
    """Admits numpy arrays and scalars and built-in containers: every other name is refused before it is imported."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ADMITTED:
            raise pickle.UnpicklingError(f"the name {module}.{name}, which is not plain data")
        return super().find_class(module, name)


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
    except (OSError, EOFError, ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
        raise DataError(expected(str(path), "a complete .npy file", error)) from error
    except pickle.UnpicklingError as error:
        raise DataError(expected(str(path), "a .npy file of numpy arrays and plain containers", error)) from error


def _read(file: BinaryIO) -> Any:
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    if not dtype.hasobject:
        file.seek(0)
        return np.load(file, allow_pickle=False)
    held = _PlainUnpickler(file, encoding="latin1").load()
    return held.item() if shape == () and isinstance(held, np.ndarray) else held
