"""Density control: closed forms of the divergence, and what each rule does to which Gaussian."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rsavatar.avatar.avatar import PARAMETERS
from rsavatar.avatar.density import DensityRules, ScreenGradients, decide, divergence, neighbours, prune
from rsavatar.methods.base import build_actor
from rsavatar.methods.rolling import RollingShutterAvatar
from tests.core import small_subject

RULES = DensityRules()


def test_divergence_of_equal_gaussians_is_zero_and_of_shifted_ones_half_the_mahalanobis_distance() -> None:
    means = torch.tensor([[0.0, 0, 0], [0.3, 0, 0]], dtype=torch.float64)
    covariances = 0.01 * torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    assert divergence(means, covariances, torch.tensor([0, 1])).tolist() == pytest.approx([0, 0], abs=1e-12)
    assert divergence(means, covariances, torch.tensor([1, 0])).tolist() == pytest.approx([4.5, 4.5])


def test_divergence_equals_torchs() -> None:
    g = torch.Generator().manual_seed(0)
    means = torch.randn(5, 3, generator=g, dtype=torch.float64)
    factor = torch.randn(5, 3, 3, generator=g, dtype=torch.float64)
    covariances = factor @ factor.transpose(1, 2) + 0.1 * torch.eye(3, dtype=torch.float64)
    other = torch.tensor([1, 2, 3, 4, 0])
    p = torch.distributions.MultivariateNormal(means, covariances)
    q = torch.distributions.MultivariateNormal(means[other], covariances[other])
    torch.testing.assert_close(divergence(means, covariances, other), torch.distributions.kl_divergence(p, q))


def test_a_neighbour_is_never_oneself_even_among_twins() -> None:
    points = torch.tensor([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [1.1, 0, 0]], dtype=torch.float64)
    assert neighbours(points).tolist() == [1, 0, 3, 2]


def test_only_hot_gaussians_change_and_indices_stay_aligned() -> None:
    avatar = build_actor(RollingShutterAvatar(), small_subject.case()).avatar
    hot = torch.zeros(avatar.count)
    avatar.log_scales.data[:] = -6.0
    avatar.log_scales.data[:, 5] = -2.0
    hot[[3, 5]] = 1.0
    edit, done = decide(avatar, hot, 3.0, RULES, seed=0)
    assert (done.cloned, done.split, done.merged) == (1, 1, 0)
    assert edit.keep.tolist() == [i != 5 for i in range(avatar.count)]
    assert all(edit.added[name].shape[-1] == 3 for name in PARAMETERS)
    assert torch.equal(edit.added["log_scales"][:, 0], avatar.log_scales[:, 3])
    assert torch.allclose(edit.added["log_scales"][:, 1:], torch.tensor(-2.0 - 0.47000363))
    assert (edit.added["means"][:, 0] - avatar.means[:, 3]).norm() < 5 * 3e-3


def test_twins_are_merged_into_one() -> None:
    avatar = build_actor(RollingShutterAvatar(), small_subject.case()).avatar
    avatar.log_scales.data[:] = -6.0
    avatar.means.data[:, 8] = avatar.means.data[:, 7]
    avatar.opacity_logits.data[8] = 1.0
    hot = torch.zeros(avatar.count)
    hot[[7, 8]] = 1.0
    edit, done = decide(avatar, hot, 3.0, RULES, seed=0)
    assert done.merged == 1
    assert edit.keep.sum() == avatar.count - 2
    expected = (float(avatar.opacity_logits.detach()[7]) + 1.0) / 2
    assert float(edit.added["opacity_logits"]) == pytest.approx(expected)


def test_transparent_and_stray_gaussians_are_pruned() -> None:
    avatar = build_actor(RollingShutterAvatar(), small_subject.case()).avatar
    avatar.opacity_logits.data[2] = -10.0
    avatar.means.data[:, 4] += 9.0
    edit = prune(avatar, avatar.bind(), RULES)
    assert torch.nonzero(~edit.keep)[:, 0].tolist() == [2, 4]


def test_growth_stops_at_the_limit() -> None:
    avatar = build_actor(RollingShutterAvatar(), small_subject.case()).avatar
    avatar.log_scales.data[:] = -6.0
    _, done = decide(avatar, torch.ones(avatar.count), 3.0, replace(RULES, most=avatar.count + 4), seed=0)
    assert done.cloned + done.split == 4


def test_gradients_are_averaged_over_the_images_that_saw_the_gaussian() -> None:
    running = ScreenGradients(2)
    running.add(torch.tensor([[3e-3, 0.0], [4e-3, 0.0]]), 2, 2)
    running.add(torch.tensor([[1e-3, 0.0], [0.0, 1e-3]]), 2, 2)
    assert running.mean().tolist() == pytest.approx([3e-3, 1e-3])
