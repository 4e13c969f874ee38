"""Turns what a child says into batches for the store: throttled, so that a fast job does not flood the database."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from services.store.records import Artifact, Batch, Checkpoint, Event, Look, Point, fraction_of
from services.store.session import OUTAGES

Keep = Callable[[str, Path], Artifact]  # stores a file under a name
CURVES = ("loss", "psnr", "gaussians")


class Reporter:
    """Collects messages between two heartbeats. Of progress the newest is kept, of curves one point per heartbeat.

    ``moved_at`` is when the child last got somewhere: a new stage or step, a note, a checkpoint. A child that repeats
    itself does not move.
    """

    def __init__(self, keep: Keep, clock: Callable[[], float] = time.monotonic) -> None:
        self._keep = keep
        self._clock = clock
        self._events: list[Event] = []
        self._files: list[Artifact] = []
        self._look: Look | None = None
        self._checkpoint: Checkpoint | None = None
        self._place: tuple[str, int] = ("", -1)
        self.moved_at = clock()
        self.last_checkpoint: int | None = None

    def take(self, message: Mapping[str, Any]) -> None:
        """Note one message of the child; unknown kinds are passed on as they are."""
        kind = str(message["kind"])
        payload = {key: value for key, value in message.items() if key != "kind"}
        if kind == "progress":
            self._progress(payload)
            return
        self.moved_at = self._clock()
        if kind == "preview":
            kind, payload = self._preview(payload)
        elif kind == "checkpointed":
            self._take_checkpoint(payload)
            payload.pop("path")  # a path of this machine means nothing to readers
        self._events.append(Event(kind, payload))

    def _progress(self, payload: dict[str, Any]) -> None:
        place = (str(payload["stage"]), int(payload["step"]))
        if place != self._place:
            self._place = place
            self.moved_at = self._clock()
        known = {name: payload.get(name) for name in ("loss", "psnr", "gaussians")}
        self._look = Look(place[0], place[1], int(payload["steps"]), eta_seconds=payload["eta_seconds"], **known)

    def _preview(self, payload: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        name = f"preview/{int(payload['step']):08d}-{Path(payload['path']).name}"
        try:
            file = self._keep(name, Path(payload["path"]))
        except (OSError, *OUTAGES) as error:  # a picture is not worth a job
            return "note", {"text": f"preview lost: {error}"}
        self._files.append(file)
        return "preview", {"step": payload["step"], "caption": payload["caption"], "sha256": file.sha256}

    def _take_checkpoint(self, payload: Mapping[str, Any]) -> None:
        """Store a copy that other machines can go on from. One that is replaced while it is read is no copy."""
        self.last_checkpoint = int(payload["step"])
        try:
            file = self._keep("checkpoint", Path(payload["path"]))
        except (OSError, *OUTAGES) as error:  # the file on this machine's disk is as good
            self._events.append(Event("note", {"text": f"checkpoint of step {payload['step']} not stored: {error}"}))
            return
        if file.sha256 == payload["sha256"]:
            self._checkpoint = Checkpoint(self.last_checkpoint, file.sha256, file.size)

    def note(self, text: str) -> None:
        """A sentence of the worker's own."""
        self._events.append(Event("note", {"text": text}))

    def flush(self, rss_bytes: int | None = None) -> Batch:
        """Everything since the last flush."""
        events, files, look, checkpoint = self._events, self._files, self._look, self._checkpoint
        self._events, self._files, self._look, self._checkpoint = [], [], None, None
        points: list[Point] = []
        if look is not None:
            events.append(Event("progress", _fields(look)))
            if look.stage == "train":
                found = {key: getattr(look, key) for key in CURVES}
                points = [Point(key, look.step, float(value)) for key, value in found.items() if value is not None]
        return Batch(events, points, files, look, rss_bytes, checkpoint)


def _fields(look: Look) -> dict[str, Any]:
    done = fraction_of(look.stage, look.step, look.steps)
    return {"fraction": done} | {name: value for name, value in vars(look).items() if value is not None}
