"""Correct first, reconstruct second: what is restored, measured and kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsavatar import catalog
from rsavatar.data.base import Direction, Image
from rsavatar.errors import DataError
from rsavatar.events import Event, Progress, silent
from rsavatar.methods.base import Case, Prepared, observations
from rsavatar.methods.oblivious import ShutterObliviousAvatar
from rsavatar.methods.two_stage import FlowThenAvatar, measure_gain, restored_subject, turned
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


@pytest.mark.parametrize("direction", ["down", "up", "left", "right"])
def test_a_sensor_is_restored_in_the_direction_it_is_read(case: Case, direction: Direction) -> None:
    """The same pictures turned: restored as the upright ones, and turned back."""

    def observe(camera: str, frame: int) -> Image:
        return turned(rolling(camera, frame), direction, back=True)

    timing = replace(case.subject.timing, direction=direction)
    found = restored_subject(replace(case.subject, observe=observe, timing=timing), FlowCorrector())
    upright = restored_subject(case.subject, FlowCorrector())
    for mine, other in zip(found.observe("01", 1), turned(upright.observe("01", 1), direction, back=True), strict=True):
        np.testing.assert_array_equal(mine, other)
    first = turned(rolling("00", 0), direction, back=True)[1]
    rows = {"down": first[:1], "up": first[-1:], "right": first[:, :1].T, "left": first[:, -1:].T}[direction]
    np.testing.assert_array_equal(rows, rolling("00", 0)[1][:1])


def test_images_that_were_never_taken_are_left_out(case: Case) -> None:
    missing = frozenset({("00", 1)})
    found = prepared(replace(case, subject=replace(case.subject, missing=missing))).case.subject
    np.testing.assert_array_equal(found.observe("00", 0)[0], rolling("00", 0)[0])  # no neighbour left
    assert (found.observe("01", 1)[0] != rolling("01", 1)[0]).any()
    with pytest.raises(DataError, match=r"000001\.png"):
        found.observe("00", 1)


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
