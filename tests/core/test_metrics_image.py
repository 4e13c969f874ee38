"""Image metrics: closed forms, identities, the refusals, and agreement with the outside scorer."""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsavatar import catalog
from rsavatar.errors import DataError
from rsavatar.metrics import base, image
from rsavatar.metrics.image import Image, Mask

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared"
RNG = np.random.default_rng(7)

Change = Callable[[Image, Image, Mask], tuple[Image, Image, Mask]]


def random_pair(height: int = 40, width: int = 32) -> tuple[Image, Image]:
    truth = RNG.random((height, width, 3), dtype=np.float32)
    noise = RNG.normal(0, 0.1, truth.shape)
    return np.clip(truth + noise, 0, 1).astype(np.float32), truth


def box_mask(
    height: int = 40, width: int = 32, rows: tuple[int, int] = (12, 20), columns: tuple[int, int] = (9, 25)
) -> Mask:
    mask = np.zeros((height, width), bool)
    mask[slice(*rows), slice(*columns)] = True
    return mask


def flat(value: float, height: int = 24, width: int = 24) -> Image:
    return np.full((height, width, 3), value, np.float32)


def test_dilation_is_the_square_of_the_stated_radius() -> None:
    mask = np.zeros((11, 11), bool)
    mask[5, 5] = mask[0, 10] = True
    wanted = np.zeros((11, 11), bool)
    wanted[3:8, 3:8] = wanted[:3, 8:] = True
    assert np.array_equal(image.dilate(mask), wanted)
    assert np.array_equal(image.dilate(mask, 0), mask)


@given(st.sampled_from([1 / 255, 0.125, 0.25, 0.5]))
def test_psnr_of_a_constant_error_is_its_logarithm(error: float) -> None:
    mask = np.ones((24, 24), bool)
    assert image.psnr(flat(0.5), flat(0.5 - error), mask) == pytest.approx(-20 * np.log10(error), abs=1e-4)


def test_psnr_of_equal_images_is_the_stated_ceiling() -> None:
    assert image.psnr(flat(0.3), flat(0.3), np.ones((24, 24), bool)) == pytest.approx(120.0)


def test_psnr_of_one_wrong_channel_is_three_times_weaker() -> None:
    worse = flat(0.5)
    worse[..., 1] = 0.25
    mask = np.ones((24, 24), bool)
    assert image.psnr(worse, flat(0.5), mask) == pytest.approx(-10 * np.log10(0.25**2 / 3))


@given(st.sampled_from([(0.0, 1.0), (0.25, 0.5), (0.75, 0.5)]))
def test_ssim_of_flat_images_is_the_luminance_term(values: tuple[float, float]) -> None:
    a, b = values
    wanted = (2 * a * b + 0.01**2) / (a * a + b * b + 0.01**2)
    assert image.ssim(flat(a), flat(b), np.ones((24, 24), bool)) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize(("metric", "perfect"), [("psnr", 120.0), ("ssim", 1.0), ("flip", 0.0)])
def test_equal_images_score_perfectly(metric: str, perfect: float) -> None:
    _, truth = random_pair()
    value = catalog.load(catalog.METRICS, metric)(truth, truth.copy(), box_mask())
    assert value == pytest.approx(perfect, abs=1e-6)


@pytest.mark.parametrize("metric", ["psnr", "ssim", "flip"])
def test_pixels_far_outside_the_mask_do_not_matter(metric: str) -> None:
    picture, truth = random_pair(96, 90)
    mask = box_mask(96, 90, (40, 48), (40, 52))
    other = picture.copy()
    other[:16], other[-16:] = 1.0, 0.0
    score = catalog.load(catalog.METRICS, metric)
    assert score(picture, truth, mask) == score(other, truth, mask)


@pytest.mark.parametrize("rows", [(0, 9), (12, 20), (33, 40)])
@pytest.mark.parametrize("metric", ["ssim", "flip"])
def test_the_window_gives_the_mean_of_the_whole_map(
    metric: str, rows: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    picture, truth = random_pair(80, 72)
    mask = box_mask(80, 72, rows, (0, 30))
    windowed = catalog.load(catalog.METRICS, metric)(picture, truth, mask)
    monkeypatch.setattr(image, "_window", lambda *_: (slice(None), slice(None)))
    assert catalog.load(catalog.METRICS, metric)(picture, truth, mask) == pytest.approx(windowed, rel=1e-6)


def test_ssim_is_the_definition_computed_by_sums() -> None:
    """The slow twin: the weighted moments of one 11 x 11 neighbourhood, by the paper's formula."""
    picture, truth = random_pair(31, 31)
    mask = np.zeros((31, 31), bool)
    mask[15, 16] = True
    x, y = (i[10:21, 11:22].astype(float) for i in (picture, truth))
    g = np.exp(-((np.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    w = np.outer(g, g)[..., None] / g.sum() ** 2
    mx, my = (w * x).sum((0, 1)), (w * y).sum((0, 1))
    vx, vy, cov = (
        (w * (x - mx) ** 2).sum((0, 1)),
        (w * (y - my) ** 2).sum((0, 1)),
        (w * (x - mx) * (y - my)).sum((0, 1)),
    )
    wanted = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    assert image.ssim(picture, truth, mask) == pytest.approx(wanted.mean(), rel=1e-9)


def test_flip_grows_with_the_error_and_stays_below_one() -> None:
    mask = np.ones((24, 24), bool)
    values = [image.flip(flat(0.5), flat(0.5 + d), mask) for d in (0.0, 0.05, 0.2, 0.5)]
    assert values == sorted(values)
    assert 0 <= values[0] < values[-1] <= 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda i, t, m: (i[:-1], t, m), "metric image: expected"),
        (lambda i, t, m: (i[..., :2], t[..., :2], m), "metric image: expected"),
        (lambda i, t, m: (i, t, m[1:]), "metric mask: expected"),
        (lambda i, t, m: (i, t, m.astype(np.uint8)), "got uint8"),
        (lambda i, t, m: (i, t, m & False), "at least one pixel"),
        (lambda i, t, m: (np.where(m[..., None], np.float32(np.nan), i), t, m), "got .nan"),
        (lambda i, t, m: (i, np.full_like(t, np.inf), m), "metric truth: expected finite"),
        (lambda i, t, m: (i + 1, t, m), r"values in \[0, 1\]"),
    ],
)
@pytest.mark.parametrize("metric", list(catalog.METRICS))
def test_what_cannot_be_scored_is_refused(metric: str, change: Change, words: str) -> None:
    picture, truth = random_pair()
    with pytest.raises(DataError, match=words):
        catalog.load(catalog.METRICS, metric)(*change(picture, truth, box_mask()))


def test_dilation_refuses_what_is_no_mask() -> None:
    with pytest.raises(DataError, match="mask: expected bool"):
        image.dilate(np.zeros((4, 4), np.uint8))
    with pytest.raises(DataError, match="mask radius: expected 0 or more"):
        image.dilate(np.zeros((4, 4), bool), -1)


def test_score_dilates_once_and_runs_the_whole_catalogue(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RSAVATAR_LPIPS_WEIGHTS", raising=False)
    picture, truth = random_pair()
    mask = box_mask()
    grown = image.dilate(mask)
    values = base.score(picture, truth, mask)
    assert list(values) == list(catalog.METRICS)
    assert values["lpips"] is None
    assert values["psnr"] == image.psnr(picture, truth, grown) != image.psnr(picture, truth, mask)


def test_the_protocol_states_what_the_numbers_depend_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RSAVATAR_LPIPS_WEIGHTS", raising=False)
    stated = base.protocol()
    assert stated["mask_radius_px"] == 2
    assert stated["lpips"] == "weights absent (set RSAVATAR_LPIPS_WEIGHTS)"
    assert "[-1, 1]" in str(stated["lpips_inputs"])


def read(path: Path) -> Any:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


@pytest.mark.shared
@pytest.mark.parametrize("subject", ["wave", "walk"])
def test_agrees_with_the_outside_scorer(subject: str, tmp_path: Path) -> None:
    root = SHARED / "subjects" / subject
    if not root.is_dir() or not (SHARED / "subject-generator" / "score.py").is_file():
        pytest.skip(f"sample subject {subject} and its scorer are not beside the checkout")
    ours = []
    for name in ("000003.png", "000011.png"):
        (tmp_path / "04").mkdir(exist_ok=True)
        shutil.copy(root / "rs/images/04" / name, tmp_path / "04" / name)
        picture, truth = (
            read(f)[..., 2::-1].astype(np.float32) / 255 for f in (tmp_path / "04" / name, root / "rs/gt/04" / name)
        )
        mask = image.dilate(read(root / "rs/gt_mask/04" / name) > 0)
        ours.append((image.psnr(picture, truth, mask), image.ssim(picture, truth, mask)))
    command = [
        sys.executable,
        str(SHARED / "subject-generator/score.py"),
        str(root),
        "--pred",
        str(tmp_path),
        "--cams",
        "4",
    ]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    count, psnr, ssim = re.findall(r"\((\d+), ([\d.]+), ([\d.]+)\)", said)[0]
    assert int(count) == 2
    assert np.mean([p for p, _ in ours]) == pytest.approx(float(psnr), abs=5.1e-4)  # the scorer prints 3 decimals
    assert np.mean([s for _, s in ours]) == pytest.approx(float(ssim), abs=5.1e-5)  # and 4
