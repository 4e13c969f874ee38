"""What a check of a subject says: ``Finding`` and ``Report``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Severity = Literal["ok", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at. ``hint`` says what to do about it, and is empty where all is well."""

    severity: Severity
    what: str
    expected: str
    got: str
    hint: str = ""


@dataclass(frozen=True)
class Report:
    """All findings about the subject in ``root``, in the order they were made."""

    root: Path
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """True when training on the subject makes sense: no finding is an error (warnings may be)."""
        return not self.of("error")

    def of(self, severity: Severity) -> tuple[Finding, ...]:
        """The findings of one severity."""
        return tuple(finding for finding in self.findings if finding.severity == severity)


def render(report: Report) -> str:
    """The report as text for a person: one line a finding, hints indented below, a verdict at the end."""
    lines = [f"{report.root}"]
    for finding in report.findings:
        lines.append(f"  {finding.severity:<8}{finding.what}: {finding.got}")
        if finding.severity != "ok":
            lines.append(f"          expected {finding.expected}")
        if finding.hint:
            lines.append(f"          {finding.hint}")
    errors, warnings = len(report.of("error")), len(report.of("warning"))
    verdict = "fit for use" if report.ok else "NOT fit for use"
    return "\n".join([*lines, f"{verdict}: {errors} errors, {warnings} warnings"])
