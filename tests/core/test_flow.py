"""Dense flow finds shifts that are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rsavatar.errors import DataError
from rsavatar.restore.flow import Bytes, Estimator, dense_flow


def texture(size: int = 96) -> Bytes:
    noise = np.random.default_rng(3).uniform(0, 255, (size, size, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.mark.parametrize("estimator", ["dis", "farneback"])
@pytest.mark.parametrize("shift", [(3.0, 0.0), (-2.0, 4.0), (0.5, -0.25)])
def test_a_known_shift(estimator: Estimator, shift: tuple[float, float]) -> None:
    a = texture()
    moved = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    b = cv2.warpAffine(a, moved, (96, 96), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    flow = dense_flow(a, b, estimator)
    assert flow.shape == (96, 96, 2)
    error = np.linalg.norm(flow[16:-16, 16:-16] - shift, axis=-1)
    assert np.median(error) < 0.1, np.median(error)


def test_pictures_must_match() -> None:
    with pytest.raises(DataError, match="one size"):
        dense_flow(texture(96), texture(80))
    with pytest.raises(DataError, match="12 x 12"):
        dense_flow(texture(8), texture(8))
