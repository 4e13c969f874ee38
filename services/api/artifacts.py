"""Artifacts by their hash."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Annotated

from fastapi import APIRouter, Path
from fastapi.responses import FileResponse

from services.api.deps import Back
from services.store import artifacts

SHA256 = r"^[0-9a-f]{64}$"
INLINE = frozenset({"image/png"})  # everything else is offered as a download, so that no browser runs it

router = APIRouter(prefix="/artifacts", tags=["artifacts"])


@router.get("/{sha256}", response_class=FileResponse)
def download(sha256: Annotated[str, Path(pattern=SHA256)], back: Back) -> FileResponse:
    """A stored file. Its bytes never change, so it may be kept for ever; ranges are answered."""
    artifact, path = artifacts.find(back.store, sha256)
    headers = {
        "cache-control": "private, max-age=31536000, immutable",
        "etag": f'"{sha256}"',
        "content-security-policy": "default-src 'none'; sandbox",
    }
    kind = "inline" if artifact.mime in INLINE else "attachment"
    name = PurePosixPath(artifact.name).name
    if "." not in name:
        name += {"application/json": ".json", "image/png": ".png"}.get(artifact.mime, "")
    return FileResponse(path, media_type=artifact.mime, filename=name, content_disposition_type=kind, headers=headers)
