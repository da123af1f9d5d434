"""PointPillars with anchors, as OpenPCDet and mmdetection3d (1.0 and later) train it, as a head of ours.

What a state dict does not say (range, pillars, anchors, thresholds) is said by a `PointPillarsSpec`, whose defaults are
KITTI's three-class configuration. The network is taken as both write it: pillar features of a point (its columns, its
place about the mean of its pillar's points and about the pillar's centre), one linear layer with batch norm, the
greatest over the points of a pillar with the padding among them; blocks of convolutions, deconvolutions of each to one
size, side by side; three convolutions for scores, residuals and directions.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch  # noqa: TID253 (nothing but an import loads this module)
import yaml
from pydantic import TypeAdapter, ValidationError
from torch import nn  # noqa: TID253

from ...errors import ModelError
from ..anchor_card import AnchorCard, AnchorSpec, PillarSpec, ReadSpec
from ..card import said_errors
from .checkpoint import load_tensors, read_state_dict, shape_error, write_head

__all__ = ["PointPillarsNet", "PointPillarsSpec", "import_pointpillars"]

_EPS = 1e-3


@dataclass(frozen=True, kw_only=True)
class PointPillarsSpec:
    """What a configuration file of OpenPCDet or mmdetection3d says beside the weights; KITTI's by default."""

    pillars: PillarSpec = field(
        default_factory=lambda: PillarSpec(point_range=(0.0, -39.68, -3.0, 69.12, 39.68, 1.0), pillar=(0.16, 0.16, 4.0))
    )
    classes: tuple[str, ...] = ("vehicle", "pedestrian", "cyclist")
    """Of ours, in the order of the network."""
    anchors: tuple[AnchorSpec, ...] = (
        AnchorSpec(size=(3.9, 1.6, 1.56), bottom=-1.78),
        AnchorSpec(size=(0.8, 0.6, 1.73), bottom=-0.6),
        AnchorSpec(size=(1.76, 0.6, 1.73), bottom=-0.6),
    )
    read: ReadSpec = field(default_factory=ReadSpec)
    strides: tuple[int, ...] = (2, 2, 2)
    """Of the first convolution of each block, which the weights do not show."""
    absolute_places: bool = True
    """Whether the network sees where points are. mmdetection3d's `legacy` pillars (its default) overwrite that with
    places about the pillar's centre: then False."""

    @classmethod
    def read_file(cls, path: str | Path) -> PointPillarsSpec:
        """Reads a YAML file with any of the fields; those left out are KITTI's.

        Raises:
            ModelError: It cannot be read, or a field is not valid.
        """
        try:
            content = yaml.safe_load(Path(path).read_text("utf-8")) or {}
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise ModelError(f"{path}: cannot read the configuration: {error}") from error
        known = cls.__dataclass_fields__
        if not isinstance(content, Mapping) or set(content) - set(known):
            raise ModelError(f"{path}: expected some of {', '.join(known)}, got {content!r}")
        try:
            return TypeAdapter(cls).validate_python(dict(content))
        except ValidationError as error:
            raise ModelError(f"{path}: {said_errors(error)}") from error


class _PillarFeatures(nn.Module):
    """Features of pillars from their points."""

    def __init__(self, spec: PointPillarsSpec, inputs: int, outputs: int):
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs, eps=_EPS)
        pillars = spec.pillars
        self.flat = inputs == pillars.features + 5
        self.absolute = spec.absolute_places
        self.trained_height = pillars.sensor_height
        half = [0.5 * edge + low for edge, low in zip(pillars.pillar, pillars.point_range[:3], strict=True)]
        self.register_buffer("edges", torch.tensor(pillars.pillar), persistent=False)
        self.register_buffer("first_centre", torch.tensor(half), persistent=False)

    def forward(self, points, counts, cells, sensor_height):
        there = (torch.arange(points.shape[1])[None] < counts[:, None]).unsqueeze(2).to(points.dtype)
        lift = (sensor_height - self.trained_height).reshape(1, 1, 1)
        xyz = torch.cat([points[:, :, :2], (points[:, :, 2:3] + lift)], dim=2) * there
        mean = xyz.sum(dim=1, keepdim=True) / counts.to(points.dtype).clamp(min=1).reshape(-1, 1, 1)
        centre = cells[:, [2, 1, 0]].to(points.dtype) * self.edges + self.first_centre
        about_centre = xyz - centre[:, None]
        if self.flat:
            about_centre = about_centre[:, :, :2]
        own = xyz
        if not self.absolute:
            own = about_centre if not self.flat else torch.cat([about_centre, xyz[:, :, 2:3]], dim=2)
        features = torch.cat([own, points[:, :, 3:], xyz - mean, about_centre], dim=2) * there
        # With the channels last, batch norm over (pillars, points) is that over a table of both.
        weight = self.norm.weight / torch.sqrt(self.norm.running_var + self.norm.eps)
        scaled = self.linear(features) * weight + (self.norm.bias - self.norm.running_mean * weight)
        return torch.relu(scaled).max(dim=1).values


def _block(inputs: int, outputs: int, stride: int, layers: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for layer in range(layers):
        convolution = nn.Conv2d(
            inputs if layer == 0 else outputs, outputs, 3, stride if layer == 0 else 1, 1, bias=False
        )
        parts += [convolution, nn.BatchNorm2d(outputs, eps=_EPS), nn.ReLU()]
    return nn.Sequential(*parts)


class PointPillarsNet(nn.Module):
    """Pillars to maps; `AnchorCard` says the shapes.

    Args:
        spec: What the weights do not show.
        inputs: Columns of a point's features: its own, three about the mean, three or two about the centre.
        width: Of the pillar features.
        blocks: Channels and convolutions of each block.
        ups: Channels and stride of each deconvolution.
    """

    def __init__(
        self,
        spec: PointPillarsSpec,
        *,
        inputs: int = 10,
        width: int = 64,
        blocks: tuple[tuple[int, int], ...] = ((64, 4), (128, 6), (256, 6)),
        ups: tuple[tuple[int, int], ...] = ((128, 1), (128, 2), (128, 4)),
    ):
        super().__init__()
        self.columns, self.rows = spec.pillars.cells
        self.width = width
        self.pillar_features = _PillarFeatures(spec, inputs, width)
        before = [width, *(channels for channels, _ in blocks)]
        self.blocks = nn.ModuleList(
            _block(before[k], channels, spec.strides[k], layers) for k, (channels, layers) in enumerate(blocks)
        )
        self.ups = nn.ModuleList(
            nn.Sequential(
                nn.ConvTranspose2d(blocks[k][0], channels, stride, stride, bias=False),
                nn.BatchNorm2d(channels, eps=_EPS),
                nn.ReLU(),
            )
            for k, (channels, stride) in enumerate(ups)
        )
        together = sum(channels for channels, _ in ups)
        count = sum(len(anchor.yaws) for anchor in spec.anchors)
        self.scores = nn.Conv2d(together, count * len(spec.classes), 1)
        self.residuals = nn.Conv2d(together, count * 7, 1)
        self.directions = nn.Conv2d(together, count * 2, 1)

    def forward(self, points, counts, cells, pillars, sensor_height):
        """Scores, residuals and directions of every anchor."""
        features = self.pillar_features(points, counts, cells, sensor_height)
        place = cells[:, 1].long() * self.columns + cells[:, 2].long()
        # What lies beyond the pillars there are goes to a cell of its own, which is cut off.
        beyond = torch.full_like(place, self.rows * self.columns)
        place = torch.where(torch.arange(place.shape[0]) < pillars, place, beyond)
        canvas = torch.zeros(self.width, self.rows * self.columns + 1)
        canvas = canvas.scatter(1, place[None].expand(self.width, -1), features.t())
        x = canvas[:, :-1].reshape(1, self.width, self.rows, self.columns)
        sides = []
        for block, up in zip(self.blocks, self.ups, strict=True):
            x = block(x)
            sides.append(up(x))
        x = torch.cat(sides, dim=1)
        return self.scores(x), self.residuals(x), self.directions(x)


_NAMES = (  # ours, OpenPCDet's, mmdetection3d's
    ("pillar_features.linear.", r"vfe\.pfn_layers\.0\.linear\.", r"(pts_)?voxel_encoder\.pfn_layers\.0\.linear\."),
    ("pillar_features.norm.", r"vfe\.pfn_layers\.0\.norm\.", r"(pts_)?voxel_encoder\.pfn_layers\.0\.norm\."),
    ("blocks.", r"backbone_2d\.blocks\.", r"(pts_)?backbone\.blocks\."),
    ("ups.", r"backbone_2d\.deblocks\.", r"(pts_)?neck\.deblocks\."),
    ("scores.", r"dense_head\.conv_cls\.", r"(pts_)?bbox_head\.conv_cls\."),
    ("residuals.", r"dense_head\.conv_box\.", r"(pts_)?bbox_head\.conv_reg\."),
    ("directions.", r"dense_head\.conv_dir_cls\.", r"(pts_)?bbox_head\.conv_dir_cls\."),
)
_BUFFERS = ("global_step", "dense_head.anchors", "vfe.voxel_size")


def _renamed(tensors: Mapping[str, torch.Tensor], path: str | Path) -> tuple[dict[str, torch.Tensor], str]:
    """The tensors under our names, and whose they were."""
    for column, whose in ((1, "OpenPCDet"), (2, "mmdetection3d")):
        renamed = {}
        for name, value in tensors.items():
            if name in _BUFFERS:
                continue
            for row in _NAMES:
                if match := re.match(row[column], name):
                    renamed[row[0] + name[match.end() :]] = value
                    break
            else:
                renamed[name] = value
        if "pillar_features.linear.weight" in renamed and "scores.weight" in renamed:
            if whose == "OpenPCDet":
                # Its blocks begin with a padding of their own, which shifts the numbers of what follows by one.
                pattern = re.compile(r"blocks\.(\d+)\.(\d+)\.")
                renamed = {
                    pattern.sub(lambda m: f"blocks.{m[1]}.{int(m[2]) - 1}.", name): value
                    for name, value in renamed.items()
                }
            return renamed, whose
    known = "vfe.pfn_layers.0.linear.weight … dense_head.conv_cls.weight, or voxel_encoder… bbox_head…"
    raise ModelError(f"{path}: not PointPillars with anchors of OpenPCDet or mmdetection3d, whose names are {known}")


def _measured(tensors: Mapping[str, torch.Tensor], spec: PointPillarsSpec, path: str | Path) -> PointPillarsNet:
    """The network whose widths and depths the tensors show."""

    def shape(name: str) -> tuple[int, ...]:
        if name not in tensors:
            raise ModelError(f"{path}: this is not PointPillars: it lacks {name}")
        return tuple(tensors[name].shape)

    width, inputs = shape("pillar_features.linear.weight")
    wanted = [spec.pillars.features + 6, spec.pillars.features + 5]
    if inputs not in wanted:
        raise ModelError(
            f"{path}: its points have {inputs} features, but {spec.pillars.features} columns give {wanted[0]} or "
            f"{wanted[1]}; is pillars.features right?"
        )
    blocks, ups = [], []
    for k in range(len(spec.strides)):
        layers = sum(1 for name in tensors if re.fullmatch(rf"blocks\.{k}\.\d+\.weight", name)) // 2
        if layers == 0:
            raise ModelError(f"{path}: it has {k} blocks, but strides say {len(spec.strides)}")
        blocks.append((shape(f"blocks.{k}.0.weight")[0], layers))
        up = shape(f"ups.{k}.0.weight")
        if len(up) != 4 or up[0] != blocks[-1][0] or up[2] != up[3]:
            raise shape_error(path, f"ups.{k}.0.weight", up, (blocks[-1][0], up[1] if len(up) > 1 else 0, "s", "s"))  # type: ignore[list-item]
        ups.append((up[1], up[2]))
    whole = int(np.prod(spec.strides[:1])) // ups[0][1]
    if whole != spec.read.stride:
        raise ModelError(f"{path}: its maps have a stride of {whole} pillars, but read.stride is {spec.read.stride}")
    return PointPillarsNet(spec, inputs=inputs, width=width, blocks=tuple(blocks), ups=tuple(ups))


def import_pointpillars(
    checkpoint: str | Path,
    folder: str | Path,
    *,
    spec: PointPillarsSpec | None = None,
    name: str = "pointpillars",
    licence: str = "as the checkpoint's",
) -> Path:
    """Makes a head of a checkpoint: `NAME.onnx` and `NAME.yaml`.

    Args:
        checkpoint: Of OpenPCDet or mmdetection3d ≥ 1.0, `.pth`.
        folder: Where the two files go.
        spec: What the weights do not say; None is KITTI's three classes.
        name: Of the head.
        licence: Of the weights, for the card.

    Returns:
        The path of the card, which `AnchorHead` takes.

    Raises:
        ModelError: The checkpoint cannot be read, or is not of such a network.
    """
    spec = spec or PointPillarsSpec()
    tensors, whose = _renamed(read_state_dict(checkpoint), checkpoint)
    network = _measured(tensors, spec, checkpoint)
    load_tensors(network, tensors, checkpoint, f"PointPillars of {whose} with these anchors")
    pillars = spec.pillars
    example = {
        "points": np.zeros((8, pillars.max_points, pillars.features), np.float32),
        "counts": np.ones(8, np.int32),
        "cells": np.stack([np.zeros(8), np.zeros(8), np.arange(8)], axis=1).astype(np.int32),
        "pillars": np.array([8], np.int32),
        "sensor_height": np.array([pillars.sensor_height], np.float32),
    }
    return write_head(
        network,
        example,
        ("scores", "residuals", "directions"),
        Path(folder),
        AnchorCard,
        {
            "name": name,
            "description": f"PointPillars with anchors, imported from a checkpoint of {whose}.",
            "classes": spec.classes,
            "pillars": pillars,
            "anchors": spec.anchors,
            "read": spec.read,
            "training": {"imported_from": Path(checkpoint).name, "framework": whose},
            "measured": {},
            "licence": licence,
        },
        free={"points": {0: "pillars_there"}, "counts": {0: "pillars_there"}, "cells": {0: "pillars_there"}},
    )
