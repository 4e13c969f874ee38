"""Figures: made again from the database and the artifacts whenever somebody asks, and kept until something changes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query, Response
from pydantic import BaseModel, ConfigDict, Field

from rsavatar.errors import SpecError
from rsavatar.report.figures import FIGURES, build
from rsavatar.report.runs import Figure, Run, Wish, of_preset, standard
from rsavatar.spec import Preset, resolve
from services.api.deps import Back, Backend
from services.api.sources import source_of
from services.api.threads import waiting
from services.errors import NotFoundError
from services.store import curves, metrics
from services.store.records import TableEntry

Format = Literal["png", "svg", "pdf", "json"]
MIMES = {"png": "image/png", "svg": "image/svg+xml", "pdf": "application/pdf"}
SANDBOX = "default-src 'none'; style-src 'unsafe-inline'; sandbox"  # an SVG is a document: it may style itself only
OF_CURVES, OF_SCORES = frozenset({"curves"}), frozenset({"qualitative"})  # figures that need more than means

DRAWN_CURVES, CURVE_POINTS = ("psnr", "loss"), 400

router = APIRouter(prefix="/figures", tags=["figures"])


class FigureQuery(BaseModel):
    """What a figure shows; what is left out, it chooses itself and says so."""

    model_config = ConfigDict(extra="forbid")

    preset: Preset | None = None
    subject: str | None = Field(None, max_length=128)
    camera: str | None = Field(None, max_length=32)
    frame: int | None = Field(None, ge=0, le=999_999)

    def wish(self) -> Wish:
        """The core's word for it."""
        return Wish(**self.model_dump())


@router.get("/{name}.{format}", response_class=Response)
@waiting
def get_figure(
    name: str,
    format: Format,
    query: Annotated[FigureQuery, Query()],
    back: Back,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """A figure of the results as PNG, SVG or PDF; what it shows and comes from as JSON; 404 while data are lacking."""
    if name not in FIGURES:
        raise NotFoundError("figure", f"one of {', '.join(FIGURES)}", repr(name))
    figure = figure_of(back, name, query.wish())
    if figure.lacking:
        raise NotFoundError(f"figure {name}", f"{figure.lacking} (try: {FIGURES[name].recipe})", "none")
    if format == "json":
        return Response(json.dumps(figure.to_json(), indent=2) + "\n", media_type="application/json")
    order = {"verb": "figure", "figure": figure.to_json(), "format": format, "sources": sources_of(back, figure)}
    headers = {"content-security-policy": SANDBOX, "content-disposition": f'inline; filename="{name}.{format}"'}
    return back.drawings.reply("files", order, MIMES[format], if_none_match, headers)


def figure_of(back: Backend, name: str, wish: Wish) -> Figure:
    """The numbers of a figure, or what it lacks.

    Raises:
        SpecError: if ``wish`` names what no run has.
    """
    runs = [to_run(entry) for entry in metrics.table_entries(back.store, wish.preset)]
    if name in OF_CURVES:
        runs = compared(runs, wish)
        found = curves.of_jobs(back.store, [run.job_id for run in runs], DRAWN_CURVES, CURVE_POINTS)
        runs = [replace(run, curves=found[run.job_id]) for run in runs]
    if name in OF_SCORES:
        runs = [replace(run, scores=scores_of(back, run.job_id)) for run in compared(runs, wish)]
    return build(name, runs, wish)


def compared(runs: Sequence[Run], wish: Wish) -> list[Run]:
    """The runs that a comparison of methods is made from: for them alone more than means is read."""
    return standard(of_preset(runs, wish.preset))


def to_run(entry: TableEntry) -> Run:
    """A stored result in the words of the report."""
    job, spec = entry.job, entry.job.spec
    return Run(
        job_id=job.id,
        method=job.method,
        subject=job.subject,
        seed=int(spec.get("seed", 0)),
        preset=str(spec.get("preset", "")),
        bands=str(spec.get("T") or "K"),
        motion=str(spec.get("motion", "")),
        ablation=tuple(flag for flag, is_set in dict(spec.get("ablation") or {}).items() if is_set),
        is_standard=is_standard(dict(spec)),
        iterations=int(spec.get("iterations", 0)),
        train_seconds=entry.train_seconds,
        gaussians=entry.gaussians,
        commit=str(entry.provenance.get("commit") or ""),
        data_sha256=str(entry.provenance.get("data_sha256") or ""),
        means=entry.means,
    )


def is_standard(spec: dict[str, Any]) -> bool:
    """Whether a spec is what its preset says for its method, subject and seed."""
    wanted = {key: spec.get(key) for key in ("method", "subject", "preset", "seed")}
    try:
        return resolve(wanted).sha256() == resolve(spec).sha256()
    except SpecError:  # stored by a version that knew other words
        return False


def scores_of(back: Backend, job_id: str) -> dict[tuple[str, int], float]:
    """PSNR of every held-out view of a job."""
    scores = metrics.outcome_of(back.store, job_id).scores
    return {(s.camera, s.frame): s.value for s in scores if s.metric == "psnr" and s.value is not None}


def sources_of(back: Backend, figure: Figure) -> dict[str, Any]:
    """The avatars that a figure's pictures are rendered from, by job."""
    jobs = [column["job"] for column in figure.pictures.get("columns", ())]
    jobs += [figure.pictures["job"]] if "job" in figure.pictures else []
    return {job: source_of(back, job) for job in jobs}
