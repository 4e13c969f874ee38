"""What a grid is asked for in, and the files that hold such requests."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from rsavatar.errors import SpecError, expected
from rsavatar.spec import presets_dir

NAME = r"^[A-Za-z0-9][A-Za-z0-9 ._-]*$"


class GridRequest(BaseModel):
    """What a grid is asked for in; also the content of a file in ``core/experiments/grids``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field("grid", min_length=1, max_length=128, pattern=NAME, description="what people call it")
    about: str = Field("", max_length=2000, description="a sentence for people")
    base: dict[str, JsonValue] = Field(default={}, description="words that all jobs share")
    axes: dict[str, list[JsonValue]] = Field(default={}, description="words that vary, and their values")
    includes: list[dict[str, JsonValue]] = Field(default=[], max_length=1000, description="more cells")
    excludes: list[dict[str, JsonValue]] = Field(default=[], max_length=1000, description="cells to leave out")


def grids_dir() -> Path:
    """Folder of the built-in grids."""
    return presets_dir() / "grids"


def grid_names() -> tuple[str, ...]:
    """Names of the built-in grids."""
    return tuple(sorted(path.stem for path in grids_dir().glob("*.toml")))


def read_grid(name: str) -> GridRequest:
    """A built-in grid.

    Raises:
        SpecError: if there is none with this name.
    """
    if name not in grid_names():
        raise SpecError(expected("grid", f"one of {', '.join(grid_names())}", repr(name)))
    return read_grid_file(grids_dir() / f"{name}.toml")


def read_grid_file(path: Path) -> GridRequest:
    """A grid of a TOML file; its name is the file's unless it has one.

    Raises:
        SpecError: if the file is not TOML, or not a grid.
    """
    try:
        return parse_grid({"name": path.stem, **tomllib.loads(path.read_text("utf-8"))})
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise SpecError(expected(str(path), "a TOML file", error)) from None


def parse_grid(words: Mapping[str, Any]) -> GridRequest:
    """A request from plain values.

    Raises:
        SpecError: naming every field that is not a grid's.
    """
    try:
        return GridRequest.model_validate(words)
    except ValidationError as error:
        sentences = (
            expected(".".join(map(str, e["loc"])) or "grid", e["msg"][:1].lower() + e["msg"][1:], repr(e["input"]))
            for e in error.errors()
        )
        raise SpecError("; ".join(dict.fromkeys(sentences))) from None


def vary(request: GridRequest, word: str, value: JsonValue) -> GridRequest:
    """The request with one word set: a list makes an axis of it, anything else fixes it for all jobs."""
    axes, base = dict(request.axes), dict(request.base)
    if isinstance(value, list):
        axes[word] = value
        return request.model_copy(update={"axes": axes})
    axes.pop(word, None)
    root, _, flag = word.partition(".")
    if flag:
        former = base.get(root)
        value = {**(former if isinstance(former, dict) else {}), flag: value}
    return request.model_copy(update={"axes": axes, "base": {**base, root: value}})
