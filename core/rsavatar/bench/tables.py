"""Results as tables: on a terminal, and as Markdown for the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rsavatar.bench.results import Curve, GrowthResult, Point, RenderResult, Target, WayFigures

WIDTH = 140  # columns of a terminal that the widest table needs; narrower ones wrap its lines


@dataclass(frozen=True)
class TextTable:
    """Cells as text; the first column is set to the left, the others to the right."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """As a Markdown table, without its title."""
        rule = ":--|" + "--:|" * (len(self.header) - 1)
        lines = ["| " + " | ".join(row) + " |" for row in (self.header, *self.rows)]
        return "\n".join([lines[0], "|" + rule, *lines[1:]])


def show(result: RenderResult | GrowthResult) -> None:
    """Print every table of a result."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=max(Console().width, WIDTH), highlight=False)
    for table in of(result):
        console.print(table.title, style="bold")
        drawn = Table()
        for k, name in enumerate(table.header):
            drawn.add_column(name, justify="right" if k else "left")
        for row in table.rows:
            drawn.add_row(*row)
        console.print(drawn)


def of(result: RenderResult | GrowthResult) -> list[TextTable]:
    """A result's tables, the targets first."""
    return _of_render(result) if isinstance(result, RenderResult) else _of_growth(result)


def _of_render(result: RenderResult) -> list[TextTable]:
    motions = sorted({f.motion_px for f in result.ways})
    by_motion = [_ways(f"{m:g} px of motion", [f for f in result.ways if f.motion_px == m]) for m in motions]
    ratios = tuple((f"{r.above} / {r.below}", f"{r.value:.2f}") for r in result.ratios)
    orders = tuple((f"{o.motion_px:g} px", ", ".join(map(str, o.bands)), f"{o.order:.2f}") for o in result.orders)
    return [
        targets(result.targets),
        *by_motion,
        TextTable("Ratios of forward and backward", ("ratio", "value"), ratios),
        TextTable("Order of convergence of bands: error ~ T^-order", ("motion", "T", "order"), orders),
    ]


def targets(found: Sequence[Target]) -> TextTable:
    """Promises, and what came of them."""
    rows = tuple(
        (t.name, f"{t.sense} {t.bound:g} {t.unit}".strip(), f"{t.measured:.4g} {t.unit}".strip(), verdict(t))
        for t in found
    )
    return TextTable("Targets", ("what", "target", "measured", "verdict"), rows)


def verdict(target: Target) -> str:
    """In two words at most."""
    return "met" if target.met else "not met"


def _ways(title: str, figures: Sequence[WayFigures]) -> TextTable:
    header = (
        "way", "PSNR dB", "of seeds", "max abs", "px off", "PSNR of the rest", "motion gradient", "fwd ms",
        "fwd+bwd ms", "n",
    )  # fmt: skip
    return TextTable(title, header, tuple(_way(f) for f in figures))


def _way(f: WayFigures) -> tuple[str, ...]:
    a = f.accuracy
    seeds = f"{min(a.psnr_by_seed_db):.1f} .. {max(a.psnr_by_seed_db):.1f}"
    errors = (f"{a.psnr_db:.1f}", seeds, f"{a.max_abs:.3f}", str(a.off_px), f"{a.psnr_rest_db:.1f}")
    gradient = f"{a.motion_gradient_error:.1e}" if a.motion_gradient_error else "0"
    return (f.label, *errors, gradient, f"{f.forward_ms:.1f}", f"{f.total_ms:.1f}", str(f.rounds))


def _of_growth(result: GrowthResult) -> list[TextTable]:
    steps = tuple((name, f"{ms:.1f}") for name, ms in result.step_ms.items())
    ratios = tuple((f"{r.above} / {r.below}", f"{r.value:.2f}") for r in result.ratios)
    return [
        targets(result.targets),
        TextTable("Whole training step", ("way", "ms"), steps),
        TextTable("Ratios", ("ratio", "value"), ratios),
        *(_curve(curve) for curve in result.curves),
    ]


MEASURES = {"forward_ms": "fwd ms", "total_ms": "fwd+bwd ms", "step_ms": "training step ms", "memory_mb": "memory MB"}


def _curve(curve: Curve) -> TextTable:
    present = [key for key in MEASURES if any(getattr(p, key) is not None for p in curve.points)]
    rows = tuple((f"{p.x:g}", *(_value(p, key) for key in present)) for p in curve.points)
    title = f"By {curve.axis}: {curve.name}; {curve.fixed}"
    return TextTable(title, (AXES[curve.axis], *(MEASURES[key] for key in present)), rows)


AXES = {
    "gaussians": "Gaussians",
    "pixels": "pixels of a side",
    "bands": "T",
    "memory": "T",
    "steps": "training steps",
    "frames": "frames",
}


def _value(point: Point, key: str) -> str:
    value = getattr(point, key)
    return "" if value is None else f"{value:.1f}"
