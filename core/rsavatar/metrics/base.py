"""The protocol: which metrics, in which mask, with which constants. One place computes, the same place states."""

from __future__ import annotations

from rsavatar import catalog
from rsavatar.metrics.image import FLIP_PPD, MASK_RADIUS, Image, Mask, dilate


def score(image: Image, truth: Image, mask: Mask) -> dict[str, float | None]:
    """Every metric of the catalogue inside the body mask dilated by ``MASK_RADIUS`` (paper, section 4.1, "Metrics").

    ``image`` and ``truth`` are float32 [H, W, 3] in [0, 1] on black; ``mask`` is the body's own bool [H, W]: it is
    dilated here and nowhere else.

    Returns:
        Values by catalogue name; None where a metric's weights are absent.

    Raises:
        DataError: if the shapes do not fit, a value is not finite or outside [0, 1], or the mask is empty.
    """
    grown = dilate(mask)
    return {name: catalog.load(catalog.METRICS, name)(image, truth, grown) for name in catalog.METRICS}


def protocol() -> dict[str, str | int | float]:
    """How ``score`` computes: constants and the state of the user's weights, to stand beside every number.

    Raises:
        DataError: if the user named LPIPS weights that cannot be used.
    """
    from rsavatar.metrics.lpips import lpips_state

    return {
        "mask_radius_px": MASK_RADIUS,
        "psnr": "mean squared error over the dilated mask, peak 1",
        "ssim": "Gaussian 11x11, sigma 1.5, reflected border, mean over the dilated mask and channels",
        "flip": "LDR, mean over the dilated mask",
        "flip_pixels_per_degree": FLIP_PPD,
        "lpips": lpips_state(),
        "lpips_inputs": "vgg v0.1, [-1, 1], bounding box of the dilated mask, black outside it",
    }
