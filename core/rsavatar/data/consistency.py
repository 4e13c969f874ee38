"""Checks that need no body: files, cameras, timing, masks, jumps of the fit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rsavatar.data.base import Array, BodyFit, Subject, Timing
from rsavatar.data.findings import Finding
from rsavatar.data.images import SUFFIXES, size_of
from rsavatar.errors import DataError
from rsavatar.geometry.cameras import Camera

Pair = tuple[str, int]  # (camera name, frame index)
_ENDINGS = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}
_SHOWN = 3


def check_pictures(root: Path, folders: Iterable[Path]) -> list[Finding]:
    """Every picture under ``folders`` ends where its format ends, and those of one folder have one size."""
    damaged: list[str] = []
    sizes: dict[Path, set[tuple[int, int]]] = {}
    count = 0
    for path in (path for folder in folders for path in sorted(folder.rglob("*")) if path.suffix.lower() in SUFFIXES):
        count += 1
        try:
            sizes.setdefault(path.parent, set()).add(size_of(path))
            whole = _is_whole(path)
        except (DataError, OSError):
            whole = False
        if not whole:
            damaged.append(str(path.relative_to(root)))
    mixed = [f"{folder.relative_to(root)} {sorted(found)}" for folder, found in sizes.items() if len(found) > 1]
    wanted = "complete PNG and JPEG files"
    hint = "copy these files again"
    return [
        Finding("error", "pictures", wanted, _some(damaged, "truncated or damaged"), hint)
        if damaged
        else Finding("ok", "pictures", wanted, f"{count} files complete"),
        *(Finding("error", "picture sizes", "one size per folder", each) for each in mixed[:_SHOWN]),
    ]


def check_cameras(subject: Subject) -> list[Finding]:
    """Cameras stand apart from each other, not absurdly far, and K suits the images."""
    centres = np.array([camera.centre for camera in subject.cameras.values()])
    spread = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
    wanted = "cameras more than 10 mm and less than 100 m apart"
    findings = [Finding("ok", "camera positions", wanted, f"within {spread:.2f} m of their middle")]
    if len(centres) > 1 and spread < 0.01:
        hint = "annots.npy holds T in metres where millimetres belong: multiply T by 1000"
        findings = [Finding("error", "camera positions", wanted, f"within {spread * 1000:.3g} mm", hint)]
    elif spread > 100:
        hint = "annots.npy holds T in a unit smaller than the millimetre: divide T by 1000"
        findings = [Finding("error", "camera positions", wanted, f"within {spread:.4g} m", hint)]
    return findings + [finding for name, camera in subject.cameras.items() for finding in _check_matrix(name, camera)]


def check_timing(timing: Timing) -> list[Finding]:
    """Mid-row times increase by the period, the readout and the triggers stay within it."""
    steps = np.diff(timing.mid_frames)
    readout, period = timing.readout_frames, timing.period_frames
    kind = "global shutter" if readout == 0 else f"readout {readout:g} of a period of {period:g} source frames"
    findings = [Finding("ok", "timing", "mid increasing by the period, readout within it", kind)]
    if readout > period:
        hint = "gamma is the readout as a fraction of the period: at most 1"
        findings.append(Finding("error", "readout", f"at most the period, {period:g}", f"{readout:g}", hint))
    if np.any(steps <= 0):
        where = int(np.argmax(steps <= 0))
        got = f"mid[{where}] = {timing.mid_frames[where]:g}, mid[{where + 1}] = {timing.mid_frames[where + 1]:g}"
        findings.append(Finding("error", "mid", "times that increase", got, "sort the frames by time"))
    elif len(steps) and not np.allclose(steps, period):
        got = f"steps {steps.min():g} to {steps.max():g}"
        findings.append(
            Finding("warning", "mid", f"steps of the period, {period:g}", got, "frames are missing, or K is")
        )
    late = {name: value for name, value in timing.trigger_frames.items() if abs(value) > period}
    if late:
        hint = "delta is in source frames: seconds times the source rate"
        findings.append(Finding("warning", "triggers", f"within one period, {period:g}", f"{late}", hint))
    return findings


def check_masks(subject: Subject, pairs: Iterable[Pair]) -> list[Finding]:
    """Masks of the sampled frames are neither empty nor full, and images decode at the camera's size."""
    shares: dict[Pair, float] = {}
    for name, index in pairs:
        colours, coverage = subject.observe(name, index)
        camera = subject.cameras[name]
        if colours.shape != (camera.height, camera.width, 3):
            got = f"{colours.shape[1]} x {colours.shape[0]} in camera {name}, frame {index}"
            return [Finding("error", "image size", f"{camera.width} x {camera.height}", got)]
        shares[name, index] = float(np.mean(coverage != 0))
    empty = [_label(pair) for pair, share in shares.items() if share == 0]
    full = [_label(pair) for pair, share in shares.items() if share > 0.9]
    wanted = "a person on part of the image"
    if full:
        hint = "masks must be 0 outside the person; invert them if they are the other way round"
        return [Finding("error", "masks", wanted, _some(full, "more than 90 % covered"), hint)]
    if empty:
        hint = "nobody was segmented there: leave these cameras or frames out"
        severe = len(empty) * 2 > len(shares)
        return [Finding("error" if severe else "warning", "masks", wanted, _some(empty, "empty"), hint)]
    got = f"{100 * min(shares.values()):.1f} to {100 * max(shares.values()):.1f} % covered"
    return [Finding("ok", "masks", wanted, got)]


def check_jumps(fit: BodyFit) -> list[Finding]:
    """The fit does not leap to and fro: a frame far from both its neighbours, which are close to each other."""
    wanted = "no frame further than 0.2 m or 60 degrees from the middle of its neighbours"
    if len(fit.poses) < 3:
        return [Finding("ok", "fit jumps", wanted, "too few frames to tell")]
    leaps = np.linalg.norm(fit.Th[1:-1] - (fit.Th[:-2] + fit.Th[2:]) / 2, axis=-1)
    turns = np.degrees(_turn_from_neighbours(np.concatenate([fit.Rh[:, None], fit.poses[:, 3:].reshape(-1, 23, 3)], 1)))
    bad = np.flatnonzero((leaps > 0.2) | (turns > 60)) + 1
    got = f"at most {leaps.max():.3f} m and {turns.max():.0f} degrees"
    if not len(bad):
        return [Finding("ok", "fit jumps", wanted, got)]
    hint = "the fit flips or jitters there: fit these frames again with temporal smoothing"
    return [Finding("warning", "fit jumps", wanted, f"{got}; {_some([f'frame {i}' for i in bad], 'of them')}", hint)]


def _turn_from_neighbours(vectors: Array) -> Array:
    """Largest angle [N-2] over joints between a rotation and the half-way rotation of its neighbours."""
    n, joints = vectors.shape[:2]
    before, here, after = (Rotation.from_rotvec(vectors[i : n - 2 + i].reshape(-1, 3)) for i in range(3))
    middle = before * Rotation.from_rotvec((before.inv() * after).as_rotvec() / 2)
    angles = np.asarray((middle.inv() * here).magnitude(), np.float64)
    return np.asarray(angles.reshape(n - 2, joints).max(1))


def _check_matrix(name: str, camera: Camera) -> list[Finding]:
    wanted = f"a principal point near the middle of {camera.width} x {camera.height} and a field of view of 5 to 150"
    across, down = camera.cx / camera.width, camera.cy / camera.height
    view = float(np.degrees(2 * np.arctan(camera.width / (2 * camera.fx))))
    got = f"({camera.cx:.1f}, {camera.cy:.1f}), {view:.0f} degrees"
    if not (0.25 < across < 0.75 and 0.25 < down < 0.75):
        scale = 0.5 / max(across, 1e-6)
        hint = f"K may belong to images of another size: its first two rows times {scale:.3g} would be centred"
        return [Finding("warning", f"K of camera {name}", wanted, got, hint)]
    if not 5 < view < 150 or not 0.8 < camera.fx / camera.fy < 1.25:
        return [Finding("error", f"K of camera {name}", wanted, f"{got}, fx/fy {camera.fx / camera.fy:.2f}")]
    return []


def _is_whole(path: Path) -> bool:
    ending = _ENDINGS[path.suffix.lower()]
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - 32))
        return ending in file.read()


def _label(pair: Pair) -> str:
    return f"{pair[0]}/{pair[1]:06d}"


def _some(names: Sequence[str], what: str) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return f"{len(names)} {what}: {', '.join(names[:_SHOWN])}{more}"
