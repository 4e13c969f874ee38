"""What stored results say: did modelling the shutter help, where, and at what cost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from statistics import fmean

from rsavatar.errors import SpecError
from rsavatar.report.tables import LABELS
from rsavatar.spec import resolve
from services.store.records import TableEntry

OURS, BASELINE = "rs-avatar", "gauhuman"
PRESETS = ("paper", "draft", "smoke")  # from the most to the least that a result means
MARGIN = 0.08  # of the span of an axis, beyond its outermost marks


@dataclass(frozen=True)
class Mark:
    """A method's PSNR on a subject; ``x`` is its place on the axis, 0 to 100."""

    method: str
    value: float
    x: float
    job_id: str


@dataclass(frozen=True)
class Lane:
    """A subject's marks, the worst first, and what ours gains over ignoring the shutter."""

    subject: str
    marks: tuple[Mark, ...]
    gain: float | None

    @property
    def span(self) -> tuple[float, float]:
        """Where the bar between the baseline and ours begins and ends."""
        pair = [mark.x for mark in self.marks if mark.method in {OURS, BASELINE}]
        return (min(pair), max(pair)) if len(pair) == 2 else (0.0, 0.0)


@dataclass(frozen=True)
class Finding:
    """The answer in numbers. ``gain`` in dB and ``cost`` (a ratio of training times) are means over subjects."""

    preset: str
    lanes: tuple[Lane, ...]
    ticks: tuple[tuple[float, float], ...]  # place, PSNR
    gain: float | None
    cost: float | None
    recovered: float | None  # (ours - baseline) / (oracle - baseline)
    compared: int


def plain(entries: Iterable[TableEntry]) -> list[TableEntry]:
    """Results of methods as they are meant: a preset's own values but for the seed; else at least nothing removed."""
    whole = [e for e in entries if not any((e.job.spec.get("ablation") or {}).values())]
    return [e for e in whole if e.job.spec_sha256 == _of_preset(*_words(e))] or whole


def _words(entry: TableEntry) -> tuple[str, str, str, int]:
    spec = entry.job.spec
    return entry.job.method, entry.job.subject, str(spec.get("preset")), int(spec.get("seed", 0))


@cache
def _of_preset(method: str, subject: str, preset: str, seed: int) -> str | None:
    try:
        return resolve({"method": method, "subject": subject, "preset": preset, "seed": seed}).sha256()
    except SpecError:  # a method or preset of another version of the code
        return None


def presets_of(entries: Iterable[TableEntry]) -> list[str]:
    """Presets that have results, the most telling first."""
    found = Counter(str(e.job.spec.get("preset")) for e in entries)
    return [name for name in PRESETS if found[name]]


def finding(entries: Sequence[TableEntry], preset: str) -> Finding:
    """What the results of a preset say, seeds averaged."""
    chosen = [e for e in plain(entries) if e.job.spec.get("preset") == preset and e.means.get("psnr") is not None]
    values = [float(e.means["psnr"] or 0.0) for e in chosen]
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    pad = max(high - low, 0.5) * MARGIN
    low, high = low - pad, high + pad
    lanes = tuple(_lane(chosen, subject, low, high) for subject in sorted({e.job.subject for e in chosen}))
    gains = [lane.gain for lane in lanes if lane.gain is not None]
    ratios = [r for r in (_cost(chosen, lane.subject) for lane in lanes) if r is not None]
    return Finding(
        preset,
        lanes,
        _ticks(low, high),
        fmean(gains) if gains else None,
        fmean(ratios) if ratios else None,
        _recovered(lanes),
        len(gains),
    )


def _lane(entries: Sequence[TableEntry], subject: str, low: float, high: float) -> Lane:
    groups: dict[str, list[TableEntry]] = {}
    for entry in entries:
        if entry.job.subject == subject:
            groups.setdefault(entry.job.method, []).append(entry)
    marks = []
    for method, group in groups.items():
        value = fmean(float(e.means["psnr"] or 0.0) for e in group)
        newest = max(group, key=lambda e: e.job.id).job.id
        marks.append(Mark(method, value, 100 * (value - low) / (high - low), newest))
    found = {mark.method: mark.value for mark in marks}
    gain = found[OURS] - found[BASELINE] if {OURS, BASELINE} <= found.keys() else None
    return Lane(subject, tuple(sorted(marks, key=lambda mark: mark.value)), gain)


def _recovered(lanes: Sequence[Lane]) -> float | None:
    """Of the subjects whose true motion was trained, as the main table has it: a ratio of means."""
    found = [{mark.method: mark.value for mark in lane.marks} for lane in lanes]
    whole = [f for f in found if {OURS, BASELINE, "oracle"} <= f.keys()]
    ceiling = sum(f["oracle"] - f[BASELINE] for f in whole)
    return sum(f[OURS] - f[BASELINE] for f in whole) / ceiling if ceiling > 0 else None


def _cost(entries: Sequence[TableEntry], subject: str) -> float | None:
    seconds = {
        method: [e.train_seconds for e in entries if (e.job.subject, e.job.method) == (subject, method)]
        for method in (OURS, BASELINE)
    }
    return fmean(seconds[OURS]) / fmean(seconds[BASELINE]) if all(seconds.values()) else None


def _ticks(low: float, high: float) -> tuple[tuple[float, float], ...]:
    step = next((s for s in (0.5, 1.0, 2.0, 5.0, 10.0) if (high - low) / s <= 7), 20.0)
    first = -(-low // step) * step
    values = [first + i * step for i in range(int((high - first) / step) + 1)]
    return tuple((100 * (value - low) / (high - low), value) for value in values)


def in_order(methods: Iterable[str]) -> list[str]:
    """Methods in the paper's order."""
    rank = {method: i for i, method in enumerate(LABELS)}
    return sorted(set(methods), key=lambda m: (rank.get(m, len(rank)), m))
