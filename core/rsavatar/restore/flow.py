"""Dense optical flow between two pictures, by OpenCV; no weights."""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from rsavatar.errors import DataError, expected

Bytes = npt.NDArray[np.uint8]
Flow = npt.NDArray[np.float32]
Estimator = Literal["dis", "farneback"]


def dense_flow(a: Bytes, b: Bytes, estimator: Estimator = "dis") -> Flow:
    """Where every pixel of ``a`` is in ``b``: ``b(p + flow(p)) = a(p)``, as nearly as can be found.

    Args:
        a, b: [H, W, 3] or [H, W], 0..255, of one size; at least 12 pixels a side.
        estimator: "dis" (dense inverse search, finest preset of OpenCV) or "farneback" (polynomial expansion).

    Returns:
        [H, W, 2] pixels, (x, y).

    Raises:
        DataError: if the pictures differ in size, or are too small to have a flow.
    """
    if a.shape != b.shape or min(a.shape[:2]) < 12:
        raise DataError(expected("pictures of a flow", "one size of at least 12 x 12", f"{a.shape} and {b.shape}"))
    first, second = _grey(a), _grey(b)
    if estimator == "farneback":
        found = cv2.calcOpticalFlowFarneback(
            first, second, None, pyr_scale=0.5, levels=5, winsize=15, iterations=5, poly_n=7, poly_sigma=1.5, flags=0
        )
    else:
        found = _dis().calc(first, second, None)
    return np.asarray(found, np.float32)


def _dis() -> Any:
    search: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    search.setPatchStride(2)
    search.setGradientDescentIterations(25)
    search.setVariationalRefinementIterations(5)
    return search


def _grey(image: Bytes) -> Bytes:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
