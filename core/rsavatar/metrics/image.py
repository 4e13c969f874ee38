"""Image metrics inside a body mask: PSNR, SSIM, ꟻLIP, LPIPS.

**Convention** of all four: ``image`` and ``truth`` are float32 RGB [H, W, 3] in [0, 1], display space, on black;
``mask`` is bool [H, W] and is taken as given: ``base.score`` is the place that dilates it.
"""

from __future__ import annotations

from typing import Any

import cv2
import flip_evaluator
import numpy as np
import numpy.typing as npt

from rsavatar.errors import DataError, expected

Image = npt.NDArray[np.float32]  # [H, W, 3] in [0, 1]
Mask = npt.NDArray[np.bool_]  # [H, W]

MASK_RADIUS = 2  # pixels; the body mask grows by a 5 x 5 square
PSNR_FLOOR = 1e-12  # added to the mean squared error: equal images score 120 dB instead of infinity
SSIM_WINDOW, SSIM_SIGMA = 11, 1.5  # Wang et al. 2004, section III-B
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
FLIP_PPD = 67.0206  # pixels per degree: 0.7 m from a 3840 px, 0.7 m wide display (Andersson et al. 2020, section 6)
FLIP_REACH = 16  # pixels that the filters see around one at this density: 10, measured and rounded up


def dilate(mask: Mask, radius: int = MASK_RADIUS) -> Mask:
    """Grow a mask by a (2 radius + 1)^2 square, nothing growing in from outside the image.

    Returns:
        Mask [H, W]; the same pixels where ``radius`` is 0.

    Raises:
        DataError: if ``mask`` is not a bool [H, W] or ``radius`` is negative.
    """
    if mask.ndim != 2 or mask.dtype != np.bool_:
        raise DataError(expected("mask", "bool [H, W]", f"{mask.dtype} {list(mask.shape)}"))
    if radius < 0:
        raise DataError(expected("mask radius", "0 or more pixels", radius))
    square = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    grown: Mask = cv2.dilate(mask.astype(np.uint8), square).astype(np.bool_)
    return grown


def psnr(image: Image, truth: Image, mask: Mask) -> float:
    """Peak signal-to-noise ratio, -10 log10 of the mean squared error over the mask's pixels and channels.

    Returns:
        Decibels; 120 for equal images (``PSNR_FLOOR``).

    Raises:
        DataError: see ``check``.
    """
    check(image, truth, mask)
    error = image[mask].astype(np.float64) - truth[mask]
    return float(-10.0 * np.log10(np.mean(error * error) + PSNR_FLOOR))


def ssim(image: Image, truth: Image, mask: Mask) -> float:
    """Structural similarity (Wang et al. 2004): 11 x 11 Gaussian of sigma 1.5, reflected border, per channel, float64.

    The map is computed from whole images, the mask only selects what is averaged.

    Returns:
        Mean of the map over the mask's pixels and channels, at most 1.

    Raises:
        DataError: see ``check``.
    """
    check(image, truth, mask)
    window = _window(mask, SSIM_WINDOW // 2)  # pixels further away do not reach the mask
    x, y = image[window].astype(np.float64), truth[window].astype(np.float64)
    return float(ssim_map(x, y)[mask[window]].mean())


def ssim_map(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """SSIM at every pixel and channel of two float64 images [H, W, C]; no constants beyond those above."""
    mean_x, mean_y = _blur(x), _blur(y)
    covariance = _blur(x * y) - mean_x * mean_y
    variance = _blur(x * x) - mean_x * mean_x + _blur(y * y) - mean_y * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x * mean_x + mean_y * mean_y + SSIM_C1)
    structure: npt.NDArray[np.float64] = (2 * covariance + SSIM_C2) / (variance + SSIM_C2)
    return luminance * structure


def flip(image: Image, truth: Image, mask: Mask) -> float:
    """LDR-ꟻLIP (Andersson et al. 2020) of sRGB images at ``FLIP_PPD`` pixels per degree.

    Returns:
        Mean of the error map over the mask's pixels: 0 equal, 1 as different as can be.

    Raises:
        DataError: see ``check``.
    """
    check(image, truth, mask)
    window = _window(mask, FLIP_REACH)
    reference, test = (np.ascontiguousarray(i[window], dtype=np.float32) for i in (truth, image))
    options: dict[str, Any] = {"inputsRGB": True, "applyMagma": False, "computeMeanError": False}
    error, _, _ = flip_evaluator.evaluate(reference, test, "LDR", parameters={"ppd": FLIP_PPD}, **options)
    return float(np.asarray(error, np.float64)[..., 0][mask[window]].mean())


def lpips(image: Image, truth: Image, mask: Mask) -> float | None:
    """LPIPS v0.1 with VGG16 (Zhang et al. 2018) on the mask's bounding box, black outside the mask.

    Returns:
        The distance, or None where the user's weights are absent (``lpips_state`` says so).

    Raises:
        DataError: see ``check``; also if the weights file cannot be used.
    """
    check(image, truth, mask)
    from rsavatar.metrics import lpips as network  # torch only where weights may be

    path = network.weights_path()
    if path is None:
        return None
    window = _window(mask, 0)
    keep = mask[window][..., None]
    return network.distance(path, image[window] * keep, truth[window] * keep)


def check(image: Image, truth: Image, mask: Mask) -> None:
    """Refuse what no metric can be computed from.

    Raises:
        DataError: if the shapes do not fit together, a value is not finite or outside [0, 1], or the mask is empty.
    """
    for name, value in {"image": image, "truth": truth}.items():
        if value.ndim != 3 or value.shape[2] != 3 or value.shape != truth.shape:
            raise DataError(
                expected(f"metric {name}", f"[H, W, 3] as the truth's {list(truth.shape)}", list(value.shape))
            )
        low, high = float(value.min(initial=0.0)), float(value.max(initial=0.0))  # NaN goes through both
        if not (low >= 0.0 and high <= 1.0):
            raise DataError(expected(f"metric {name}", "finite values in [0, 1]", f"[{low:g}, {high:g}]"))
    if mask.dtype != np.bool_ or mask.shape != truth.shape[:2]:
        raise DataError(expected("metric mask", f"bool {list(truth.shape[:2])}", f"{mask.dtype} {list(mask.shape)}"))
    if not mask.any():
        raise DataError(expected("metric mask", "at least one pixel", "an empty mask"))


def _window(mask: Mask, margin: int) -> tuple[slice, slice]:
    """Bounding box of the mask, grown by ``margin`` pixels where the image goes on."""
    return _span(np.any(mask, axis=1), margin), _span(np.any(mask, axis=0), margin)


def _span(flags: npt.NDArray[np.bool_], margin: int) -> slice:
    inside = np.flatnonzero(flags)
    return slice(max(int(inside[0]) - margin, 0), int(inside[-1]) + margin + 1)


def _blur(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    blurred: npt.NDArray[np.float64] = cv2.GaussianBlur(x, (SSIM_WINDOW, SSIM_WINDOW), SSIM_SIGMA)
    return blurred
