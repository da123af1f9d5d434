"""The network of the pillar head: a small convolutional backbone and one map of centres, boxes and headings.

After CenterPoint (Yin, Zhou, Krähenbühl, CVPR 2021): an object is a peak in its class's map and the regression
there. The backbone works at 0.5, 1 and 2 m; the last layer predicts the four half-metre cells of each metre at
once and unfolds them, which costs a quarter of convolving at half a metre.
"""

from __future__ import annotations

import torch
from torch import nn

from ...kernels.pillar import pillar_channels

__all__ = ["HEAD_CLASSES", "REGRESSION", "STRIDE", "UNFOLD", "PillarCenterNet"]

HEAD_CLASSES = ("vehicle", "pedestrian", "cyclist", "cone", "barrier")
"""Classes of the heat maps, which are the first channels of the output."""

REGRESSION = ("dx", "dy", "z", "log_l", "log_w", "log_h", "cos_2yaw", "sin_2yaw", "cos_yaw", "sin_yaw")
"""The channels after the heat maps: offset from the cell's centre [cells], centre above ground [m], log sizes, and
the heading twice: of the axis, which is never ambiguous, and of the object, which only chooses the axis's sign."""

STRIDE = 2
"""Input cells along an edge of an output cell."""

UNFOLD = 2
"""Output cells along an edge of the last layer's."""


def _convolution(inputs: int, outputs: int, stride: int = 1, size: int = 3) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False),
        nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.03),
        nn.ReLU(inplace=True),
    )


class _Residual(nn.Module):
    """Two convolutions around a shortcut."""

    def __init__(self, channels: int):
        super().__init__()
        self.first = _convolution(channels, channels)
        self.second = nn.Sequential(
            nn.Conv2d(channels, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels, eps=1e-3, momentum=0.03)
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(x + self.second(self.first(x)))


class PillarCenterNet(nn.Module):
    """Pillars (n, C, H, W) to maps (n, classes + regression, H / 2, W / 2); H and W are multiples of 8.

    Args:
        width: Channels at 0.5, 1 and 2 m.
        depth: Residual blocks at 1 and 2 m.
    """

    def __init__(self, width: tuple[int, int, int] = (24, 48, 128), depth: tuple[int, int] = (1, 1)):
        super().__init__()
        fine, middle, coarse = width
        outputs = len(HEAD_CLASSES) + len(REGRESSION)
        self.stem = _convolution(len(pillar_channels()), fine, stride=2)
        self.down1 = nn.Sequential(_convolution(fine, middle, stride=2), *(_Residual(middle) for _ in range(depth[0])))
        self.down2 = nn.Sequential(
            _convolution(middle, coarse, stride=2), *(_Residual(coarse) for _ in range(depth[1]))
        )
        self.lateral = _convolution(coarse, middle, size=1)
        self.up = nn.Upsample(scale_factor=2, mode="nearest")
        self.merge = _convolution(middle, middle)
        self.head = nn.Conv2d(middle, outputs * UNFOLD**2, 1)
        self.unfold = nn.PixelShuffle(UNFOLD)
        # Centres are rare: begin at a probability of 1 % so that the first steps are not spent on unlearning them.
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.zeros_(self.head.bias)
        with torch.no_grad():
            self.head.bias[: len(HEAD_CLASSES) * UNFOLD**2] = -4.6

    def forward(self, pillars: torch.Tensor) -> torch.Tensor:
        """The maps of a batch of pillars."""
        half = self.stem(pillars)
        one = self.down1(half)
        two = self.down2(one)
        return self.unfold(self.head(self.merge(one + self.up(self.lateral(two)))))
