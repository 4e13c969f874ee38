"""Pictures of a job by camera, frame and kind."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Header, Path, Response
from pydantic import BaseModel

from services.api.deps import Back, JobId
from services.store import pictures

CAMERA = r"^[A-Za-z0-9_-]{1,32}$"
Kind = Literal["input", "exposed", "result", "truth"]
Camera = Annotated[str, Path(pattern=CAMERA, description="name of a camera")]
Frame = Annotated[int, Path(ge=0, le=999_999, description="frame, from 0")]

router = APIRouter(prefix="/jobs/{job_id}/frames", tags=["pictures"])


class CameraFrames(BaseModel):
    """A camera of a job. Held-out cameras have no ``input``: nothing was recorded there but the truth."""

    camera: str
    frames: list[int]
    kinds: list[Kind]

    @classmethod
    def of(cls, view: pictures.View) -> CameraFrames:
        """The reply for a view."""
        return cls.model_validate(vars(view) | {"frames": list(view.frames), "kinds": list(view.kinds)})


@router.get("")
def list_frames(job_id: JobId, back: Back) -> list[CameraFrames]:
    """Which pictures there are; an empty list for a job that has not ended or kept none."""
    return [CameraFrames.of(view) for view in pictures.views(back.store, job_id)]


@router.get("/{camera}/{frame}/{kind}.png", response_class=Response)
def get_frame(
    job_id: JobId,
    camera: Camera,
    frame: Frame,
    kind: Kind,
    back: Back,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """``input``: what a training camera saw. ``exposed``: what the method's shutter predicts that it saw.
    ``result``: sharp, at the mid row. ``truth``: the sharp frame of the subject.
    """
    data, tag = pictures.read(back.store, job_id, camera, frame, kind)
    headers = {"etag": f'"{tag}"', "cache-control": "private, max-age=3600"}
    if if_none_match == headers["etag"]:
        return Response(status_code=304, headers=headers)
    return Response(data, media_type="image/png", headers=headers)
