"""The network of a head's second stage: what the points of a candidate's box say of it.

After PointNet (Qi, Su, Mo, Guibas, CVPR 2017): each point by itself through the same layers, then the highest and the
mean of each channel over the points, whatever their order, and what is known of the box beside them.
"""

from __future__ import annotations

import torch
from torch import nn

from ...kernels.box_points import BOX_CHANNELS, POINT_CHANNELS
from ...kernels.box_rescore import RESIDUALS

__all__ = ["SecondNet"]

# Metres and logarithms, brought to about one.
_POINT_SCALE = (0.5, 1.0, 1.0, 0.3, 0.3, 0.7, 0.7, 0.7, 0.7, 0.7, 1.0)
_BOX_SCALE = (1.0, 1.0, 1.0, 0.4, 0.3, 1.0, 1.0, 1.0, 2.0)


class SecondNet(nn.Module):
    """Points (n, p, 11) and boxes (n, 9 + classes), as `kernels.box_points` has them, to (n, 1 + classes + 1 + 7).

    What it says is what `kernels.box_rescore` reads: logits of nothing and of the classes, of the overlap, residuals.

    Args:
        classes: How many.
        width: Channels of the three layers of the points.
        hidden: Channels of the two layers after them.
    """

    def __init__(
        self, classes: int = 5, width: tuple[int, int, int] = (32, 64, 128), hidden: tuple[int, int] = (128, 64)
    ):
        super().__init__()
        self.classes, self.width, self.hidden = classes, width, hidden
        layers, inputs = [], len(POINT_CHANNELS)
        for outputs in width:
            layers += [nn.Linear(inputs, outputs), nn.ReLU()]
            inputs = outputs
        self.points = nn.Sequential(*layers)
        inputs = 2 * width[-1] + len(BOX_CHANNELS) + classes
        layers = []
        for outputs in hidden:
            layers += [nn.Linear(inputs, outputs), nn.ReLU()]
            inputs = outputs
        self.boxes = nn.Sequential(*layers, nn.Linear(inputs, 2 + classes + len(RESIDUALS)))
        self.register_buffer("point_scale", torch.tensor(_POINT_SCALE), persistent=False)
        self.register_buffer("box_scale", torch.tensor(_BOX_SCALE + (1.0,) * classes), persistent=False)

    def forward(self, points: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
        """What is said of each box."""
        there = points[:, :, -1:]
        if self.training:
            highest, mean = self._of_points_there(points, there[:, :, 0] > 0)
        else:
            # Rows of two dimensions, so that ONNX Runtime has the rectifier in the product.
            rows = (points * self.point_scale).reshape(-1, len(POINT_CHANNELS))
            each = self.points(rows).reshape(-1, points.shape[1], self.width[-1]) * there
            # No channel is below zero, so that a missing point's zeros are never the highest for want of another.
            highest = each.amax(1)
            mean = each.sum(1) / there.sum(1).clamp(min=1.0)
        return self.boxes(torch.cat([highest, mean, boxes * self.box_scale], 1))

    def _of_points_there(self, points: torch.Tensor, there: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The same from the points that there are: two thirds of the rows are none, and a step takes half as long."""
        each, lengths = self.points(points[there] * self.point_scale), there.sum(1)
        highest = torch.segment_reduce(each, "max", lengths=lengths, initial=0.0)
        total = torch.segment_reduce(each, "sum", lengths=lengths, initial=0.0)
        return highest, total / lengths.clamp(min=1)[:, None]
