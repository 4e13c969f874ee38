"""The submit form, generated from the spec's own schema: its names, limits, defaults and sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rsavatar.catalog import DESCRIPTIONS, METHODS
from rsavatar.spec import FLAGS_OF_METHOD, JobSpec, presets_dir, read_preset
from services.api.layout import label

ESSENTIALS = ("method", "subject", "preset")  # chosen above; everything else is "more choices"
GROUPS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("Shutter and time", "How a row gets its instant, and the motion its shape.", ("T", "K", "motion", "P", "lambda")),
    ("Training", "How long, and from which random start.", ("iterations", "seed", "checkpoint_every", "priority")),
)
REST = "Fine detail"
PRESET_WORDS = {
    "smoke": "seconds: does everything run?",
    "draft": "minutes: compare methods at one budget",
    "paper": "hours: the paper's own configuration",
}


@dataclass(frozen=True)
class Field:
    """One input. ``kind`` is number, text, choice or flag; ``value`` None leaves the preset's."""

    name: str
    kind: str
    about: str
    default: Any
    value: Any
    choices: tuple[str, ...] = ()
    minimum: float | None = None
    maximum: float | None = None
    whole: bool = True


@dataclass(frozen=True)
class Choice:
    """A method or a preset, with the sentence that says what choosing it means."""

    name: str
    title: str
    about: str
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Form:
    """Everything that the page needs to ask for a job."""

    methods: tuple[Choice, ...]
    presets: tuple[Choice, ...]
    groups: tuple[tuple[str, str, tuple[Field, ...]], ...]
    ablations: tuple[Field, ...]


def fields_of_spec(given: Mapping[str, Any]) -> Form:
    """The form, with the values of an earlier spec where there is one."""
    schema = JobSpec.model_json_schema(by_alias=True)
    preset = read_preset(str(given["preset"])) if given.get("preset") else {}
    words = [name for name in schema["properties"] if name not in {*ESSENTIALS, "ablation"}]
    kept = {n: v for n, v in given.items() if v is not None and v != preset.get(n, _default(schema, n))}
    fields = {name: _field(name, schema, kept.get(name)) for name in words}
    placed = {name for _, _, names in GROUPS for name in names}
    groups = [(title, about, tuple(fields[n] for n in names if n in fields)) for title, about, names in GROUPS]
    groups.append((REST, "Defaults that few jobs change.", tuple(f for n, f in fields.items() if n not in placed)))
    flags = schema["$defs"]["Ablation"]["properties"]
    set_flags = given.get("ablation") or {}
    return Form(
        methods=tuple(Choice(m, label(m), DESCRIPTIONS.get(m, ""), {"flags": _flags(m)}) for m in METHODS),
        presets=tuple(_preset(path.stem) for path in sorted(presets_dir().glob("*.toml"), key=_rank)),
        groups=tuple(groups),
        ablations=tuple(
            Field(n, "flag", about["description"], default=False, value=bool(set_flags.get(n)))
            for n, about in flags.items()
        ),
    )


def _default(schema: Mapping[str, Any], name: str) -> Any:
    return schema["properties"].get(name, {}).get("default")


def _flags(method: str) -> list[str]:
    return sorted(FLAGS_OF_METHOD.get(method, frozenset()))


def _rank(path: Any) -> tuple[int, str]:
    names = list(PRESET_WORDS)
    return (names.index(path.stem) if path.stem in names else len(names), path.stem)


def _preset(name: str) -> Choice:
    return Choice(name, name, PRESET_WORDS.get(name, ""), read_preset(name))


def _field(name: str, schema: Mapping[str, Any], value: Any) -> Field:
    about = schema["properties"][name]
    branches = [b for b in about.get("anyOf", [about]) if b.get("type") != "null"]
    if "$ref" in branches[0]:
        branches = [schema["$defs"][branches[0]["$ref"].rpartition("/")[2]]]
    first = branches[0]
    shared: dict[str, Any] = {"about": about.get("description", ""), "default": about.get("default"), "value": value}
    if "enum" in first:
        return Field(name, "choice", choices=tuple(first["enum"]), **shared)
    if first.get("type") == "boolean":
        return Field(name, "choice", choices=("true", "false"), **shared)
    if len(branches) == 1 and first.get("type") in {"integer", "number"}:
        low = first.get("minimum", first.get("exclusiveMinimum"))
        high = first.get("maximum", first.get("exclusiveMaximum"))
        return Field(name, "number", minimum=low, maximum=high, whole=first["type"] == "integer", **shared)
    return Field(name, "text", **shared)
