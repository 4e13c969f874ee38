"""Writes tiny subjects in the layouts of real ones: a figure of 24 octahedra, drawn as filled convex hulls."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from rsavatar.body.base import JOINTS, BodyModel
from rsavatar.body.skinning import posed_vertices
from rsavatar.body.smpl import save_body
from rsavatar.data.base import Array

SIZE = 64
FRAMES = 5
TRAIN, TEST, EXCLUDED, CAMERAS = (4, 10, 16, 22), (0, 13), 3, 23
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
FACES = np.array([[x, y, z] for x in (0, 1) for y in (2, 3) for z in (4, 5)])
# Metres, y up, about SMPL's proportions; the pelvis is off the origin, as in published files.
JOINT_PLACES = np.array(
    [[0, -.25, .03], [.07, -.34, .02], [-.07, -.34, .02], [0, -.13, 0], [.1, -.75, .02], [-.1, -.75, .02],
     [0, 0, .03], [.09, -1.15, -.02], [-.09, -1.15, -.02], [0, .06, .03], [.12, -1.2, .1], [-.12, -1.2, .1],
     [0, .28, -.01], [.08, .19, 0], [-.08, .19, 0], [0, .36, .04], [.2, .23, 0], [-.2, .23, 0],
     [.45, .22, -.02], [-.45, .22, -.02], [.7, .23, -.02], [-.7, .23, -.02], [.78, .22, -.03], [-.78, .22, -.03]]
)  # fmt: skip


@dataclass(frozen=True)
class Files:
    """A subject on disk and what was drawn."""

    root: Path
    body: Path
    model: BodyModel
    poses: Array  # [N, 72]
    Rh: Array
    Th: Array

    def vertices(self, index: int, model: BodyModel | None = None) -> Array:
        return posed_vertices(model or self.model, self.poses[index], self.Rh[index], self.Th[index], np.zeros(10))


def figure() -> BodyModel:
    """One octahedron of 11 cm about each joint, bound to it; pose blend shapes of some centimetres."""
    random = np.random.default_rng(5)
    weights = np.repeat(np.eye(JOINTS), 6, 0)
    return BodyModel(
        v_template=(JOINT_PLACES[:, None] + 0.11 * OCTAHEDRON).reshape(-1, 3),
        faces=np.concatenate([FACES + 6 * j for j in range(JOINTS)]),
        weights=weights,
        joint_regressor=weights.T / 6,
        parents=PARENTS,
        shape_directions=np.zeros((6 * JOINTS, 3, 10)),
        pose_directions=0.03 * random.standard_normal((6 * JOINTS, 3, 207)),
        name="figure",
    )


def matrix(size: int = SIZE) -> Array:
    """K for pixel centres at whole integers; the principal point is off the middle."""
    return np.array([[1.05 * size, 0, 0.48 * size], [0, 1.05 * size, 0.52 * size], [0, 0, 1]])


def ring(index: int) -> tuple[Array, Array]:
    """R (world to camera), T in metres: on a ring of 3 m, 1 m up, looking at the middle of the body; z is up."""
    angle = 2 * np.pi * index / CAMERAS + 0.3
    centre = np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.4])
    forward = np.array([0, 0, 1.0]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return R, -R @ centre


def motion() -> tuple[Array, Array, Array]:
    """poses, Rh, Th: walking away while arms and legs swing, upright in a world whose z is up."""
    time = np.arange(FRAMES)[:, None]
    poses = np.zeros((FRAMES, 72))
    poses[:, 3:] = 0.35 * np.sin(0.9 * time + np.arange(69))
    upright = cv2.Rodrigues(np.array([np.pi / 2, 0, 0]))[0]
    Rh = [cv2.Rodrigues(cv2.Rodrigues(np.array([0, 0, 0.4 + 0.25 * n]))[0] @ upright)[0].ravel() for n in range(FRAMES)]
    return poses, np.array(Rh), np.concatenate([0.12 * time - 0.25, 0.05 * time, 0 * time + 1.15], 1)


def draw(vertices: Array, K: Array, camera: int, D: Array) -> tuple[np.ndarray, np.ndarray]:
    """RGB image on grey and mask 0/255; OpenCV's own projection and hulls, none of ours."""
    R, T = ring(camera)
    pixels = cv2.projectPoints(vertices, cv2.Rodrigues(R)[0], T, K, D)[0].reshape(JOINTS, 6, 2)
    mask = np.zeros((SIZE, SIZE), np.uint8)
    image = np.full((SIZE, SIZE, 3), 90, np.uint8)
    for j, corners in enumerate(pixels):
        hull = cv2.convexHull(np.rint(corners * 16).astype(np.int32))
        cv2.fillConvexPoly(mask, hull, 255, shift=4)
        cv2.fillConvexPoly(image, hull, (200, 10 * j, 60), shift=4)
    return image, mask


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def save_object(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.array(value, dtype=object), allow_pickle=True)


def load_object(path: Path) -> Any:
    return np.load(path, allow_pickle=True).item()


def edit(path: Path, change: Callable[[Any], None]) -> None:
    """Changes the dictionary in a ``.npy`` or ``.json`` file in place."""
    if path.suffix == ".json":
        value = json.loads(path.read_text())
        change(value)
        path.write_text(json.dumps(value))
    else:
        value = load_object(path)
        change(value)
        save_object(path, value)


def write_common(root: Path, fits: Path, annots: Path, pixel_centre: float, D: Array) -> Files:
    model = figure()
    root.mkdir(parents=True)
    save_body(root / "body.npz", model)
    files = Files(root, root / "body.npz", model, *motion())
    for n in range(FRAMES):
        held = {"poses": files.poses[n : n + 1], "Rh": files.Rh[n : n + 1], "Th": files.Th[n : n + 1]}
        save_object(fits / f"{n}.npy", held | {"shapes": np.zeros((1, 10))})
    K = matrix()
    K[:2, 2] += pixel_centre
    poses = [ring(c) for c in range(CAMERAS)]
    cams = {
        "K": [K] * CAMERAS,
        "R": [R for R, _ in poses],
        "T": [1000 * T[:, None] for _, T in poses],
        "D": [D.reshape(5, 1)] * CAMERAS,
    }
    ims = [{"ims": [f"images/{c:02d}/{n:06d}.png" for c in range(CAMERAS)]} for n in range(FRAMES)]
    save_object(annots, {"cams": cams, "ims": ims})
    return files


def write_rolling(root: Path, D: Array | None = None, drawn: BodyModel | None = None) -> Files:
    """The layout of rolling-shutter subjects. ``drawn`` draws another body than the one on disk."""
    lens = np.zeros(5) if D is None else D
    files = write_common(root, root / "rs" / "new_params", root / "rs" / "annots.npy", 0.5, lens)
    meta = {
        "train": TRAIN, "test": TEST, "excluded": [EXCLUDED], "frames": FRAMES, "K": 11, "gamma": 0.8,
        "mid": [16 + 11 * n for n in range(FRAMES)], "delta": [0.1 * c for c in range(CAMERAS)], "pixel_centre": 0.5,
    }  # fmt: skip
    (root / "meta.json").write_text(json.dumps(meta))
    for n in range(FRAMES):
        vertices = files.vertices(n, drawn)
        for c in TRAIN + TEST:
            image, mask = draw(vertices, matrix(), c, lens)
            for images, masks in (("images", "mask"),) * (c in TRAIN) + (("gt", "gt_mask"),):
                save(root / "rs" / images / f"{c:02d}" / f"{n:06d}.png", image)
                save(root / "rs" / masks / f"{c:02d}" / f"{n:06d}.png", mask)
    return files


def write_zju(root: Path, original: bool = False, D: Array | None = None) -> Files:
    """ZJU-MoCap, refined or original; masks hold the labels 0 and 1. Only the cameras we use have folders."""
    lens = np.zeros(5) if D is None else D
    fits = root / ("new_params" if original else "smpl_params")
    files = write_common(root, fits, root / "annots.npy", 0.0, lens)
    for n in range(FRAMES):
        vertices = files.vertices(n)
        for c in (*TRAIN, *TEST, EXCLUDED):
            image, mask = draw(vertices, matrix(), c, lens)
            folder = Path(f"Camera_B{c + 1}") if original else Path(f"{c:02d}")
            save((root if original else root / "images") / folder / f"{n:06d}.jpg", image)
            save(root / ("mask_cihp" if original else "mask") / folder / f"{n:06d}.png", mask // 255)
    return files
