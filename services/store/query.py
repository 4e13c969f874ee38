"""The filter language of job lists, from text to a tree: ``state:failed psnr>25 (tag:paper or not seed:0)``.

    query   = any
    any     = all { "or" all }
    all     = one { ["and"] one }
    one     = "not" one | "(" any ")" | test
    test    = FIELD OPERATOR VALUE { "," VALUE }          several values of ":" mean any of them
    OPERATOR = ":" | "=" | "!=" | "<" | "<=" | ">" | ">="
    VALUE   = letters, digits and ._+-*/:  |  "anything in quotes"

Pure text work: what a field means in SQL is in ``services.store.filters``. Nothing is ever evaluated.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NoReturn

from services.errors import RequestError

LONGEST = 1000  # characters of a query
DEEPEST = 30  # parentheses and nots around one test
TOKEN = re.compile(
    r"""\s*(?:
        (?P<open>\() | (?P<close>\)) |
        (?P<test>(?P<field>[A-Za-z_]+(?:\.[A-Za-z_]+)?)\s*(?P<operator>!=|<=|>=|[:=<>])) |
        (?P<word>(?:and|or|not)(?![A-Za-z0-9_.-]))
    )""",
    re.VERBOSE | re.IGNORECASE,
)
VALUE = re.compile(r'\s*(?:"(?P<quoted>[^"]*)"|(?P<bare>[A-Za-z0-9._+*/:-]+))')
COMMA = re.compile(r"\s*,")


@dataclass(frozen=True)
class Comparison:
    """One comparison; ``at`` is where its field begins, counted from 1."""

    field: str
    operator: str
    values: tuple[str, ...]
    at: int


@dataclass(frozen=True)
class Not:
    """What is inside does not hold."""

    inside: Node


@dataclass(frozen=True)
class Both:
    """All of the parts hold (``every``), or at least one."""

    parts: tuple[Node, ...]
    every: bool


Node = Comparison | Not | Both


def parse(text: str) -> Node | None:
    """The tree of a query; None for an empty one.

    Raises:
        RequestError: saying what was expected at which character, and what is there.
    """
    if len(text) > LONGEST:
        raise RequestError("q", f"at most {LONGEST} characters", str(len(text)))
    if not text.strip():
        return None
    reader = _Reader(text)
    node = reader.any_of(0)
    if reader.kind is not None:
        reader.refuse("and, or, or the end")
    return node


def refuse(at: int, wanted: str, got: str) -> NoReturn:
    """Refuse a query at a place.

    Raises:
        RequestError: always.
    """
    raise RequestError("q", f"{wanted} at character {at}", got)


class _Reader:
    """Recursive descent with one token of sight: ``kind`` is open, close, test, and, or, not; None at the end."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._end = 0
        self._at = 1
        self._test: Comparison | None = None
        self.kind: str | None = None
        self._next()

    def refuse(self, wanted: str) -> NoReturn:
        """Refuse the token in sight."""
        refuse(self._at, wanted, repr(self._text[self._at - 1 : self._at + 19]) if self.kind else "the end")

    def any_of(self, depth: int) -> Node:
        """One or more ``all_of`` between ors."""
        parts = [self.all_of(depth)]
        while self.kind == "or":
            self._next()
            parts.append(self.all_of(depth))
        return parts[0] if len(parts) == 1 else Both(tuple(parts), every=False)

    def all_of(self, depth: int) -> Node:
        """One or more ``one`` side by side."""
        parts = [self.one(depth)]
        while self.kind in {"and", "not", "open", "test"}:
            if self.kind == "and":
                self._next()
            parts.append(self.one(depth))
        return parts[0] if len(parts) == 1 else Both(tuple(parts), every=True)

    def one(self, depth: int) -> Node:
        """A test, a negation or a group."""
        if depth > DEEPEST:
            self.refuse(f"at most {DEEPEST} levels")
        if self.kind == "not":
            self._next()
            return Not(self.one(depth + 1))
        if self.kind == "open":
            self._next()
            node = self.any_of(depth + 1)
            if self.kind != "close":
                self.refuse("a closing parenthesis")
            self._next()
            return node
        if self.kind != "test" or self._test is None:
            self.refuse("field:value")
        test = self._test
        self._next()
        return test

    def _next(self) -> None:
        rest = self._text[self._end :]
        self._at = self._end + len(rest) - len(rest.lstrip()) + 1
        self.kind = None
        if not rest.strip():
            return
        found = TOKEN.match(self._text, self._end)
        if found is None:
            self.kind = "other"
            self.refuse("field:value")
        self._end = found.end()
        self.kind = str(found.lastgroup) if found["test"] is None and found["word"] is None else "test"
        if found["word"] is not None:
            self.kind = found["word"].lower()
        elif found["test"] is not None:
            self._test = Comparison(found["field"], found["operator"], self._values(), self._at)

    def _values(self) -> tuple[str, ...]:
        values = []
        while True:
            found = VALUE.match(self._text, self._end)
            if found is None:
                got = self._text[self._end : self._end + 20].strip()
                refuse(self._end + 1, "a value", repr(got) if got else "the end")
            self._end = found.end()
            values.append(found["quoted"] if found["bare"] is None else found["bare"])
            comma = COMMA.match(self._text, self._end)
            if comma is None:
                return tuple(values)
            self._end = comma.end()
