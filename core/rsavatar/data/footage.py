"""Sharp multi-view sequences, wherever they come from: what the rolling-shutter builder and the converter read.

Our own minimal folder, which every source can be converted to:

footage.json                 cameras by name {K, R, T in METRES, D}, train, test; optional pixel_centre (0), licence
images/<camera>/<n>.png      or .jpg; the numbers of all cameras are the same, without gaps
masks/<camera>/<n>.png       0 where the person is not
fits.npz                     one row a frame: poses [F, 72], Rh [F, 3], Th [F, 3] and shapes [10] in EasyMocap's
                             convention, or body_pose [F, 69], global_orient, transl and shapes with a ``pelvis`` [3] in
                             smplx's; ``frames`` [F] where the rows are not the pictures in order
body.npz                     optional: the body model of the fits
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsavatar.data import easymocap
from rsavatar.data.annots import Calibration, numbers
from rsavatar.data.base import Array, BodyFit, Bytes
from rsavatar.data.images import Frame, Lens, fingerprint, locate, numbered, read_coverage, read_rgb, size_of
from rsavatar.errors import DataError, expected

DESCRIPTION = "footage.json"


@dataclass(frozen=True)
class Footage:
    """A sharp sequence: F frames of cameras that are known by name.

    ``index`` says where a camera stands in ``calibrations``, which is also its two-digit number in what is built.
    """

    name: str
    root: Path
    layout: str
    calibrations: tuple[Calibration, ...]  # as in the files: distorted, pixel centres as ``pixel_centre`` says
    index: Mapping[str, int]  # cameras with pictures
    pixel_centre: float
    frames: Mapping[str, tuple[Frame, ...]]  # by camera, F each
    first: int  # number of the first frame in the files' names
    fit: BodyFit  # F states
    train: tuple[str, ...]
    test: tuple[str, ...]
    excluded: tuple[str, ...]
    labelled: bool  # masks hold labels, not coverage
    body: Path | None
    other_files: tuple[Path, ...]  # calibration and fits
    licence: str = ""

    @property
    def length(self) -> int:
        """F."""
        return len(self.fit.poses)

    def size(self, camera: str) -> tuple[int, int]:
        """(height, width) of a camera's pictures."""
        return size_of(self.frames[camera][0].image)

    def lens(self, camera: str) -> Lens:
        """A camera's lens, as OpenCV takes it."""
        return self.calibrations[self.index[camera]].lens(self.pixel_centre)

    def fingerprint(self, cameras: Sequence[str]) -> str:
        """sha256 of all that the pictures of ``cameras``, the calibration and the fits hold."""
        pictures = [path for name in cameras for frame in self.frames[name] for path in (frame.image, frame.mask)]
        return fingerprint(self.root, [*self.other_files, *pictures])

    def read(self, camera: str, frame: int, undistorted: bool) -> Bytes:
        """Red, green, blue and coverage [H, W, 4] of one picture. Labels become 0 and 255.

        Raises:
            DataError: naming a file that cannot be decoded, or a mask of another size than its image.
        """
        place = self.frames[camera][frame]
        colours, coverage = read_rgb(place.image), read_coverage(place.mask)
        if colours.shape[:2] != coverage.shape:
            raise DataError(expected(f"size of {place.mask}", colours.shape[:2], coverage.shape))
        if self.labelled:
            coverage = np.where(coverage != 0, 255, 0).astype(np.uint8)
        if undistorted:
            lens = self.lens(camera)
            colours, coverage = lens.undistorted(colours), lens.undistorted(coverage)
            if self.labelled:
                coverage = np.where(coverage >= 128, 255, 0).astype(np.uint8)
        return np.dstack([colours, coverage])


def check_views(
    cameras: Mapping[str, int], train: Sequence[str], test: Sequence[str], root: Path
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """``train`` and ``test`` as tuples, every camera known to have pictures.

    Raises:
        DataError: if there is no training camera, one is in both, or one has no folder.
    """
    missing = [name for name in (*train, *test) if name not in cameras]
    if missing:
        raise DataError(expected(f"{root} cameras", f"folders of {', '.join(missing)}", f"only {', '.join(cameras)}"))
    both = sorted(set(train) & set(test))
    if not train or both:
        got = f"{both} in both" if both else "no camera"
        raise DataError(expected(f"{root} training cameras", "at least one, and none of them held out", got))
    return tuple(train), tuple(test)


def holds_labels(mask: Path) -> bool:
    """Whether a mask names parts or persons: coverage has values between nothing and 255, and 255 itself."""
    values = np.unique(read_coverage(mask))
    return len(values) <= 2 or int(values[-1]) != 255


def common_numbers(folders: Mapping[str, Path]) -> range:
    """The frame numbers that every camera has.

    Raises:
        DataError: naming the camera and the frame that is missing, or the gap.
    """
    seen = {name: numbered(folder) for name, folder in folders.items()}
    every = sorted(set().union(*seen.values()))
    if not every:
        raise DataError(expected(", ".join(map(str, folders.values())), "numbered pictures", "none"))
    for name, found in seen.items():
        lacking = [n for n in range(every[0], every[-1] + 1) if n not in found]
        if lacking:
            wanted = f"frames {every[0]} to {every[-1]} without gaps"
            raise DataError(expected(f"{folders[name]} (camera {name})", wanted, f"no frame {lacking[0]}"))
    return range(every[0], every[-1] + 1)


def read_own(root: Path) -> Footage:
    """Our minimal folder.

    Raises:
        DataError: naming the file, camera or frame that is missing or damaged, or the unit that is wrong.
    """
    held = _described(root / DESCRIPTION)
    table: Mapping[str, Any] = held["cameras"]
    calibrations = tuple(_calibration(root / DESCRIPTION, name, each) for name, each in table.items())
    index = {name: k for k, name in enumerate(table) if (root / "images" / name).is_dir()}
    train, test = check_views(index, _names(root, held, "train"), _names(root, held, "test"), root)
    listed = [*train, *test]
    span = common_numbers({name: root / "images" / name for name in listed})
    frames = {name: tuple(locate(root / "images" / name, root / "masks" / name, span)) for name in listed}
    return Footage(
        name=root.resolve().name,
        root=root,
        layout="footage",
        calibrations=calibrations,
        index={name: index[name] for name in listed},
        pixel_centre=_pixel_centre(root, held),
        frames=frames,
        first=span[0],
        fit=read_fits(root / "fits.npz", span),
        train=train,
        test=test,
        excluded=tuple(name for name in table if name not in listed),
        labelled=holds_labels(frames[train[0]][0].mask),
        body=root / "body.npz" if (root / "body.npz").is_file() else None,
        other_files=(root / DESCRIPTION, root / "fits.npz"),
        licence=str(held.get("licence", "")),
    )


def read_fits(path: Path, span: range) -> BodyFit:
    """The fits of the frames ``span`` of ``fits.npz``; smplx's convention is told by its names.

    Raises:
        DataError: if the file is missing or damaged, a name, a shape or a frame is.
    """
    try:
        with np.load(path, allow_pickle=False) as held:
            values = {name: np.asarray(held[name], np.float64) for name in held.files}
    except FileNotFoundError:
        raise DataError(expected(str(path), "a file", "nothing there")) from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(expected(str(path), "a .npz file of numbers", error)) from error
    rows = values.pop("frames", np.arange(span.start, span.stop)).astype(int).tolist()
    lacking = [number for number in span if number not in rows]
    if lacking:
        raise DataError(expected(str(path), f"fits of frames {span.start} to {span.stop - 1}", f"none of {lacking[0]}"))
    fit = _parse_fits(path, values, len(rows))
    chosen = [rows.index(number) for number in span]
    return BodyFit(fit.poses[chosen], fit.Rh[chosen], fit.Th[chosen], fit.shapes)


def _parse_fits(path: Path, values: Mapping[str, Array], count: int) -> BodyFit:
    smplx = "global_orient" in values
    names = ("body_pose", "global_orient", "transl", "pelvis") if smplx else ("poses", "Rh", "Th")
    missing = [name for name in (*names, "shapes") if name not in values]
    if missing:
        raise DataError(expected(str(path), f"{', '.join(names)} and shapes", f"no {', '.join(missing)}"))
    shapes = numbers(f"{path} shapes", values["shapes"], (10,))
    if smplx:
        parts = {name: _rows(path, name, values[name], count, size) for name, size in
                 (("global_orient", 3), ("body_pose", 69), ("transl", 3))}  # fmt: skip
        pelvis = numbers(f"{path} pelvis", values["pelvis"], (3,))
        return easymocap.from_smplx(easymocap.SmplxFit(**parts, shapes=shapes), pelvis)
    size = 69 if values["poses"].size == 69 * count else 72
    poses = _rows(path, "poses", values["poses"], count, size)
    poses = np.concatenate([np.zeros((count, 72 - size)), poses], 1)
    if np.abs(poses[:, :3]).max(initial=0) > 1e-6:
        raise DataError(expected(f"{path} poses[:, :3]", "zeros (the root's rotation is Rh)", "a rotation"))
    Rh, Th = (_rows(path, name, values[name], count, 3) for name in ("Rh", "Th"))
    return BodyFit(poses, Rh, Th, shapes)


def _rows(path: Path, name: str, value: Array, count: int, size: int) -> Array:
    return numbers(f"{path} {name}", value, (count, size))


def _described(path: Path) -> dict[str, Any]:
    try:
        held: Any = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(expected(str(path), "a file", "nothing there")) from None
    except (OSError, ValueError) as error:
        raise DataError(expected(str(path), "a JSON file", error)) from error
    if not isinstance(held, dict) or not isinstance(held.get("cameras"), dict) or not held["cameras"]:
        got = sorted(held) if isinstance(held, dict) else type(held).__name__
        raise DataError(expected(f"{path} cameras", "an object with K, R, T by camera", got))
    return held


def _calibration(path: Path, name: str, values: Any) -> Calibration:
    if not isinstance(values, dict) or not {"K", "R", "T"} <= values.keys():
        raise DataError(expected(f"{path} camera {name}", "K, R, T in metres, optional D", values))
    translation = numbers(f"{path} {name} T", values["T"], (3,))
    if np.linalg.norm(translation) > 100:
        raise DataError(expected(f"{path} {name} T", "METRES, within 100 m", f"{np.linalg.norm(translation):.4g}"))
    return Calibration(
        matrix=numbers(f"{path} {name} K", values["K"], (3, 3)),
        rotation=numbers(f"{path} {name} R", values["R"], (3, 3)),
        translation=translation,
        distortion=numbers(f"{path} {name} D", values.get("D", [0.0] * 5), (5,)),
    )


def _names(root: Path, held: Mapping[str, Any], key: str) -> list[str]:
    names = held.get(key, [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise DataError(expected(f"{root / DESCRIPTION} {key}", "a list of cameras' names", names))
    return names


def _pixel_centre(root: Path, held: Mapping[str, Any]) -> float:
    centre = held.get("pixel_centre", 0.0)
    if centre not in (0, 0.5):
        raise DataError(expected(f"{root / DESCRIPTION} pixel_centre", "0 or 0.5", centre))
    return float(centre)
