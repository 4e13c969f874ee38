"""Footage out of the layouts of others: ZJU-MoCap (refined and original) and EasyMocap's output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rsavatar.data import easymocap, zju
from rsavatar.data.annots import fit_folder, read_calibrations, read_fits
from rsavatar.data.footage import DESCRIPTION, Footage, check_views, common_numbers, holds_labels, read_own
from rsavatar.data.images import locate
from rsavatar.data.rolling import find_body_file, name_of
from rsavatar.errors import DataError, expected

REST = "rest"  # for held-out cameras: all that are neither trained on nor excluded
_ZJU_LICENCE = (
    "The layout is ZJU-MoCap's. Its pictures are for research only, under a signed agreement, and neither they nor "
    "what is made from them may be passed on."
)
_MASKS = ("mask", "masks", "mask-schp", "mask_cihp")
_FITS = ("smpl", "output-smpl-3d/smpl", "output/smpl", "output/smpl3d")


def open_footage(root: Path, views: str = "") -> Footage:
    """The sequence in ``root``, whatever its layout.

    Args:
        root: our minimal folder, ZJU-MoCap's (refined or original), or EasyMocap's output.
        views: "TRAIN:TEST", names of cameras by comma, TEST may be "rest"; "" takes what the source says: for
            ZJU-MoCap the paper's cameras, for our folder those it names. Without ":TEST" none is held out.

    Raises:
        DataError: naming the file, camera or frame that is missing or damaged; for EasyMocap, if no views are given.
    """
    if not root.is_dir():
        raise DataError(expected(str(root), "a folder with a sequence", "nothing there"))
    if (root / DESCRIPTION).is_file():
        return _with_views(read_own(root), views)
    if (root / "intri.yml").is_file():
        return read_easymocap(root, views)
    if (root / "annots.npy").is_file():
        return read_zju(root, views)
    there = ", ".join(sorted(path.name for path in root.iterdir())[:12]) or "an empty folder"
    wanted = f"{DESCRIPTION}, or intri.yml with extri.yml (EasyMocap), or annots.npy (ZJU-MoCap)"
    raise DataError(expected(str(root), wanted, there))


def read_zju(root: Path, views: str) -> Footage:
    """ZJU-MoCap's layouts; cameras are called by two digits, from 00. Camera 03 is excluded, as in the paper."""
    calibrations = read_calibrations(root / "annots.npy")
    folders = zju.camera_folders(root)
    on_disk = {name: int(name) for name in folders}
    paper = list(zju.TRAINING), [name for name in on_disk if name not in zju.TRAINING]
    train, test = check_views(on_disk, *(parse_views(views, list(on_disk)) if views else paper), root)
    beyond = [name for name in (*train, *test) if int(name) >= len(calibrations)]
    if beyond:
        got = f"{len(calibrations)} cameras, none for {', '.join(beyond)}"
        raise DataError(expected(str(root / "annots.npy"), "calibrations of all cameras", got))
    listed = [*train, *test]
    span = common_numbers({name: folders[name].images for name in listed})
    frames = {name: tuple(locate(folders[name].images, folders[name].masks, span)) for name in listed}
    fits = fit_folder(root)
    return Footage(
        name=root.resolve().name,
        root=root,
        layout="zju",
        calibrations=tuple(calibrations),
        index={name: int(name) for name in listed},
        pixel_centre=zju.pixel_centre_of(root),
        frames=frames,
        first=span[0],
        fit=read_fits(fits, span),
        train=train,
        test=test,
        excluded=tuple(name_of(c) for c in range(len(calibrations)) if name_of(c) not in listed),
        labelled=holds_labels(frames[train[0]][0].mask),
        body=find_body_file(root),
        other_files=(root / "annots.npy", *sorted(fits.glob("*.npy"))),
        licence=_ZJU_LICENCE,
    )


def read_easymocap(root: Path, views: str) -> Footage:
    """EasyMocap's folder: intri.yml, extri.yml, images/<camera>/, mask/<camera>/, fits as JSON in smpl/ or output*."""
    calibrations = easymocap.read_calibrations(root / "intri.yml", root / "extri.yml")
    on_disk = {name: k for k, name in enumerate(calibrations) if (root / "images" / name).is_dir()}
    if not views:
        wanted = "--views TRAIN:TEST, names of cameras by comma"
        raise DataError(expected(f"{root} views", wanted, f"nothing; there are {', '.join(on_disk) or 'no cameras'}"))
    train, test = check_views(on_disk, *parse_views(views, list(on_disk)), root)
    listed = [*train, *test]
    masks, fits = _first_of(root, _MASKS, "masks"), _first_of(root, _FITS, "fits as JSON")
    span = common_numbers({name: root / "images" / name for name in listed})
    frames = {name: tuple(locate(root / "images" / name, masks / name, span)) for name in listed}
    files = [fits / f"{number:06d}.json" for number in span]
    return Footage(
        name=root.resolve().name,
        root=root,
        layout="easymocap",
        calibrations=tuple(calibrations.values()),
        index={name: on_disk[name] for name in listed},
        pixel_centre=0.0,
        frames=frames,
        first=span[0],
        fit=easymocap.read_frames(files),
        train=train,
        test=test,
        excluded=tuple(name for name in calibrations if name not in listed),
        labelled=holds_labels(frames[train[0]][0].mask),
        body=find_body_file(root),
        other_files=(root / "intri.yml", root / "extri.yml", *files),
    )


def parse_views(views: str, known: Sequence[str]) -> tuple[list[str], list[str]]:
    """``"a,b:c,d"`` as (["a", "b"], ["c", "d"]); "rest" means all others of ``known``.

    Raises:
        DataError: if no training camera is named, or an item is empty.
    """
    first, _, second = views.partition(":")
    train = [name.strip() for name in first.split(",")]
    test = [name.strip() for name in second.split(",")] if second else []
    if test == [REST]:
        test = [name for name in known if name not in train]
    if not all(train) or not all(test):
        raise DataError(expected("views", "TRAIN:TEST, names of cameras by comma", repr(views)))
    return train, test


def _with_views(footage: Footage, views: str) -> Footage:
    if not views:
        return footage
    train, test = check_views(footage.index, *parse_views(views, list(footage.index)), footage.root)
    listed: Mapping[str, int] = {name: footage.index[name] for name in (*train, *test)}
    left = tuple(name for name in footage.index if name not in listed)
    return replace(footage, train=train, test=test, index=listed, excluded=footage.excluded + left)


def _first_of(root: Path, names: Sequence[str], what: str) -> Path:
    for name in names:
        if (root / name).is_dir():
            return root / name
    raise DataError(expected(f"{root} {what}", f"a folder {' or '.join(names)}", "none"))
