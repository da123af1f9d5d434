"""TwinLiteNet (Che et al., MAPR 2023): drivable area and lanes in an image, from its authors' state dict.

An ESPNet encoder (Mehta et al., ECCV 2018), attention over places and over channels (Fu et al., DANet, CVPR 2019),
and a decoder of deconvolutions for each of the two masks. Names of the layers are those of the state dict.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch  # noqa: TID253 (nothing but an import loads this module)
from torch import nn  # noqa: TID253

from ..camera.card import ImageSpec, MaskCard, TensorName
from .checkpoint import load_tensors, read_state_dict, write_head

__all__ = ["TwinLiteNet", "import_twinlitenet"]

_SHAPE = (1, 3, 360, 640)
_DILATIONS = (1, 2, 4, 8, 16)


class _Convolution(nn.Module):
    """A convolution that keeps the size but for its stride, by the name `conv`."""

    def __init__(self, inputs: int, outputs: int, size: int, stride: int = 1, dilation: int = 1):
        super().__init__()
        padding = (size - 1) // 2 * dilation
        self.conv = nn.Conv2d(inputs, outputs, size, stride, padding, dilation, bias=False)

    def forward(self, x):
        return self.conv(x)


class _Activation(nn.Module):
    """Batch norm and a rectifier that learns its slope."""

    def __init__(self, channels: int):
        super().__init__()
        self.bn = nn.BatchNorm2d(channels, eps=1e-3)
        self.act = nn.PReLU(channels)

    def forward(self, x):
        return self.act(self.bn(x))


class _Normed(_Activation):
    """A convolution, batch norm and rectifier."""

    def __init__(self, inputs: int, outputs: int, size: int, stride: int = 1):
        super().__init__(outputs)
        self.conv = nn.Conv2d(inputs, outputs, size, stride, (size - 1) // 2, bias=False)

    def forward(self, x):
        return super().forward(self.conv(x))


class _Up(_Activation):
    """Twice the size."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__(outputs)
        self.deconv = nn.ConvTranspose2d(inputs, outputs, 2, 2, bias=False)

    def forward(self, x):
        return super().forward(self.deconv(x))


class _Pyramid(nn.Module):
    """Five convolutions of growing reach over one reduction, each but the first added to those before it."""

    def __init__(self, inputs: int, outputs: int, size: int, stride: int):
        super().__init__()
        each = outputs // 5
        self.c1 = _Convolution(inputs, each, size, stride)
        for dilation in _DILATIONS:
            width = outputs - 4 * each if dilation == 1 else each
            self.add_module(f"d{dilation}", _Convolution(each, width, 3, 1, dilation))

    def parts(self, x):
        reduced = self.c1(x)
        sums = [self.get_submodule("d2")(reduced)]
        for dilation in _DILATIONS[2:]:
            sums.append(sums[-1] + self.get_submodule(f"d{dilation}")(reduced))
        return torch.cat([self.get_submodule("d1")(reduced), *sums], dim=1)


class _Down(_Pyramid):
    """Half the size."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__(inputs, outputs, 3, 2)
        self.bn = nn.BatchNorm2d(outputs, eps=1e-3)
        self.act = nn.PReLU(outputs)

    def forward(self, x):
        return self.act(self.bn(self.parts(x)))


class _Residual(_Pyramid):
    """The same size, with a shortcut."""

    def __init__(self, channels: int):
        super().__init__(channels, channels, 1, 1)
        self.bn = _Activation(channels)

    def forward(self, x):
        return self.bn(x + self.parts(x))


class _PlaceAttention(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.query_conv = nn.Conv2d(channels, channels // 8, 1)
        self.key_conv = nn.Conv2d(channels, channels // 8, 1)
        self.value_conv = nn.Conv2d(channels, channels, 1)
        self.gamma = nn.Parameter(torch.zeros(1))

    def forward(self, x):
        query, key, value = (layer(x).flatten(2) for layer in (self.query_conv, self.key_conv, self.value_conv))
        attention = torch.softmax(query.transpose(1, 2) @ key, dim=-1)
        return self.gamma * (value @ attention.transpose(1, 2)).reshape(x.shape) + x


class _ChannelAttention(nn.Module):
    def __init__(self):
        super().__init__()
        self.gamma = nn.Parameter(torch.zeros(1))

    def forward(self, x):
        flat = x.flatten(2)
        energy = flat @ flat.transpose(1, 2)
        attention = torch.softmax(energy.max(dim=-1, keepdim=True).values - energy, dim=-1)
        return self.gamma * (attention @ flat).reshape(x.shape) + x


class _Encoder(nn.Module):
    def __init__(self, fine: int, coarse: int):
        super().__init__()
        self.level1 = _Normed(3, 16, 3, 2)
        self.b1 = _Normed(19, 19, 3)
        self.level2_0 = _Down(19, 64)
        self.level2 = nn.ModuleList(_Residual(64) for _ in range(fine))
        self.b2 = _Normed(131, 131, 3)
        self.level3_0 = _Down(131, 128)
        self.level3 = nn.ModuleList(_Residual(128) for _ in range(coarse))
        self.b3 = _Normed(256, 32, 3)
        self.sa, self.sc = _PlaceAttention(32), _ChannelAttention()
        self.conv_sa, self.conv_sc = _Normed(32, 32, 3), _Normed(32, 32, 3)
        self.classifier = _Normed(32, 32, 1)

    def forward(self, image):
        half = nn.functional.avg_pool2d(image, 3, 2, 1)
        quarter = nn.functional.avg_pool2d(half, 3, 2, 1)
        first = self.level2_0(self.b1(torch.cat([self.level1(image), half], dim=1)))
        x = first
        for layer in self.level2:
            x = layer(x)
        second = self.level3_0(self.b2(torch.cat([x, first, quarter], dim=1)))
        x = second
        for layer in self.level3:
            x = layer(x)
        x = self.b3(torch.cat([second, x], dim=1))
        return self.classifier(self.conv_sa(self.sa(x)) + self.conv_sc(self.sc(x)))


class TwinLiteNet(nn.Module):
    """Images (n, 3, H, W), RGB in [0, 1], to logits of drivable area and lanes, each (n, 2, H, W); 8 divides H and W.

    Args:
        fine: Residual blocks at a quarter of the size.
        coarse: And at an eighth.
    """

    def __init__(self, fine: int = 2, coarse: int = 3):
        super().__init__()
        self.encoder = _Encoder(fine, coarse)
        self.up_1_1, self.up_2_1, self.classifier_1 = _Up(32, 16), _Up(16, 8), _Up(8, 2)
        self.up_1_2, self.up_2_2, self.classifier_2 = _Up(32, 16), _Up(16, 8), _Up(8, 2)

    def forward(self, image):
        """Logits of the two masks."""
        x = self.encoder(image)
        return (
            self.classifier_1(self.up_2_1(self.up_1_1(x))),
            self.classifier_2(self.up_2_2(self.up_1_2(x))),
        )


def import_twinlitenet(
    checkpoint: str | Path, folder: str | Path, *, name: str = "twinlitenet", licence: str = "MIT"
) -> Path:
    """Makes a head of the authors' checkpoint: `NAME.onnx` and `NAME.yaml`.

    Args:
        checkpoint: The state dict, `.pth`.
        folder: Where the two files go.
        name: Of the head.
        licence: Of the weights.

    Returns:
        The path of the card, which `MaskHead` takes.

    Raises:
        ModelError: The checkpoint cannot be read, or is of another network.
    """
    network = TwinLiteNet()
    load_tensors(network, read_state_dict(checkpoint), checkpoint, "a TwinLiteNet")
    shape = (1, 2, *_SHAPE[2:])
    return write_head(
        network,
        {"image": np.zeros(_SHAPE, np.float32)},
        ("drivable_area", "lane"),
        Path(folder),
        MaskCard,
        {
            "name": name,
            "description": "TwinLiteNet: drivable area and lanes, trained on BDD100K by its authors.",
            "classes": ("drivable_area", "lane"),
            "input": ImageSpec(name="image", shape=_SHAPE, order="rgb", scale=1.0 / 255.0, fit="stretch"),
            "outputs": (
                TensorName(name="drivable_area", shape=shape),
                TensorName(name="lane", shape=shape),
            ),
            "training": {"imported_from": Path(checkpoint).name, "data": "BDD100K"},
            "measured": {},
            "licence": licence,
        },
    )
