"""Where training from nothing begins: networks that hand their second frame through, and flows that are zero.

The architectures are untouched; only their first numbers are chosen so that the result before the first step is the
rolling-shutter frame itself, and every step after it is spent on the shutter.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rsavatar.restore.cvr import CVR, UNet
from rsavatar.restore.jamnet import Decoder, JAMNet

SMALL = 0.01  # of the usual spread, where exactly 0 would stop the learning


def begin(network: nn.Module) -> None:
    """Set the parameters that decide the first result; the others keep torch's."""
    with torch.no_grad():
        for part in network.modules():
            if isinstance(part, UNet):
                part.conv23.weight.mul_(SMALL)
        if isinstance(network, JAMNet):
            _begin_jamnet(network)
        elif isinstance(network, CVR):
            for level in range(2, 7):
                _weaken(network.net_flow.get_submodule(f"predict_flow{level}"))
                _enlarge(network.net_flow.get_submodule(f"deconv{level}"), 1.0)
            _weaken(network.net_flow.dc_conv7)


def _begin_jamnet(network: JAMNet) -> None:
    _weaken(network.decorder_5nd.predict_flow)
    for decoder in (network.decorder_4nd, network.decorder_3rd, network.decorder_2nd):
        _weaken(decoder.predict_flow)
    for decoder in (network.decorder_4nd, network.decorder_3rd, network.decorder_2nd, network.decorder_1st):
        _enlarge(decoder.deconv_flow, 2.0)  # pixels are half as large
    _hand_through(network.decorder_1st)


def _hand_through(last: Decoder) -> None:
    """Output = second frame as fetched: input channels 3 to 5 through hidden channels 0 to 2."""
    first, image = last.convrelu.get_submodule("0"), last.predict_img
    assert isinstance(first, nn.Conv2d)
    ends = [last.resblocks.get_submodule(f"net.{n}.conv_block.1.net.0") for n in range(len(last.resblocks.net))]
    for conv in (first, image, *ends):
        _weaken(conv)
    for channel in range(3):
        first.weight[channel] = 0
        first.weight[channel, 3 + channel, 1, 1] = 1
        image.weight[channel, channel, 1, 1] = 1


def _weaken(conv: nn.Module) -> None:
    for parameter in conv.parameters():
        parameter.mul_(SMALL)


def _enlarge(conv: nn.Module, gain: float) -> None:
    """A transposed convolution 4 x 4 of stride 2 that doubles each channel's size bilinearly, times ``gain``."""
    assert isinstance(conv, nn.ConvTranspose2d)
    side = torch.tensor([0.25, 0.75, 0.75, 0.25])
    kernel: Tensor = gain * side[:, None] * side[None]
    conv.weight.zero_()
    for channel in range(conv.in_channels):
        conv.weight[channel, channel] = kernel
    if conv.bias is not None:
        conv.bias.zero_()
