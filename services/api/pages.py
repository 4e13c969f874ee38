"""All pages. Complete without scripts; modules keep them fresh, and the address holds what is shown."""

from __future__ import annotations

from fastapi import APIRouter

from services.api import (
    pages_benchmarks,
    pages_figures,
    pages_grids,
    pages_home,
    pages_job,
    pages_jobs,
    pages_subjects,
    pages_viewer,
)

router = APIRouter(include_in_schema=False)
for part in (
    pages_home,
    pages_jobs,
    pages_job,
    pages_grids,
    pages_benchmarks,
    pages_subjects,
    pages_viewer,
    pages_figures,
):
    router.include_router(part.router)
