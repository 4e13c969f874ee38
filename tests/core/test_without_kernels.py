"""Where no kernel could be built, training still works, slowly, and to the same end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rsavatar import kernels
from rsavatar.checkpoint import Owner
from rsavatar.events import Event, Progress
from rsavatar.methods.base import build_actor, observations, settings
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.optimization import Saver
from rsavatar.train import fit
from tests.core import small_subject


def losses(folder: Path) -> list[float]:
    case, method = small_subject.case(iterations=25), RollingShutterAvatar()
    actor, seen = build_actor(method, case), list[Event]()
    saver = Saver(folder / "checkpoint.safetensors", Owner("spec", "data", "body", "code"))
    fit(actor, observations(method, case), replace(settings(case), density=None), saver, seen.append, lambda: False)
    return [e.loss for e in seen if isinstance(e, Progress) and e.loss is not None]


@pytest.mark.skipif(not kernels.available(), reason="no native kernels to compare with")
def test_the_twin_trains_like_the_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "kernels").mkdir()
    (tmp_path / "twin").mkdir()
    fast = losses(tmp_path / "kernels")
    monkeypatch.setattr(kernels, "targets", lambda: ["absent"])
    kernels.library.cache_clear()
    try:
        assert not kernels.available()
        slow = losses(tmp_path / "twin")
    finally:
        monkeypatch.undo()
        kernels.library.cache_clear()
    torch.testing.assert_close(torch.tensor(slow), torch.tensor(fast), rtol=0.02, atol=0)  # 25 steps of float32 drift
