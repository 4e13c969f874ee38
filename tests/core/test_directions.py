"""Sensors that are read upwards or sideways, against pictures put together row by row and column by column."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rsavatar.data.base import Array, Direction
from rsavatar.evaluate import render_slots
from rsavatar.imaging import Actor
from rsavatar.methods.base import (
    Case,
    as_read,
    build_actor,
    is_sideways,
    observations,
    slots_as_read,
    turn_as_read,
)
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.motion.base import InitialMotion
from rsavatar.motion.sequence import SequenceSpline
from rsavatar.shutter.rolling import Instant
from tests.core import small_subject

METHOD = RollingShutterAvatar()
BEND = 0.15  # of the motion's effect: a splat departs from its line over its own rows


def read(direction: Direction) -> Case:
    case = small_subject.case(T="scanline")
    return replace(case, subject=replace(case.subject, timing=replace(case.subject.timing, direction=direction)))


def moving(case: Case) -> Actor:
    actor = build_actor(METHOD, case)
    fit, timing = case.subject.fit, case.subject.timing
    poses, shift = fit.poses.copy(), np.array([[0.0, 0.0, 0.0], [0.5, 0.3, 0.0], [1.0, 0.6, 0.1]])
    motion = InitialMotion(poses, fit.Rh, shift, timing.mid_frames, timing.period_frames, timing.readout_frames)
    actor.motion = SequenceSpline(motion)
    actor.avatar.opacity_logits.data += 4
    actor.avatar.log_scales.data -= 1.2
    return actor


def at_instant(actor: Actor, case: Case, name: str, frame: int, time: float) -> Array:
    camera, weights = case.subject.cameras[name], actor.skin_weights()
    slots = Instant().slots(camera.height, 0.0, time)
    return render_slots(actor, camera, frame, slots, weights, 0).astype(float)


def instant(direction: Direction, line: int, count: int, trigger: float, readout: float) -> float:
    place = line if direction in ("down", "right") else count - 1 - line
    return trigger + readout * (place / count - 0.5)


@pytest.mark.parametrize("direction", ["down", "up", "right", "left"])
@pytest.mark.parametrize("name", ["00", "01"])
def test_every_line_is_from_its_own_instant(direction: Direction, name: str) -> None:
    case = read(direction)
    timing, camera = case.subject.timing, case.subject.cameras[name]
    with torch.no_grad():
        actor = moving(case)
        slots = slots_as_read(METHOD, case, name, timing.readout_frames)
        shot = render_slots(actor, as_read(case, name), 1, slots, actor.skin_weights(), 0).astype(float)
        found = np.rot90(shot) if is_sideways(case) else shot
        wanted = np.zeros_like(found)
        count = camera.width if is_sideways(case) else camera.height
        for line in range(count):
            time = instant(direction, line, count, timing.trigger(name), timing.readout_frames)
            image = at_instant(actor, case, name, 1, time)
            if is_sideways(case):
                wanted[:, line] = image[:, line]
            else:
                wanted[line] = image[line]
    assert wanted.max() > 100
    still = at_instant(actor, case, name, 1, timing.trigger(name))
    effect, error = np.square(still - wanted).mean() ** 0.5, np.square(found - wanted).mean() ** 0.5
    assert effect > 4, "the body does move"
    assert error < BEND * effect


@pytest.mark.parametrize("direction", ["down", "up", "right", "left"])
def test_training_sees_the_picture_as_it_was_read(direction: Direction) -> None:
    case = read(direction)
    case = replace(case, spec=case.spec.model_copy(update={"skip": ()}))
    for seen in observations(METHOD, case):
        name, frame = seen.label.split("/")
        rgb, mask = case.subject.observe(name, int(frame))
        assert np.array_equal(seen.rgb.numpy().transpose(1, 2, 0), turn_as_read(case, rgb))
        assert np.array_equal(seen.mask.numpy(), turn_as_read(case, mask))
        assert (seen.camera.height, seen.camera.width) == seen.mask.shape


def test_a_turned_camera_sees_the_picture_turned() -> None:
    camera = replace(small_subject.camera(0.4), cx=17.0, cy=23.5, fx=50.0, height=30, width=44)
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.3
    pixels, depth = camera.project(points)
    turned, turned_depth = camera.turned().project(points)
    assert turned_depth == pytest.approx(depth)
    assert turned[:, 0] == pytest.approx(camera.height - pixels[:, 1])
    assert turned[:, 1] == pytest.approx(pixels[:, 0])
