"""Tiny footage whose pictures are known in closed form, in the layouts that the builder reads."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from rsavatar.data.base import Array, Bytes
from tests.core.subject_files import matrix, ring, save, save_object

Paint = Callable[[int, int], Bytes]  # (camera, frame) -> [H, W, 4]


def clock_picture(size: int = 32, step: int = 4) -> Paint:
    """A picture whose grey is ``step`` times its frame number, with the person everywhere."""

    def paint(camera: int, frame: int) -> Bytes:
        picture = np.full((size, size, 4), step * frame, np.uint8)
        picture[..., 3] = 255
        return picture

    return paint


def ball_picture(size: int, speed: float, radius: float = 7.0) -> Paint:
    """A painted ball that rolls to the right by ``speed`` pixels a frame, in every camera."""

    def paint(camera: int, frame: int) -> Bytes:
        x, y = 12 + speed * frame, size / 2
        v, u = np.mgrid[: 3 * size, : 3 * size] / 3 + 1 / 6
        inside = ((u - x) ** 2 + (v - y) ** 2 < radius**2).astype(float)[..., None]
        shade = 0.5 + 0.4 * np.stack([np.sin(u - x), np.cos(v - y), np.sin(0.7 * (u - x + v - y))], -1)
        painted = np.concatenate([shade * inside, inside], -1).reshape(size, 3, size, 3, 4).mean((1, 3))
        return np.floor(255 * painted + 0.5).astype(np.uint8)

    return paint


def fit_of(frame: int) -> dict[str, Array]:
    """A person that walks 0.01 m a frame while every joint turns steadily."""
    turns = np.zeros((1, 72))
    turns[0, 3:] = 0.01 * frame * np.linspace(-1, 1, 69)
    place = np.array([[0.01 * frame, 0, 1.2]])
    return {"poses": turns, "Rh": np.array([[np.pi / 2, 0, 0]]), "Th": place, "shapes": np.zeros((1, 10))}


def write_zju_footage(
    root: Path, frames: int, paint: Paint, cameras: Sequence[int], *, original: bool = False, D: Array | None = None
) -> Path:
    """ZJU-MoCap's layout with 23 calibrated cameras, of which ``cameras`` are on disk; masks hold 0 and 1."""
    size = paint(0, 0).shape[0]
    distortion = np.zeros((5, 1)) if D is None else D.reshape(5, 1)
    poses = [ring(c) for c in range(23)]
    cams = {
        "K": [matrix(size)] * 23,
        "R": [R for R, _ in poses],
        "T": [1000 * T[:, None] for _, T in poses],
        "D": [distortion] * 23,
    }
    names = [f"Camera_B{c + 1}" if original else f"images/{c:02d}" for c in range(23)]
    ims = [{"ims": [f"{name}/{n:06d}.jpg" for name in names]} for n in range(frames)]
    save_object(root / "annots.npy", {"cams": cams, "ims": ims})
    fits = root / ("new_params" if original else "smpl_params")
    for n in range(frames):
        save_object(fits / f"{n}.npy", fit_of(n))
        for c in cameras:
            picture = paint(c, n)
            folder = Path(names[c])
            _save_exact(root / folder / f"{n:06d}.jpg", picture[..., :3])
            mask = root / ("mask_cihp" if original else "mask") / folder.name
            save(mask / f"{n:06d}.png", (picture[..., 3] > 127).astype(np.uint8))
    return root


def write_own_footage(root: Path, frames: int, paint: Paint, train: Sequence[str], test: Sequence[str]) -> Path:
    """Our minimal folder; masks hold coverage."""
    size = paint(0, 0).shape[0]
    names = [*train, *test]
    cameras = {}
    for k, name in enumerate(names):
        R, T = ring(5 * k)
        cameras[name] = {"K": matrix(size).tolist(), "R": R.tolist(), "T": T.tolist()}
        for n in range(frames):
            picture = paint(k, n)
            save(root / "images" / name / f"{n:06d}.png", picture[..., :3])
            save(root / "masks" / name / f"{n:06d}.png", picture[..., 3])
    description = {"cameras": cameras, "train": list(train), "test": list(test), "licence": "CC0"}
    (root / "footage.json").write_text(json.dumps(description))
    fits = [fit_of(n) for n in range(frames)]
    stacked = {key: np.concatenate([fit[key] for fit in fits]) for key in ("poses", "Rh", "Th")}
    np.savez(root / "fits.npz", **stacked, shapes=np.zeros(10))
    return root


def write_easymocap_footage(root: Path, frames: int, paint: Paint, cameras: Sequence[str]) -> Path:
    """EasyMocap's folder: YAML cameras, JSON fits with three decimals."""
    size = paint(0, 0).shape[0]
    storages = [
        cv2.FileStorage(str(_made(root) / f"{kind}.yml"), cv2.FILE_STORAGE_WRITE) for kind in ("intri", "extri")
    ]
    for storage in storages:
        storage.startWriteStruct("names", cv2.FILE_NODE_SEQ)
        for name in cameras:
            storage.write("", name)
        storage.endWriteStruct()
    for k, name in enumerate(cameras):
        R, T = ring(5 * k)
        storages[0].write(f"K_{name}", matrix(size))
        storages[0].write(f"dist_{name}", np.zeros((1, 5)))
        storages[1].write(f"R_{name}", cv2.Rodrigues(R)[0])
        storages[1].write(f"Rot_{name}", R)
        storages[1].write(f"T_{name}", T.reshape(3, 1))
    for storage in storages:
        storage.release()
    for n in range(frames):
        person = {"id": 0} | {key: np.round(value, 3).tolist() for key, value in fit_of(n).items()}
        path = _made(root / "smpl") / f"{n:06d}.json"
        path.write_text(json.dumps([person]))
        for k, name in enumerate(cameras):
            picture = paint(k, n)
            save(root / "images" / name / f"{n:06d}.png", picture[..., :3])
            save(root / "mask" / name / f"{n:06d}.png", picture[..., 3])
    return root


def _save_exact(path: Path, pixels: Bytes) -> None:
    """A PNG under a JPEG's name, which every reader tells by its first bytes: the closed form survives."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes())


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
