"""SPEC and --set: what the user said, as the request that ``spec.resolve`` or the service validates."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rsavatar.catalog import METHODS
from rsavatar.errors import SpecError, expected
from rsavatar.spec import presets_dir


def read_request(source: str, settings: Sequence[str], subject_dir: Path | None = None) -> dict[str, Any]:
    """The request of a TOML file or a preset's name, overlaid with ``KEY=VALUE`` settings.

    A subject that is named nowhere is called as its folder.

    Raises:
        SpecError: if the source is neither, a setting is malformed, or no method or subject is named.
    """
    request = _read_source(source)
    for setting in settings:
        _lay(request, setting)
    if "subject" not in request and subject_dir is not None:
        request["subject"] = subject_dir.resolve().name
    for name, wanted in {"method": f"one of {', '.join(METHODS)}", "subject": "a name"}.items():
        if name not in request:
            raise SpecError(expected(name, wanted, f"nothing; say --set {name}=..."))
    return request


def parse_setting(setting: str) -> tuple[list[str], Any]:
    """``"a.b=value"`` as (["a", "b"], value): a TOML value where it is one, else the text itself.

    Raises:
        SpecError: if there is no ``=`` or no key.
    """
    key, equals, text = setting.partition("=")
    path = [part.strip() for part in key.split(".")]
    if not equals or not all(path):
        raise SpecError(expected("--set", "KEY=VALUE", repr(setting)))
    try:
        return path, tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return path, text


def _read_source(source: str) -> dict[str, Any]:
    path = Path(source)
    if path.is_file():
        try:
            return tomllib.loads(path.read_text("utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise SpecError(expected(str(path), "a TOML file", error)) from None
    presets = sorted(p.stem for p in presets_dir().glob("*.toml"))
    if source not in presets:
        raise SpecError(expected("SPEC", f"a TOML file or one of {', '.join(presets)}", repr(source)))
    return {"preset": source}


def _lay(request: dict[str, Any], setting: str) -> None:
    path, value = parse_setting(setting)
    target = request
    for part in path[:-1]:
        target = target.setdefault(part, {})
        if not isinstance(target, dict):
            raise SpecError(expected(f"--set {setting}", f"{part} to hold words of its own", repr(target)))
    target[path[-1]] = value
