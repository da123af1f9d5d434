"""The network of a head's second stage: what the points of a candidate's box say of it.

After PointNet (Qi, Su, Mo, Guibas, CVPR 2017): each point by itself through the same layers, then the highest and the
mean of each channel over the points, whatever their order, and what is known of the box beside them.
"""

from __future__ import annotations

import copy

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
        self.point_scale = torch.tensor(_POINT_SCALE)
        self.box_scale = torch.tensor(_BOX_SCALE + (1.0,) * classes)
        self.is_folded = False

    def forward(self, points: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
        """What is said of each box. Rows of zeros, which are no points, all say one and the same."""
        if self.training:
            highest, mean = self._of_points_there(points, points[:, :, -1] > 0)
        else:
            # Rows of two dimensions, so that ONNX Runtime has the rectifier in the product.
            each = self.points(self._scaled(points, self.point_scale).reshape(-1, len(POINT_CHANNELS)))
            each = each.reshape(-1, points.shape[1], self.width[-1])
            highest, mean = each.amax(1), each.mean(1)
        return self.boxes(torch.cat([highest, mean, self._scaled(boxes, self.box_scale)], 1))

    def _scaled(self, values: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
        return values if self.is_folded else values * scale

    def _of_points_there(self, points: torch.Tensor, there: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The same from the points that there are: two thirds of the rows are none, and a step takes half as long."""
        most, lengths = points.shape[1], there.sum(1)
        each, none = self.points(points[there] * self.point_scale), self.points(points.new_zeros(1, points.shape[2]))
        highest = torch.segment_reduce(each, "max", lengths=lengths, initial=0.0)
        highest = torch.where((lengths < most)[:, None], torch.maximum(highest, none), highest)
        total = torch.segment_reduce(each, "sum", lengths=lengths, initial=0.0)
        return highest, (total + (most - lengths)[:, None] * none) / most

    def folded(self) -> SecondNet:
        """The same in evaluation, with the scales of what it takes in the weights of its first layers."""
        network = copy.deepcopy(self).eval()
        with torch.no_grad():
            network.points[0].weight.mul_(self.point_scale)
            network.boxes[0].weight[:, 2 * self.width[-1] :].mul_(self.box_scale)
        network.is_folded = True
        return network
