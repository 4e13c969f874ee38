"""A study's tables as Markdown: one per group of variants, means over subjects and seeds, differences to the first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import mean, stdev

from rsavatar.bench.study import Column, Study, StudyResult, Variant


def render(study: Study, result: StudyResult) -> str:
    """The whole page."""
    subjects = list(dict.fromkeys(run.subject for run in result.runs))
    seeds = sorted({run.seed for run in result.runs})
    machine = result.machine
    lines = [
        f"# {study.title}",
        "",
        study.about.strip(),
        "",
        f"Written by `{result.command}`; the same figures as data are beside this page. Preset `{result.preset}`"
        f" ({result.iterations} steps where a row does not say otherwise), subjects {', '.join(subjects)},"
        f" {len(seeds)} seed{'s' * (len(seeds) > 1)}; means over frames, cameras, subjects and seeds."
        f" Commit {machine.commit}; {machine.processor}, {machine.instructions}.",
    ]
    for group in dict.fromkeys(variant.group for variant in study.variants):
        variants = [v for v in study.variants if v.group == group]
        lines += ["", *([f"## {group}", ""] if group else []), *_table(study, result, variants, subjects)]
    failed = [f"- {r.subject}, seed {r.seed}, {r.variant}: {r.error}" for r in result.runs if r.error]
    return "\n".join([*lines, *(["", "Failed:", "", *failed] if failed else [])]) + "\n"


def _table(study: Study, result: StudyResult, variants: Sequence[Variant], subjects: Sequence[str]) -> Iterator[str]:
    first, several = variants[0].name, len(subjects) > 1
    headings = ["variant", *(c.heading for c in study.columns), "Δ PSNR"]
    headings += [f"{study.each.heading}, {s}" for s in subjects] if several else []
    headings += [study.reported] if study.reported else []
    yield "| " + " | ".join(headings) + " |"
    yield "|---" + "|---:" * (len(headings) - 1) + "|"
    for variant in variants:
        cells = [variant.name, *(_cell(result, variant.name, c) for c in study.columns)]
        cells.append(_difference(result, variant.name, first))
        cells += [_cell(result, variant.name, study.each, subject) for subject in subjects] if several else []
        cells += [variant.reported or "–"] if study.reported else []
        yield "| " + " | ".join(cells) + " |"


def _cell(result: StudyResult, variant: str, column: Column, subject: str | None = None) -> str:
    values = result.of(variant, subject, column.key)
    return f"{mean(values):.{column.digits}f}" if values else "–"


def _difference(result: StudyResult, variant: str, first: str) -> str:
    """Mean of the differences on the same subject and seed, with their standard error where there are several."""
    psnr = {(r.subject, r.seed): r.values["psnr"] for r in result.runs if r.variant == first and r.values.get("psnr")}
    pairs = [(r.values.get("psnr"), psnr.get((r.subject, r.seed))) for r in result.runs if r.variant == variant]
    found = [a - b for a, b in pairs if a is not None and b is not None]
    if variant == first or not found:
        return "–"
    spread = f" ± {stdev(found) / len(found) ** 0.5:.2f}" if len(found) > 1 else ""
    return f"{mean(found):+.2f}{spread}"
