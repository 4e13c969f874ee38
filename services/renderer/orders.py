"""What the API may ask to be drawn, and the answers: pictures and files as bytes with their media type.

An order is JSON: ``verb`` and its arguments. ``source`` says which finished job (spec, checkpoint, subject_dir).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rsavatar.errors import RsAvatarError, SpecError, expected
from rsavatar.spec import JobSpec

KEPT = 6  # avatars held open; the one that was not looked at for longest goes first
MIMES = {
    "png": "image/png",
    "webp": "image/webp",
    "svg": "image/svg+xml",
    "pdf": "application/pdf",
    "mp4": "video/mp4",
    "webm": "video/webm",
    "gif": "image/gif",
}
OTHER = "application/octet-stream"


class Desk:
    """Takes orders one at a time. What is heavy is imported by the first order that needs it."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._open: OrderedDict[tuple[str, int], Any] = OrderedDict()

    def answer(self, order: Mapping[str, Any]) -> tuple[str, bytes]:
        """Media type and bytes.

        Raises:
            RsAvatarError: if the order asks for what there is not, or the job cannot be opened.
        """
        verbs = {
            "view": self._view,
            "scene": self._scene,
            "ply": self._ply,
            "turntable": self._turntable,
            "figure": self._figure,
        }
        verb = str(order.get("verb"))
        if verb not in verbs:
            raise SpecError(expected("verb", f"one of {', '.join(verbs)}", repr(verb)))
        return verbs[verb](order)

    def _view(self, order: Mapping[str, Any]) -> tuple[str, bytes]:
        from rsavatar.export.views import View, encode, render_view

        pixels = render_view(self.replay(order["source"]), View(**order["view"]))
        return MIMES[order["format"]], encode(pixels, order["format"])

    def _scene(self, order: Mapping[str, Any]) -> tuple[str, bytes]:
        from rsavatar.export.scene import write_scene

        return OTHER, write_scene(self.replay(order["source"]))

    def _ply(self, order: Mapping[str, Any]) -> tuple[str, bytes]:
        from rsavatar.export.ply import canonical_cloud, posed_cloud, write_ply

        replay = self.replay(order["source"])
        return OTHER, write_ply(
            canonical_cloud(replay) if order["time"] is None else posed_cloud(replay, order["time"])
        )

    def _turntable(self, order: Mapping[str, Any]) -> tuple[str, bytes]:
        from rsavatar.export.turntable import Turntable, write_turntable
        from rsavatar.export.views import View

        turntable = Turntable(View(**order["view"]), order["pictures"], order["moving"])
        return MIMES[order["format"]], write_turntable(self.replay(order["source"]), turntable, order["format"])

    def _figure(self, order: Mapping[str, Any]) -> tuple[str, bytes]:
        from rsavatar.report.figures_draw import draw
        from rsavatar.report.runs import Figure

        figure = Figure.from_json(order["figure"])
        pictures = self._pictures(order) if figure.pictures else {}
        return MIMES[order["format"]], draw(figure, order["format"], pictures)

    def _pictures(self, order: Mapping[str, Any]) -> Mapping[str, Any]:
        from rsavatar.export.strip import draw_pictures

        replays: dict[str, Any] = {}
        for job, source in order["sources"].items():
            replays[job] = self.replay(source, next(reversed(replays.values()), None))
        return draw_pictures(replays, order["figure"]["pictures"])

    def replay(self, source: Mapping[str, Any], known: Any = None) -> Any:
        """The job's avatar, opened once; ``known`` may lend what they share."""
        from rsavatar.export.replay import Source, open_replay, prepare

        path = Path(source["checkpoint"])
        try:
            key = (str(path), path.stat().st_mtime_ns)
        except OSError as error:
            raise RsAvatarError(expected("checkpoint", "a file", error)) from None
        if key not in self._open:
            prepare(self._threads)
            folder = Path(source["subject_dir"]) if source["subject_dir"] else None
            self._open[key] = open_replay(Source(JobSpec.model_validate(source["spec"]), path, folder), known)
            while len(self._open) > KEPT:
                self._open.popitem(last=False)
        self._open.move_to_end(key)
        return self._open[key]
