"""Tables: the newest result of every spec, rendered by the core's report module. Equal rows give equal bytes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Response
from pydantic import BaseModel, ConfigDict, Field

from rsavatar.report.rows import Row, Settings
from rsavatar.report.tables import TABLES, render
from rsavatar.spec import NOT_OF_RESULT, Preset
from services.api.deps import UUID, Back
from services.api.labels import Tag
from services.errors import NotFoundError
from services.store import metrics
from services.store.query import LONGEST
from services.store.records import Filters, TableEntry
from services.store.session import Store

Format = Literal["json", "csv", "md", "tex"]
MIMES: dict[str, str] = {
    "json": "application/json",
    "csv": "text/csv; charset=utf-8",
    "md": "text/markdown; charset=utf-8",
    "tex": "application/x-tex; charset=utf-8",
}
OF_THE_SUBJECT = frozenset({"cameras", "frames"})  # in a protocol, but no difference in how numbers are made
APART = frozenset({"method", "subject", "seed", "preset", "checkpoint_every"}) | NOT_OF_RESULT  # no settings of a line

router = APIRouter(prefix="/tables", tags=["tables"])


class TableQuery(BaseModel):
    """Which results a table is of; without any, the newest of every spec."""

    model_config = ConfigDict(extra="forbid")

    preset: Preset | None = None
    grid: str | None = Field(None, pattern=UUID, description="jobs of one grid")
    tag: Tag | None = Field(None, description="jobs with one tag")
    seed: list[Annotated[int, Field(ge=0)]] = Field([], max_length=100, description="repeat it for several seeds")
    q: str | None = Field(None, max_length=LONGEST, description="as of GET /jobs")

    def filters(self) -> Filters:
        """The query as the filter of a listing."""
        return Filters(grid=self.grid, query=self.q, preset=self.preset, tag=self.tag, seeds=self.seed)


@router.get("/{name}.{format}", response_class=Response)
def get_table(name: str, format: Format, query: Annotated[TableQuery, Query()], back: Back) -> Response:
    """``main``, ``ablation``, ``per-subject``, ``shutter`` or ``cost`` as JSON, CSV, Markdown or LaTeX."""
    if name not in TABLES:
        raise NotFoundError("table", f"one of {', '.join(TABLES)}", repr(name))
    return Response(render(name, rows_of(back.store, filters=query.filters()), format), media_type=MIMES[format])


def rows_of(store: Store, preset: str | None = None, filters: Filters | None = None) -> list[Row]:
    """The rows of all tables."""
    return [to_row(entry) for entry in metrics.table_entries(store, preset, filters)]


def to_row(entry: TableEntry) -> Row:
    """A stored result as a row of the report; one that is reused is told as the job that found it."""
    names = ("psnr", "ssim", "flip", "lpips", "joint_mm", "sub_frame_joint_mm")
    work = entry.provenance.get("work") or {}
    return Row(
        method=entry.job.method,
        subject=entry.job.subject,
        seed=int(entry.job.spec.get("seed", 0)),
        **{name: entry.means.get(name) for name in names},
        train_seconds=entry.train_seconds,
        gaussians=entry.gaussians,
        iterations=int(entry.job.spec.get("iterations", 0)),
        job_id=entry.job.reused_from or entry.job.id,
        commit=str(entry.provenance.get("commit") or ""),
        data_sha256=str(entry.provenance.get("data_sha256") or ""),
        protocol=protocol_words(entry.protocol),
        preset=str(entry.job.spec.get("preset") or ""),
        evaluate_seconds=entry.evaluate_seconds,
        renders=_an_image(work, "drawn_passes"),
        paper_renders=_an_image(work, "paper_passes"),
        settings=settings_of(entry.job.spec),
        restorer=str(entry.provenance.get("restorer") or ""),
    )


def _an_image(work: Mapping[str, Any], what: str) -> float | None:
    """A count of one look at every training image, for one image: a step looks at one."""
    images = work.get("images")
    return work[what] / images if images and what in work else None


def settings_of(spec: Mapping[str, Any]) -> Settings:
    """The words of a job that decide its result, as text; flags of the ablation joined by ``+``."""
    words: dict[str, str] = {}
    for name, value in spec.items():
        if isinstance(value, Mapping):
            chosen = [key for key, item in value.items() if item is True]
            words[name] = "+".join(chosen) if name == "ablation" else _plain(value)
        elif name not in APART and value is not None:
            words[name] = _plain(value)
    return tuple(sorted((name, text) for name, text in words.items() if text))


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)


def protocol_words(protocol: Mapping[str, Any]) -> str:
    """How the numbers of a job were made, in one line."""
    words = {key: value for key, value in protocol.items() if key not in OF_THE_SUBJECT}
    return json.dumps(words, sort_keys=True, ensure_ascii=False)
