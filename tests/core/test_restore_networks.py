"""CVR and JAMNet: counts, names and shapes as published; their parts against brute force; their clocks."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from rsavatar.errors import DataError
from rsavatar.restore.cvr import CVR, Flows, Synthesis, UNet, undistortion
from rsavatar.restore.jamnet import JAMNet, Motion, Restored, moved_to_target, row_offsets, sine_positions
from rsavatar.restore.losses import cvr_loss, flow_loss, jamnet_loss, total_variation
from rsavatar.restore.pwc import PWCNet, correlation, masked_warp


def millions(network: nn.Module) -> float:
    return sum(p.numel() for p in network.parameters()) / 1e6


class TestPublishedFacts:
    """Counts and names that the authors' checkpoints have."""

    def test_jamnet(self) -> None:
        network = JAMNet()
        assert round(millions(network), 3) == 4.732
        shapes = {name: tuple(p.shape) for name, p in network.state_dict().items()}
        assert shapes["encoder.conv0.net.0.weight"] == (16, 3, 7, 7)
        assert shapes["encoder.conv0.net.1.weight"] == (1,)
        assert shapes["encoder.resblocks0.net.0.conv_block.0.net.0.weight"] == (16, 16, 3, 3)
        assert shapes["encoder.conv4.net.0.weight"] == (96, 64, 3, 3)
        layer = "transformer.layers.0."
        for part in ("q_proj", "k_proj", "v_proj", "merge"):
            assert shapes[f"{layer}self_attn.{part}.weight"] == (96, 96)
            assert f"{layer}self_attn.{part}.bias" not in shapes
        assert shapes[layer + "cross_attn_ffn.mlp.0.weight"] == (384, 192)
        assert shapes[layer + "cross_attn_ffn.mlp.2.weight"] == (96, 384)
        assert shapes[layer + "cross_attn_ffn.norm2.weight"] == (96,)
        assert not any(name.startswith(layer + "self_attn.mlp") for name in shapes)
        assert shapes["decorder_5nd.convrelu.0.weight"] == (192, 192, 3, 3)
        assert shapes["decorder_5nd.resblocks.net.2.conv_block.1.net.0.bias"] == (192,)
        for level, above, features in (("4nd", 192, 64), ("3rd", 128, 40), ("2nd", 80, 28)):
            decoder = f"decorder_{level}."
            assert shapes[decoder + "deconv_flow.weight"] == (4, 4, 4, 4)
            assert shapes[decoder + "deconv_hidden.weight"] == (above, 16, 4, 4)
            assert shapes[decoder + "convrelu.0.weight"] == (2 * features, 2 * features + 23, 3, 3)
            assert shapes[decoder + "convrelu.1.weight"] == (1,)
            assert shapes[decoder + "predict_flow.weight"][0] == 4
            assert shapes[decoder + "predict_img.weight"][0] == 3
        assert shapes["decorder_1st.convrelu.0.weight"] == (6, 29, 3, 3)
        assert not any(name.startswith("decorder_1st.predict_flow") for name in shapes)

    def test_cvr(self) -> None:
        network = CVR()
        assert network.net_scale is not None
        assert round(millions(network), 2) == 42.70
        parts = (network.net_flow, network.net_scale, network.net_syn)
        assert [round(millions(part), 3) for part in parts] == [9.374, 16.653, 16.669]
        assert round(millions(network) - millions(network.net_scale), 2) == 26.04  # CVR*
        flow = {name: tuple(p.shape) for name, p in network.net_flow.state_dict().items()}
        assert flow["conv1a.0.weight"] == (16, 3, 3, 3)
        assert flow["conv6aa.0.weight"] == (196, 128, 3, 3)
        assert flow["conv6_4.0.weight"] == (32, 81 + 128 + 128 + 96 + 64, 3, 3)
        assert flow["predict_flow6.weight"] == (2, 529, 3, 3)
        assert flow["deconv6.weight"] == (2, 2, 4, 4)
        assert flow["upfeat6.weight"] == (529, 2, 4, 4)
        assert flow["dc_conv1.0.weight"] == (128, 565, 3, 3)
        assert flow["dc_conv7.weight"] == (2, 32, 3, 3)
        for unet, before, after in ((network.net_scale, 10, 6), (network.net_syn, 20, 5)):
            assert set(unet.state_dict()) == {f"conv{n}.weight" for n in range(1, 24)}
            assert unet.conv1.weight.shape == (32, before, 7, 7)
            assert unet.conv3.weight.shape == (64, 32, 5, 5)
            assert unet.conv23.weight.shape == (after, 32, 3, 3)


class TestCorrelation:
    def test_it_is_the_loop(self) -> None:
        g = torch.Generator().manual_seed(0)
        a, b = (torch.randn(1, 3, 4, 5, generator=g) for _ in range(2))
        found = correlation(a, b, 2)
        assert found.shape == (1, 25, 4, 5)
        for k, (dy, dx) in enumerate((y, x) for y in range(-2, 3) for x in range(-2, 3)):
            for y in range(4):
                for x in range(5):
                    there = b[:, :, y + dy, x + dx] if 0 <= y + dy < 4 and 0 <= x + dx < 5 else torch.zeros(1, 3)
                    torch.testing.assert_close(found[:, k, y, x], (a[:, :, y, x] * there).mean(1))

    def test_its_gradients(self) -> None:
        g = torch.Generator().manual_seed(1)
        a, b = (torch.randn(1, 2, 3, 4, generator=g, dtype=torch.float64, requires_grad=True) for _ in range(2))
        assert torch.autograd.gradcheck(lambda x, y: correlation(x, y, 1), (a, b))

    def test_a_warp_by_nothing_keeps_the_middle_and_blackens_what_is_outside(self) -> None:
        features = torch.rand(1, 2, 33, 33, generator=torch.Generator().manual_seed(2))
        still = masked_warp(features, torch.zeros(1, 2, 33, 33))
        torch.testing.assert_close(still[..., 16, 16], features[..., 16, 16])
        assert not masked_warp(features, torch.full((1, 2, 33, 33), 40.0)).any()


class TestClocks:
    """A world that glides: every pixel moves by the same number of pixels a frame period."""

    def test_jamnet_fetches_from_where_the_scan_saw_it(self) -> None:
        speed = torch.tensor([3.0, 0.0, 3.0, 0.0]).view(1, 4, 1, 1).expand(1, 4, 8, 4)
        moved = moved_to_target(-speed)  # the network's flow runs against the motion
        row = torch.arange(8.0)
        late = (row - 4) / 8
        torch.testing.assert_close(moved[0, 2, :, 0], 3 * late, atol=1e-3, rtol=0)  # second frame: seen late, further
        torch.testing.assert_close(moved[0, 0, :, 0], 3 * (late - 1), atol=1e-3, rtol=0)  # first: a period before that

    def test_padding_below_does_not_move_the_clock(self) -> None:
        whole = row_offsets(8, 1.0, torch.zeros(1))
        padded = row_offsets(16, 0.5, torch.zeros(1))
        torch.testing.assert_close(padded[:, :, :8], whole)

    @pytest.mark.parametrize("time", [0.0, 0.5, 1.0])
    def test_cvr_undistorts_along_the_motion(self, time: float) -> None:
        forth = torch.tensor([3.0, 0.0]).view(1, 2, 1, 1).expand(1, 2, 8, 4)
        half = torch.full((1, 1, 8, 4), 0.5)
        from_a, from_b = undistortion(Flows(forth, -forth, half, half, half, half), time, 8)
        row = torch.arange(8.0) / 8
        exposed_a, exposed_b = row - 0.5, row + 0.5  # frame periods after the first frame's middle row
        torch.testing.assert_close(from_a[0, 0, :, 0], 3 * (time - exposed_a), atol=1e-3, rtol=0)
        torch.testing.assert_close(from_b[0, 0, :, 0], 3 * (time - exposed_b), atol=1e-3, rtol=0)


class TestNetworks:
    def test_sizes_that_do_not_fit_are_named(self) -> None:
        with pytest.raises(DataError, match=r"JAMNet input: expected .*16, got .*40"):
            JAMNet(0.25)(torch.zeros(1, 6, 32, 40))
        with pytest.raises(DataError, match=r"CVR input: expected .*64, got .*32"):
            CVR(0.05).motion(torch.zeros(1, 6, 64, 32))
        with pytest.raises(DataError, match=r"PWC-Net input: expected .*64"):
            PWCNet(0.05)(torch.zeros(1, 3, 32, 32), torch.zeros(1, 3, 32, 32))

    def test_unet_keeps_the_size_at_every_width(self) -> None:
        assert UNet(10, 6, 0.05)(torch.zeros(1, 10, 64, 96)).shape == (1, 6, 64, 96)

    def test_positions_are_unique_and_split_in_rows_and_columns(self) -> None:
        found = sine_positions(torch.zeros(1, 8, 3, 5))[0]
        assert found.shape == (8, 3, 5)
        assert torch.equal(found[:4, :, 0], found[:4, :, 4])
        assert torch.equal(found[4:, 0], found[4:, 2])
        flat = found.flatten(1).T
        assert len(torch.unique(flat, dim=0)) == 15

    def test_every_parameter_of_jamnet_learns(self) -> None:
        torch.manual_seed(0)
        network, frames = JAMNet(0.1), torch.rand(1, 6, 64, 64)
        jamnet_loss(network(frames), frames, torch.rand(1, 3, 64, 64), None).backward()  # type: ignore[no-untyped-call]
        assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in network.parameters())

    def test_every_parameter_of_cvr_that_its_authors_use_learns(self) -> None:
        torch.manual_seed(0)
        network, frames = CVR(0.05), torch.rand(1, 6, 64, 64)
        made = {time: network.at(frames, network.motion(frames), time) for time in (0.0, 1.0)}
        truths = {time: torch.rand(1, 3, 64, 64) for time in made}
        (cvr_loss(made, truths, None) + flow_loss(network, frames)).backward()  # type: ignore[no-untyped-call]
        unused = {name for name, p in network.named_parameters() if p.grad is None}
        assert unused == {"net_flow.deconv2.weight", "net_flow.deconv2.bias"}

    def test_the_blend_carries_a_mask_as_it_carries_the_picture(self) -> None:
        torch.manual_seed(0)
        network, frames = CVR(0.05), torch.rand(1, 6, 64, 64)
        made = network.at(frames, network.motion(frames), 1.0)
        torch.testing.assert_close(made.carried(frames[:, :3], frames[:, 3:]), made.image)


def test_total_variation_is_the_mean_of_neighbours() -> None:
    ramp = torch.arange(4.0).view(1, 1, 1, 4).expand(1, 1, 3, 4)
    assert float(total_variation(ramp)) == 1.0
    assert float(total_variation(torch.zeros(1, 2, 1, 1))) == 0.0


def test_the_loss_of_what_is_perfect_is_its_floor() -> None:
    """Every Charbonnier term is its epsilon, 1e-3: 100 (1 + 1.25 / 4) of them and 4 (12.5 / 4) 2; no flow, no TV."""
    still = torch.full((1, 3, 32, 32), 0.5)
    levels = tuple(
        Motion(torch.zeros(1, 4, n, n), torch.zeros(1, 4, n, n), torch.full((1, 3, n, n), 0.5)) for n in (16, 8, 4, 2)
    )
    made = Restored(still, torch.zeros(1, 4, 32, 32), levels)
    loss = jamnet_loss(made, torch.cat([still, still], 1), still, None)
    assert float(loss) == pytest.approx(1e-3 * (100 * (1 + 1.25 / 4) + 25), rel=1e-4)


def test_cvr_loss_is_ten_of_the_result_and_five_of_the_candidates() -> None:
    truth, made = torch.zeros(1, 3, 4, 4), torch.full((1, 3, 4, 4), 0.1)
    flow, one = torch.zeros(1, 2, 4, 4), torch.ones(1, 1, 4, 4)
    result = Synthesis(made, (made, made), (made, 2 * made), (flow, flow), (one, one), (one, one))
    loss = cvr_loss({0.0: result, 1.0: result}, {0.0: truth, 1.0: truth}, None)
    assert float(loss) == pytest.approx(10 * 0.1 + 5 / 2 * 0.3, rel=1e-5)
