"""The paper's figures, read from the data file beside this module."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from rsavatar.report.cells import cell_of
from rsavatar.report.formats import Cell, Column

COLUMNS = (
    Column("paper_psnr", "paper: PSNR"),
    Column("paper_ssim", "paper: SSIM"),
    Column("paper_lpips", "paper: LPIPS"),
)
DECIMALS = {"psnr": 2, "ssim": 3, "lpips": 3}


@dataclass(frozen=True)
class PaperTable:
    """One of the paper's tables: which one and on what data, and its rows."""

    source: str
    rows: Mapping[str, Mapping[str, float]]

    def cells(self, key: str) -> tuple[Cell, ...]:
        """Cells of ``COLUMNS`` for a row; dashes where the paper has none."""
        row = self.rows.get(key, {})
        return tuple(cell_of(row.get(name), decimals) for name, decimals in DECIMALS.items())

    def note(self) -> str:
        """What a reader must know before comparing."""
        return f"The paper's figures are of other data ({self.source}): compare differences only."


@cache
def paper_table(name: str) -> PaperTable:
    """``main`` or ``ablation``."""
    text = files("rsavatar.report").joinpath("paper.toml").read_text("utf-8")
    return PaperTable(**tomllib.loads(text)[name])
