"""Images that contradict all others are found by their loss, and only those."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rsavatar import kernels
from rsavatar.checkpoint import Owner
from rsavatar.data.base import Image
from rsavatar.doubt import FACTOR, SHARE, Doubt
from rsavatar.methods.base import build_actor, observations, settings
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.optimization import Saver
from rsavatar.train import fit
from tests.core import small_subject

CAMERAS = torch.tensor([0] * 10 + [1] * 10)


def doubt(losses: list[float]) -> Doubt:
    made = Doubt(len(losses))
    for index, loss in enumerate(losses):
        made.note(index, loss)
    return made


def test_losses_that_differ_as_sound_images_do_raise_no_doubt() -> None:
    losses = torch.linspace(1.0, 1.9, 20).tolist()
    assert doubt(losses).judge(CAMERAS) == []


def test_an_outlier_is_found_among_the_images_of_its_own_camera() -> None:
    """Camera 1 loses five times as much as camera 0, which is no reason to doubt it."""
    losses = [1.0] * 10 + [5.0] * 10
    losses[3] = FACTOR * 1.01
    made = doubt(losses)
    assert made.judge(CAMERAS) == [3]
    assert made.trusted == [i for i in range(20) if i != 3]
    assert made.judge(CAMERAS) == []


def test_images_that_nobody_looked_at_are_not_judged() -> None:
    made = Doubt(20)
    made.note(0, 1.0)
    assert made.judge(CAMERAS) == []


def test_at_most_a_share_is_left_out_the_worst_first() -> None:
    losses = [1.0] * 12 + [10.0 + i for i in range(8)]
    made = doubt(losses)
    assert made.judge(torch.zeros(20, dtype=torch.int64)) == [15, 16, 17, 18, 19]
    assert len(made.trusted) == 20 - int(20 * SHARE)


@pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
def test_training_leaves_a_wrong_image_out_and_says_which(tmp_path: Path) -> None:
    case = small_subject.case(iterations=250)
    picture = case.subject.observe

    def observe(camera: str, frame: int) -> Image:
        rgb, mask = picture(camera, frame)
        if (camera, frame) != ("01", 1):
            return rgb, mask
        other = np.zeros_like(mask)
        other[2:38, 2:12] = other[2:38, 28:38] = 255  # two others, and nobody between them
        return np.repeat(other[..., None], 3, -1), other

    case = replace(case, subject=replace(case.subject, observe=observe))
    method = RollingShutterAvatar()
    how = replace(settings(case), density=None, doubt=True, doubt_after=100)
    saver = Saver(tmp_path / "c.safetensors", Owner("a", "b", "c", "d"))
    done = fit(build_actor(method, case), observations(method, case), how, saver, lambda _: None, lambda: False)
    assert done.doubted == ("01/000001",)
