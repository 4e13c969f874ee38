"""Novel views of a job's avatar by our own kernels, its scene for the viewer, and files for other programs."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query, Response
from pydantic import BaseModel, ConfigDict, Field

from services.api.deps import Back, JobId
from services.api.sources import source_of
from services.api.threads import waiting
from services.store import jobs

SHUTTER = r"^(global|blur(:[1-9][0-9]?)?|rolling|bands:[1-9][0-9]{0,3})$"
LARGEST, LARGEST_VIDEO = 1024, 768  # pixels of the longer side
VIDEOS = {"mp4": "video/mp4", "webm": "video/webm", "gif": "image/gif"}
IMAGES = {"png": "image/png", "webp": "image/webp"}
BYTES = "application/octet-stream"
ALONE = "default-src 'none'; media-src 'self'; img-src 'self'"  # a video that is opened by itself may play

router = APIRouter(prefix="/jobs/{job_id}", tags=["views"])
Tag = Annotated[str | None, Header()]


class Look(BaseModel):
    """From where, when, through which shutter. Without a camera, one that frames the whole motion from the front."""

    model_config = ConfigDict(extra="forbid")

    camera: str | None = Field(None, max_length=32, description="a calibrated camera of the subject")
    time: float = Field(0.0, ge=-0.5, le=1e6, description="output frames; 3.5 is half a frame after the third")
    shutter: str = Field("global", pattern=SHUTTER, description="global, blur, blur:S, rolling, or bands:T")
    readout: float | None = Field(None, ge=0, le=1e4, description="source frames; none = the subject's own")
    azimuth: float = Field(0.0, ge=-360, le=360, description="degrees to the camera's right, around the body")
    elevation: float = Field(0.0, ge=-89, le=89, description="degrees upwards")
    zoom: float = Field(1.0, ge=0.25, le=8)
    size: int = Field(512, ge=32, le=LARGEST, description="pixels of the longer side")
    background: Literal["black", "white", "transparent"] = "black"


class ViewQuery(Look):
    """One picture."""

    format: Literal["png", "webp"] = "png"

    def order(self, source: dict[str, Any]) -> dict[str, Any]:
        """For the process that draws."""
        return {"verb": "view", "source": source, "view": self.model_dump(exclude={"format"}), "format": self.format}


class ExportQuery(Look):
    """A file: ``time`` none is the canonical pose (ply); ``moving`` plays the motion while the camera turns (video)."""

    time: float | None = Field(None, ge=-0.5, le=1e6)  # type: ignore[assignment]
    size: int = Field(512, ge=32, le=LARGEST_VIDEO)
    background: Literal["black", "white"] = "white"
    format: Literal["mp4", "webm", "gif"] = "mp4"
    pictures: int = Field(96, ge=2, le=240, description="of one turn, 24 a second")
    moving: bool = True


@router.get("/render", response_class=Response)
@waiting
def get_view(job_id: JobId, query: Annotated[ViewQuery, Query()], back: Back, if_none_match: Tag = None) -> Response:
    """A novel view. Integer times of a calibrated camera at its own size are the predictions that were scored."""
    order = query.order(source_of(back, job_id))
    return back.drawings.reply("views", order, IMAGES[query.format], if_none_match, {})


@router.get("/scene", response_class=Response)
@waiting
def get_scene(job_id: JobId, back: Back, if_none_match: Tag = None) -> Response:
    """The avatar and its motion for the viewer in the browser."""
    order = {"verb": "scene", "source": source_of(back, job_id)}
    return back.drawings.reply("views", order, BYTES, if_none_match, {})


@router.get("/export/{kind}", response_class=Response)
@waiting
def get_export(
    job_id: JobId,
    kind: Literal["ply", "turntable"],
    query: Annotated[ExportQuery, Query()],
    back: Back,
    if_none_match: Tag = None,
) -> Response:
    """``ply``: Gaussians in the layout of 3D Gaussian splatting, canonical or at ``time``. ``turntable``: a video."""
    job = jobs.get(back.store, job_id)
    source = source_of(back, job_id)
    stem = f"{job.subject}-{job.method}".replace("+", "-")
    if kind == "ply":
        name = f"{stem}-{'canonical' if query.time is None else f'frame-{query.time:g}'}.ply"
        order, mime = {"verb": "ply", "source": source, "time": query.time}, BYTES
    else:
        view = query.model_dump(exclude={"format", "pictures", "moving"}) | {"time": query.time or 0.0}
        about = {"pictures": query.pictures, "moving": query.moving, "format": query.format}
        order, mime = {"verb": "turntable", "source": source, "view": view, **about}, VIDEOS[query.format]
        name = f"{stem}-turntable.{query.format}"
    how = "attachment" if kind == "ply" else "inline"
    headers = {"content-disposition": f'{how}; filename="{name}"', "content-security-policy": ALONE}
    return back.drawings.reply("files", order, mime, if_none_match, headers)
