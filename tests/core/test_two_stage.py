"""Correct first, reconstruct second: what is restored, measured and kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsavatar import catalog
from rsavatar.data.base import Image
from rsavatar.errors import DataError
from rsavatar.events import Event, Progress, silent
from rsavatar.methods.base import Case, Prepared, observations
from rsavatar.methods.oblivious import ShutterObliviousAvatar
from rsavatar.methods.two_stage import FlowThenAvatar, measure_gain, restored_subject
from rsavatar.restore.classical import FlowCorrector
from tests.core import small_subject

SPEED = 4.0  # pixels a frame


def drawn(late: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Image:
    """A striped ellipse; row v is seen ``late[v]`` frames after the first frame's middle row."""
    y, x = np.mgrid[: small_subject.SIZE, : small_subject.SIZE].astype(np.float64)
    x = x - SPEED * np.asarray(late)[:, None]
    inside = ((x - 16) / 9) ** 2 + ((y - 20) / 15) ** 2 < 1
    wave = 0.5 + 0.3 * np.sin(0.8 * x) + 0.2 * np.sin(0.7 * y)
    rgb = np.stack([wave, 1 - wave, wave**2], -1) * 255 * inside[..., None]
    return rgb.astype(np.uint8), (255 * inside).astype(np.uint8)


def rolling(camera: str, frame: int) -> Image:
    return drawn(frame + 0.1 * int(camera) + np.arange(small_subject.SIZE) / small_subject.SIZE - 0.5)


def sharp(camera: str, frame: int) -> Image:
    return drawn(np.full(small_subject.SIZE, frame + 0.1 * int(camera)))


@pytest.fixture
def case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Case:
    monkeypatch.setenv("RSAVATAR_CACHE", str(tmp_path))
    whole = small_subject.case(method="flow+gauhuman")
    return replace(whole, subject=replace(whole.subject, observe=rolling, truth=sharp))


def prepared(case: Case, events: list[Event] | None = None) -> Prepared:
    return FlowThenAvatar().prepare(case, silent if events is None else events.append, lambda: False)


def test_the_views_are_restored_and_the_gain_is_measured(case: Case) -> None:
    found = prepared(case)
    assert found.restorer.startswith("dense flow")
    assert found.means["restore_gain_body_db"] > 1
    assert found.means["restore_gain_full_db"] > 1
    before, after, truth = rolling("00", 1)[0], found.case.subject.observe("00", 1)[0], sharp("00", 1)[0]
    assert np.abs(after.astype(int) - truth).mean() < np.abs(before.astype(int) - truth).mean()
    assert found.case.subject.truth is case.subject.truth


def test_a_subject_is_restored_once(case: Case) -> None:
    first: list[Event] = []
    again: list[Event] = []
    prepared(case, first)
    prepared(case, again)
    assert sum(isinstance(event, Progress) for event in first) == 6
    assert not any(isinstance(event, Progress) for event in again)


def test_the_avatar_is_gauhumans_on_other_pictures(case: Case) -> None:
    found = prepared(case).case
    seen, plain = observations(FlowThenAvatar(), found), observations(ShutterObliviousAvatar(), case)
    assert len(seen) == len(plain) == 6
    assert [o.frame for o in seen] == [o.frame for o in plain]
    slots = [method.shutter(found).slots(40, 11.0, 2.0) for method in (FlowThenAvatar(), ShutterObliviousAvatar())]
    assert slots[0] == slots[1]


def test_without_sharp_training_views_nothing_is_claimed(case: Case) -> None:
    def none(camera: str, frame: int) -> Image:
        raise DataError("no sharp frame")

    blind = replace(case, subject=replace(case.subject, truth=none))
    assert prepared(blind).means == {}


def test_an_unchanged_subject_gains_nothing(case: Case) -> None:
    gain = measure_gain(case.subject, case.subject)
    assert gain is not None
    assert (gain.body_db, gain.full_db) == (0.0, 0.0)


def test_cameras_that_were_not_restored_are_named(case: Case) -> None:
    with pytest.raises(DataError, match="restored camera"):
        restored_subject(case.subject, FlowCorrector()).observe("02", 0)


@pytest.mark.parametrize("name", ["cvr+gauhuman", "jamnet+gauhuman", "flow+gauhuman"])
def test_the_methods_are_in_the_catalogue(name: str) -> None:
    method = catalog.load(catalog.METHODS, name)()
    assert method.corrector().identity
    assert name in catalog.DESCRIPTIONS
