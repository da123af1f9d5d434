"""The network of the pillar head: a small convolutional backbone and one map of centres, boxes and headings.

After CenterPoint (Yin, Zhou, Krähenbühl, CVPR 2021): an object is a peak in its class's map and the regression
there. The backbone works at 0.5, 1 and 2 m; the last layer predicts the four half-metre cells of each metre at
once and unfolds them, which costs a quarter of convolving at half a metre.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

from ...kernels.pillar import pillar_channels

__all__ = ["EXTRAS", "HEAD_CLASSES", "LEAN_CHANNELS", "REGRESSION", "STRIDE", "UNFOLD", "PillarCenterNet"]

HEAD_CLASSES = ("vehicle", "pedestrian", "cyclist", "cone", "barrier")
"""Classes of the heat maps, which are the first channels of the output."""

REGRESSION = ("dx", "dy", "z", "log_l", "log_w", "log_h", "cos_2yaw", "sin_2yaw", "cos_yaw", "sin_yaw")
"""The channels after the heat maps: offset from the cell's centre [cells], centre above ground [m], log sizes, and
the heading twice: of the axis, which is never ambiguous, and of the object, which only chooses the axis's sign."""

EXTRAS = ("iou", "vx", "vy")
"""What more the network can say of each cell: how well the box there fits, as twice its overlap less one (CIA-SSD,
Zheng et al. 2021), and the velocity over ground along the grid's axes [10 m/s]."""

LEAN_CHANNELS = (*pillar_channels()[:11], *pillar_channels()[-5:])
"""16 of the 20 channels: without the height slices above 2.5 m, of which the highest z tells as well."""

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


def _frozen(layer: nn.Sequential, x: torch.Tensor, rectified: bool = True) -> torch.Tensor:
    """A convolution and its batch norm in evaluation as one convolution; its gradient is that of the two.

    On a CPU a batch norm costs as much as the convolution before it, and a rectifier of its own half of that.
    """
    convolution, norm = layer[0], layer[1]
    scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    weight = (convolution.weight * scale[:, None, None, None]).to(x.dtype, memory_format=torch.channels_last)
    bias = (norm.bias - norm.running_mean * scale).to(x.dtype)
    y = functional.conv2d(x, weight, bias, convolution.stride, convolution.padding)
    return functional.relu_(y) if rectified else y


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

    def frozen(self, x: torch.Tensor) -> torch.Tensor:
        """The same in evaluation, see `_frozen`."""
        return functional.relu_(_frozen(self.second, _frozen(self.first, x), rectified=False).add_(x))


class PillarCenterNet(nn.Module):
    """Pillars (n, C, H, W) to maps (n, classes + regression, H / 2, W / 2); H and W are multiples of 8.

    Args:
        width: Channels at 0.5, 1 and 2 m.
        depth: Residual blocks at 1 and 2 m.
        channels: The pillar channels that it is given, of those of `pillar_channels`.
        extras: Of `EXTRAS`, what it says besides.
    """

    def __init__(
        self,
        width: tuple[int, int, int] = (24, 48, 128),
        depth: tuple[int, int] = (1, 1),
        channels: tuple[str, ...] = pillar_channels(),
        extras: tuple[str, ...] = (),
    ):
        super().__init__()
        there = pillar_channels()
        for name, said, known in (("channels", channels, there), ("extras", extras, EXTRAS)):
            if unknown := [one for one in said if one not in known]:
                raise ValueError(f"{name} must be of {', '.join(known)}, not {', '.join(unknown)}")
        if min(width) < 1 or min(depth) < 0:
            raise ValueError(f"width must be 1 or more each and depth 0 or more, not {width} and {depth}")
        fine, middle, coarse = width
        outputs = len(HEAD_CLASSES) + len(REGRESSION)
        self.extras = tuple(extras)
        self.channels = tuple(channels)
        self.stem = _convolution(len(channels), fine, stride=2)
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
        # Made last, so that a seed gives the same weights with and without it.
        self.extra = nn.Conv2d(middle, len(extras) * UNFOLD**2, 1) if extras else None

    def _features(self, pillars: torch.Tensor) -> torch.Tensor:
        half = self.stem(pillars)
        one = self.down1(half)
        two = self.down2(one)
        return self.merge(one + self.up(self.lateral(two)))

    def forward(self, pillars: torch.Tensor) -> torch.Tensor:
        """The maps of a batch of pillars."""
        return self.unfold(self.head(self._features(pillars)))

    def forward_all(self, pillars: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """The maps, and those of `extras`, shape (n, extras, H / 2, W / 2), None without any."""
        features = self._features(pillars)
        return self.unfold(self.head(features)), None if self.extra is None else self.unfold(self.extra(features))

    def folded_maps(self, pillars: torch.Tensor, frozen: bool = False) -> torch.Tensor:
        """All maps and extras, not unfolded: shape (n, (classes + regression + extras) · UNFOLD², H / 4, W / 4).

        Args:
            pillars: Shape (n, C, H, W).
            frozen: Batch norms keep their statistics and are folded into the convolutions, in the dtype of pillars:
                half the time. For networks that have been trained so far that those statistics hold.
        """
        features = self._frozen_features(pillars) if frozen else self._features(pillars)
        layers = [self.head] if self.extra is None else [self.head, self.extra]
        weight = torch.cat([layer.weight for layer in layers]).to(features.dtype, memory_format=torch.channels_last)
        return functional.conv2d(features, weight, torch.cat([layer.bias for layer in layers]).to(features.dtype))

    def _frozen_features(self, pillars: torch.Tensor) -> torch.Tensor:
        one = _frozen(self.down1[0], _frozen(self.stem, pillars))
        for block in self.down1[1:]:
            one = block.frozen(one)
        two = _frozen(self.down2[0], one)
        for block in self.down2[1:]:
            two = block.frozen(two)
        return _frozen(self.merge, one + self.up(_frozen(self.lateral, two)))

    def begin_with(self, state: dict[str, torch.Tensor]) -> None:
        """Takes over the weights of another network of this kind, of which it may be wider or know more or less.

        Where shapes differ, the common part is copied; what is new among a layer's inputs begins at zero for the
        outputs that were there, so that these say at first what they did (Net2Net, Chen et al., ICLR 2016), and new
        outputs begin at random. A residual block that is new begins as nothing but its shortcut.

        Args:
            state: Its `state_dict`.
        """
        own = self.state_dict()
        every = pillar_channels()
        for name, mine in own.items():
            if name not in state:
                if name.endswith("second.1.weight"):
                    mine.zero_()
                continue
            given = state[name]
            if name == "stem.0.weight" and given.shape[1] == len(every) and len(self.channels) < len(every):
                given = given[:, [every.index(channel) for channel in self.channels]]
            if mine.shape == given.shape:
                mine.copy_(given)
                continue
            common = tuple(slice(min(a, b)) for a, b in zip(mine.shape, given.shape, strict=True))
            if mine.dim() == 4:
                mine[common[0]] = 0.0
            mine[common] = given[common]
        self.load_state_dict(own)
