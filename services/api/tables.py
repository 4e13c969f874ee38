"""Tables: the newest result of every spec, rendered by the core's report module. Equal rows give equal bytes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Literal

from fastapi import APIRouter, Response

from rsavatar.report.tables import TABLES, Row, render
from rsavatar.spec import Preset
from services.api.deps import Back
from services.errors import NotFoundError
from services.store import metrics
from services.store.records import TableEntry
from services.store.session import Store

Format = Literal["json", "csv", "md", "tex"]
MIMES: dict[str, str] = {
    "json": "application/json",
    "csv": "text/csv; charset=utf-8",
    "md": "text/markdown; charset=utf-8",
    "tex": "application/x-tex; charset=utf-8",
}
OF_THE_SUBJECT = frozenset({"cameras", "frames"})  # in a protocol, but no difference in how numbers are made

router = APIRouter(prefix="/tables", tags=["tables"])


@router.get("/{name}.{format}", response_class=Response)
def get_table(name: str, format: Format, back: Back, preset: Preset | None = None) -> Response:
    """``main`` or ``per-subject`` as JSON, CSV, Markdown or LaTeX, of all jobs or of one preset."""
    if name not in TABLES:
        raise NotFoundError("table", f"one of {', '.join(TABLES)}", repr(name))
    return Response(render(name, rows_of(back.store, preset), format), media_type=MIMES[format])


def rows_of(store: Store, preset: str | None = None) -> list[Row]:
    """The rows of all tables."""
    return [to_row(entry) for entry in metrics.table_entries(store, preset)]


def to_row(entry: TableEntry) -> Row:
    """A stored result as a row of the report."""
    names = ("psnr", "ssim", "flip", "lpips", "joint_mm", "sub_frame_joint_mm")
    return Row(
        method=entry.job.method,
        subject=entry.job.subject,
        seed=int(entry.job.spec.get("seed", 0)),
        **{name: entry.means.get(name) for name in names},
        train_seconds=entry.train_seconds,
        gaussians=entry.gaussians,
        iterations=int(entry.job.spec.get("iterations", 0)),
        job_id=entry.job.id,
        commit=str(entry.provenance.get("commit") or ""),
        data_sha256=str(entry.provenance.get("data_sha256") or ""),
        protocol=protocol_words(entry.protocol),
    )


def protocol_words(protocol: Mapping[str, Any]) -> str:
    """How the numbers of a job were made, in one line."""
    words = {key: value for key, value in protocol.items() if key not in OF_THE_SUBJECT}
    return json.dumps(words, sort_keys=True, ensure_ascii=False)
