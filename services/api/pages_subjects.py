"""Subjects: who they are, how far their pixels move, what the check said, and how to bring one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import FileResponse, HTMLResponse

from services.api.deps import Back
from services.api.layout import PageRoute, page
from services.errors import NotFoundError
from services.store import listing, pictures, subjects
from services.store.session import Store
from services.store.subject_records import Subject

LARGEST_META = 1 << 20
PICTURES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}

router = APIRouter(route_class=PageRoute, prefix="/subjects")


@dataclass(frozen=True)
class Card:
    """A subject as its card shows it; what its files do not say is none."""

    subject: Subject
    thumbnail: str | None
    facts: tuple[tuple[str, str], ...]
    report: Mapping[str, Any] | None
    licence: str | None


@router.get("", response_class=HTMLResponse)
def list_page(request: Request, back: Back) -> HTMLResponse:
    """All subjects."""
    found = subjects.all_of(back.store)
    shown = listing.with_pictures(back.store, [s.name for s in found])
    cards = [card_of(back.store, subject, shown.get(subject.name)) for subject in found]
    return page(request, "subjects.html", {"cards": cards})


@router.get("/{name}/thumbnail", response_class=FileResponse)
def thumbnail(name: str, back: Back) -> FileResponse:
    """A picture of a registered directory: its first training camera, halfway through."""
    path = _picture(subjects.get(back.store, name))
    if path is None:
        raise NotFoundError("thumbnail", "a subject with pictures", repr(name))
    return FileResponse(
        path, media_type=PICTURES[path.suffix.lower()], headers={"cache-control": "private, max-age=3600"}
    )


def card_of(store: Store, subject: Subject, job_id: str | None) -> Card:
    """What is known of a subject: from its registration, its own description, or a job that has used it."""
    meta = _meta(subject)
    report = subject.info.get("report") or subject.info.get("check")
    image = None
    if job_id is not None:
        image = _from_job(store, job_id)
    elif _picture(subject) is not None:
        image = f"/subjects/{subject.name}/thumbnail"
    licence = meta.get("licence")
    facts = _facts(meta) if meta else _facts_of_job(store, job_id)
    return Card(subject, image, tuple(facts), report, str(licence) if licence else None)


def _facts_of_job(store: Store, job_id: str | None) -> list[tuple[str, str]]:
    """What the pictures of a job tell of a subject that has no files of its own."""
    views = [] if job_id is None else pictures.views(store, job_id)
    if not views:
        return []
    training = sum("input" in view.kinds for view in views)
    return [("Frames", str(len(views[0].frames))), ("Cameras", f"{training} + {len(views) - training}")]


def _from_job(store: Store, job_id: str) -> str | None:
    for view in pictures.views(store, job_id):
        if "input" in view.kinds:
            return f"/api/v1/jobs/{job_id}/frames/{view.camera}/{view.frames[len(view.frames) // 2]}/input.png"
    return None


def _facts(meta: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Size, cameras, and the numbers of the rolling shutter: K, readout, D, e."""
    moved = meta.get("displacement_px") if isinstance(meta.get("displacement_px"), dict) else {}
    card = meta.get("card") if isinstance(meta.get("card"), dict) else {}
    wide = moved.get("max", card.get("D")) if isinstance(moved, dict) and isinstance(card, dict) else None
    depth = meta.get("e", card.get("e") if isinstance(card, dict) else None)
    known = [
        ("Frames", meta.get("frames")),
        ("Size", f"{meta['size']} px" if isinstance(meta.get("size"), int) else None),
        ("Cameras", f"{len(meta.get('train', []))} + {len(meta.get('test', []))}" if meta.get("train") else None),
        ("K", meta.get("K")),
        ("Readout", f"{100 * float(meta['gamma']):.0f} %" if isinstance(meta.get("gamma"), int | float) else None),
        ("D", f"{float(wide):.0f} px" if isinstance(wide, int | float) else None),
        ("e", depth),
        ("Triggers", _triggers(meta)),
    ]
    return [(name, str(value)) for name, value in known if value is not None]


def _triggers(meta: Mapping[str, Any]) -> str | None:
    delta = meta.get("delta")
    if not isinstance(delta, list) or not all(isinstance(d, int | float) for d in delta):
        return None
    late = max((abs(float(d)) for d in delta), default=0.0)
    return f"up to {late:.1f} frames late" if late else "together"


def _meta(subject: Subject) -> dict[str, Any]:
    """``meta.json`` of a registered directory, as far as it can be read."""
    path = Path(subject.path or "", "meta.json")
    if subject.path is None or not path.is_file() or path.stat().st_size > LARGEST_META:
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _picture(subject: Subject) -> Path | None:
    """A picture of the first camera's folder that has one; only files under the registered directory."""
    if subject.path is None:
        return None
    root = Path(subject.path).resolve()
    folder = next((f for f in (root / "rs" / "images", root / "images", root) if f.is_dir()), root)
    for camera in sorted(path for path in folder.iterdir() if path.is_dir())[:40]:
        files = sorted(path for path in camera.iterdir() if path.suffix.lower() in PICTURES)
        if files and files[len(files) // 2].resolve().is_relative_to(root):
            return files[len(files) // 2]
    return None
