"""A subject in memory, small enough to train in a second: the test body seen by two cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rsavatar.body.base import BodyModel
from rsavatar.data.base import BodyFit, Image, Subject, Timing
from rsavatar.geometry.cameras import Camera
from rsavatar.methods.base import Case
from rsavatar.spec import resolve
from tests.core.bodies import PARENTS, smpl_arrays

SIZE, FRAMES = 40, 3


def camera(angle: float) -> Camera:
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0.0, -s], [0.0, -1.0, 0.0], [-s, 0.0, -c]])
    return Camera(turn, np.array([0.0, 0.0, 3.0]), 48.0, 48.0, SIZE / 2, SIZE / 2, SIZE, SIZE)


def picture(camera: str, frame: int) -> Image:
    """A bright ellipse that moves from frame to frame; read-only, as pictures that are shared are."""
    y, x = np.mgrid[:SIZE, :SIZE]
    inside = ((x - 20 - frame) / 8) ** 2 + ((y - 20) / 14) ** 2 < 1
    rgb = np.stack([200 * inside, 90 * inside + 60 * inside * (y % 4 < 2), 120 * inside], -1)
    pictures = rgb.astype(np.uint8), (255 * inside).astype(np.uint8)
    for one in pictures:
        one.setflags(write=False)
    return pictures


def subject() -> Subject:
    g = np.random.default_rng(0)
    fit = BodyFit(
        0.1 * g.normal(size=(FRAMES, 72)) * (np.arange(72) >= 3),
        0.1 * g.normal(size=(FRAMES, 3)),
        0.02 * g.normal(size=(FRAMES, 3)),
        np.zeros(10),
    )
    timing = Timing(np.array([16.0, 27.0, 38.0]), 11.0, 11.0, {"01": 2.0})
    cameras = {"00": camera(0.0), "01": camera(1.2), "02": camera(0.6)}
    return Subject("small", Path(), cameras, ("00", "01"), ("02",), fit, timing, picture, picture, "fingerprint")


def body() -> BodyModel:
    a = smpl_arrays(vertices=150)
    flat = a["v_template"] * np.array([0.5, 0.8, 0.4])
    arrays = (a["weights"], a["J_regressor"].toarray(), PARENTS, a["shapedirs"], a["posedirs"])
    return BodyModel(flat, a["f"].astype(np.int64), *arrays, "random")


def case(**request: object) -> Case:
    return Case(resolve({"method": "rs-avatar", "subject": "small", "preset": "smoke", **request}), subject(), body())
