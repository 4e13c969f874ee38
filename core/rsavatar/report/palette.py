"""The colours and marks of methods and shutters, for every figure and every page. Safe for colour-blind readers.

The hues are those of Paul Tol's "vibrant" scheme; each method also has a mark of its own, so that no reading depends
on colour alone.
"""

from __future__ import annotations

from dataclasses import dataclass

from rsavatar.report.tables import LABELS


@dataclass(frozen=True)
class Look:
    """How one thing is drawn: ``light`` on white, ``dark`` on black, ``marker`` in matplotlib's words."""

    light: str
    dark: str
    marker: str


METHODS: dict[str, Look] = {
    "rs-avatar": Look("#00847a", "#3ecfc0", "o"),
    "gauhuman": Look("#0077bb", "#5bb0ea", "s"),
    "mad-avatar": Look("#e0661c", "#ff9a5c", "^"),
    "cvr+gauhuman": Look("#d4286d", "#ff7fae", "D"),
    "jamnet+gauhuman": Look("#7a4fb5", "#b79bf0", "v"),
    "flow+gauhuman": Look("#927a00", "#dcc54a", "P"),
    "oracle": Look("#3c4650", "#c3ccd4", "*"),
}
OTHER = Look("#6b7480", "#9aa4ae", "X")

SHUTTERS: dict[str, Look] = {
    "global": METHODS["gauhuman"],
    "blur": METHODS["mad-avatar"],
    "bands": METHODS["jamnet+gauhuman"],
    "rolling": METHODS["rs-avatar"],
}

INK, SOFT, LINE = "#1c2222", "#5a6565", "#dfe3e1"  # of words, of lesser words, of rules
ERROR_MAP = "inferno"  # sequential, monotone in lightness


def look_of(method: str) -> Look:
    """The look of a method; one for all that the palette does not know."""
    return METHODS.get(method, OTHER)


def label_of(method: str) -> str:
    """A method's name for readers."""
    return LABELS.get(method, method)


def stylesheet() -> str:
    """The palette as CSS: ``--method-NAME`` with ``+`` as ``-``, ``--shutter-NAME``, and classes ``.method-NAME``."""
    named = {f"method-{name.replace('+', '-')}": look for name, look in METHODS.items()}
    named |= {f"shutter-{name}": look for name, look in SHUTTERS.items()}
    light = "".join(f"  --{name}: {look.light};\n" for name, look in named.items())
    dark = "".join(f"    --{name}: {look.dark};\n" for name, look in named.items())
    classes = "".join(f".{name} {{ --own: var(--{name}); }}\n" for name in named)
    night = f"@media (prefers-color-scheme: dark) {{\n  :root {{\n{dark}  }}\n}}\n"
    return f":root {{\n{light}}}\n{night}{classes}"
