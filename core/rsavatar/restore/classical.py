"""The corrector without weights: dense flow to both neighbours, scaled by the rows' times, warped to the middle row.

A pixel of row v was exposed ``late = gamma (v / H - 1/2)`` frame periods after the middle row, and is found again in a
neighbour at another row's instant. Its way to the middle row's instant is read off the straight line through two of
these places, or off the parabola through all three. The ways are thrown to where they lead (nearer and surer ones over
others), holes between them are filled, and the picture is fetched along them once.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from rsavatar.restore.base import AbstractCorrector, Bytes, Picture, Shot, on_black
from rsavatar.restore.flow import dense_flow
from rsavatar.restore.warp import softmax_splat

Field = npt.NDArray[np.float32]
FORMAT = 1  # raise it when the result changes: it is part of the identity
FLOOR = 1e-6


@dataclass(frozen=True)
class Settings:
    """Tuned on studio seeds, nowhere else."""

    tolerance: float = 0.6  # part of a flow's length by which flow and flow back may disagree
    slack: float = 2.5  # pixels by which they may disagree at any length
    parabola: float = 0.5  # weight of the parabola against the two lines, where both neighbours are trusted
    smooth: float = 1.0  # pixels, of the filling
    priority: float = 0.5  # nats a pixel of motion: what moved far lies in front
    detail: int = 512  # rows that a small picture is enlarged to before its flow is sought, at most twice
    margin: int = 24  # pixels around the person


@dataclass(frozen=True, eq=False)
class _Step:
    """Where the pixels went in a neighbour."""

    flow: Field  # [h, w, 2] pixels
    trust: Field  # [h, w] in [0, 1]
    apart: Field  # [h, w] frame periods from a pixel's instant to that of where it is found


class FlowCorrector(AbstractCorrector):
    """No weights, always there; a frame at the end of its sequence uses its one neighbour."""

    def __init__(self, settings: Settings | None = None) -> None:
        self._settings = settings or Settings()

    @property
    def identity(self) -> str:
        """Algorithm, and settings that are not the usual ones."""
        usual = asdict(Settings())
        words = [f", {name} {value:g}" for name, value in asdict(self._settings).items() if value != usual[name]]
        return f"dense flow (DIS) without weights, version {FORMAT}{''.join(words)}"

    def restore(self, shot: Shot) -> Picture:
        """See the contract."""
        rgb, coverage = shot.frame
        box = self._box(shot)
        if box is None or shot.gamma == 0:
            return shot.frame
        rows = len(coverage)
        late = _field(shot.gamma * (np.arange(rows)[box[0], None] / rows - 0.5))
        seen = (coverage[box] > 0).astype(np.float32)
        steps = []
        for neighbour, sign in ((shot.before, -1.0), (shot.after, 1.0)):
            if neighbour is not None:
                flow, trust = self._flow(rgb[box], neighbour[0][box])
                steps.append(_Step(flow, trust * seen, _field(sign + shot.gamma * flow[..., 1] / rows)))
        way, trust = ways(steps, -late, self._settings.parabola)
        moved = self._moved(filled(way, trust, self._settings.smooth), trust, rgb[box], coverage[box])
        whole = np.zeros_like(rgb), np.zeros_like(coverage)
        whole[0][box], whole[1][box] = moved
        return on_black(*whole)

    def _box(self, shot: Shot) -> tuple[slice, slice] | None:
        """Rows and columns around the person in all pictures; None where nobody is."""
        pictures = [picture for picture in (shot.before, shot.frame, shot.after) if picture is not None]
        seen = np.any([coverage != 0 for _, coverage in pictures], axis=0)
        if not shot.frame[1].any():
            return None
        spans = []
        for axis in (1, 0):
            inside = np.flatnonzero(seen.any(axis))
            low, size = int(inside[0]) - self._settings.margin, seen.shape[1 - axis]
            spans.append(slice(max(low, 0), min(int(inside[-1]) + 1 + self._settings.margin, size)))
        return spans[0], spans[1]

    def _flow(self, here: Bytes, there: Bytes) -> tuple[Field, Field]:
        """Flow [h, w, 2] and how far it can be trusted [h, w]: whether the flow back leads home."""
        height, width = here.shape[:2]
        zoom = min(max(self._settings.detail / height, 1.0), 2.0)
        size = (max(round(width * zoom), 12), max(round(height * zoom), 12))
        a, b = (np.asarray(cv2.resize(x, size, interpolation=cv2.INTER_CUBIC), np.uint8) for x in (here, there))
        forth, back = dense_flow(a, b), dense_flow(b, a)
        lost = np.linalg.norm(forth + _fetched(back, forth), axis=-1)
        allowed = self._settings.slack * zoom + self._settings.tolerance * np.linalg.norm(forth, axis=-1)
        trust = np.exp(-np.square(lost / allowed)).astype(np.float32)
        shrunk = [_field(cv2.resize(x, (width, height), interpolation=cv2.INTER_AREA)) for x in (forth, trust)]
        return _field(shrunk[0] * np.array([width / size[0], height / size[1]])), shrunk[1]

    def _moved(self, way: Field, trust: Field, rgb: Bytes, coverage: Bytes) -> Picture:
        """The picture at the ends of its ways."""
        seen = (coverage > 127).astype(np.float32)
        importance = self._settings.priority * np.linalg.norm(way, axis=-1) + np.log(seen * (trust + 0.02) + FLOOR)
        thrown, shares = softmax_splat(_tensor(way, seen), _tensor(way), _tensor(importance))
        arrived = thrown[0].permute(1, 2, 0).numpy()
        present = np.minimum(shares[0, 0].numpy(), 1) * (arrived[..., 2] > 0.5)
        source = -filled(arrived[..., :2], present, 0.0)
        colours = np.asarray(_fetched(rgb, source, cv2.INTER_CUBIC, cv2.BORDER_CONSTANT), np.uint8)
        return colours, np.asarray(_fetched(coverage, source, border=cv2.BORDER_CONSTANT), np.uint8)


def ways(steps: list[_Step], wanted: Field, parabola: float) -> tuple[Field, Field]:
    """Ways [h, w, 2] from each pixel's instant to ``wanted`` [h, 1] frame periods later, and their trust [h, w].

    A line through a pixel and where it is in a neighbour, or the parabola through both neighbours, weighted by trust.
    """
    lines = [step.flow * (wanted / step.apart)[..., None] for step in steps]
    if len(steps) == 1:
        return lines[0], steps[0].trust
    (a, b), both = steps, steps[0].trust * steps[1].trust
    gap = a.apart - b.apart  # about -2
    bent = a.flow * (wanted * (wanted - b.apart) / (a.apart * gap))[..., None]
    bent = bent - b.flow * (wanted * (wanted - a.apart) / (b.apart * gap))[..., None]
    straight = both * (1 - parabola) / 2
    weights = (both * parabola, a.trust * (1 - b.trust) + straight, b.trust * (1 - a.trust) + straight)
    total = weights[0] + weights[1] + weights[2]
    mixed = sum(w[..., None] * way for w, way in zip(weights, (bent, *lines), strict=True))
    return _field(mixed / np.maximum(total, FLOOR)[..., None]), _field(total)


def filled(field: Field, weight: Field, smooth: float) -> Field:
    """A field [h, w, C] of known ``weight`` [h, w] in [0, 1], continued where it is 0: a pyramid of weighted means."""
    values, known = (field * weight[..., None]).astype(np.float32), weight.astype(np.float32)
    if smooth > 0:
        values, known = (cv2.GaussianBlur(x, (0, 0), smooth) for x in (values, known))
    pyramid = [(values, known)]
    while min(pyramid[-1][1].shape) > 2:
        pyramid.append((cv2.pyrDown(pyramid[-1][0]), cv2.pyrDown(pyramid[-1][1])))
    out = pyramid[-1][0] / (pyramid[-1][1][..., None] + FLOOR)
    for values, known in reversed(pyramid[:-1]):
        coarse = cv2.pyrUp(out, dstsize=known.shape[::-1])
        here = np.clip(4 * known, 0, 1)[..., None]
        out = here * values / (known[..., None] + FLOOR) + (1 - here) * coarse
    return np.asarray(out, np.float32)


def _fetched(
    image: npt.NDArray[Any], flow: Field, how: int = cv2.INTER_LINEAR, border: int = cv2.BORDER_REPLICATE
) -> npt.NDArray[Any]:
    y, x = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
    return np.asarray(cv2.remap(image, x + flow[..., 0], y + flow[..., 1], how, borderMode=border))


def _field(values: Any) -> Field:
    return np.asarray(values, np.float32)


def _tensor(*fields: Field) -> Tensor:
    """Fields [h, w] or [h, w, C] as [1, channels, h, w]."""
    stacked = np.dstack(fields).astype(np.float32)
    return torch.from_numpy(stacked).permute(2, 0, 1)[None].contiguous()
