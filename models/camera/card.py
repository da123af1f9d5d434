"""Cards of heads for cameras."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from ..card import MOST_BOXES, CardPart, ModelCard

__all__ = ["BoxReadSpec", "ImageDetectorCard", "ImageSpec", "MaskCard", "TensorName"]


class ImageSpec(CardPart):
    """The network's input, and how an image becomes it."""

    name: str
    shape: tuple[Literal[1], Literal[3], Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
    """1, 3, height, width [pixels]."""
    order: Literal["bgr", "rgb"] = "bgr"
    scale: float = Field(1.0, gt=0)
    """What a channel, 0 to 255, is multiplied by."""
    fit: Literal["letterbox", "stretch"] = "letterbox"
    """Scaled alike in width and height into the top left corner, or each by itself."""
    pad: int = Field(114, ge=0, le=255)
    """What a letterbox is filled up with."""


class TensorName(CardPart):
    """An output of the network."""

    name: str
    shape: tuple[int, ...]


class BoxReadSpec(CardPart):
    """From the output to boxes."""

    score_threshold: float = Field(ge=0, le=1)
    nms_iou: float = Field(gt=0, le=1)
    each_class: bool = False
    """Whether classes are suppressed each by itself."""
    strides: tuple[Annotated[int, Field(ge=1)], ...] = (8, 16, 32)
    """Pixels between neighbouring cells of the grids, in the order of the output."""
    max_objects: int = Field(200, ge=1, le=MOST_BOXES)


class ImageDetectorCard(ModelCard):
    """The card of a detector in images, see `models.camera.detector`."""

    kind: Literal["yolox", "fastestdet"]
    input: ImageSpec
    output: TensorName
    read: BoxReadSpec

    def contradiction(self) -> str:
        """What in it does not fit together."""
        height, width = self.input.shape[2:]
        if any(height % stride or width % stride for stride in self.read.strides):
            return f"read.strides {self.read.strides} do not divide the image of {height} x {width}"
        cells = [(height // stride, width // stride) for stride in self.read.strides]
        channels = 5 + len(self.classes)
        wanted: tuple[int, ...] = (1, sum(rows * columns for rows, columns in cells), channels)
        if self.kind == "fastestdet":
            if len(cells) != 1:
                return "read.strides of a FastestDet are one"
            wanted = (1, channels, *cells[0])
        if self.output.shape != wanted:
            return f"output.shape {self.output.shape} does not follow from input, strides and classes: {wanted}"
        return ""


class MaskCard(ModelCard):
    """The card of a network that says of every pixel whether it is of a class, see `models.camera.masks`."""

    kind: Literal["masks"] = "masks"
    input: ImageSpec
    outputs: tuple[TensorName, ...]
    """Of each class, in their order: logits that it is not, and is; (1, 2, height, width)."""

    def contradiction(self) -> str:
        """What in it does not fit together."""
        wanted = (1, 2, *self.input.shape[2:])
        if self.input.fit != "stretch":
            return f"masks are of whole images: input.fit must be stretch, not {self.input.fit}"
        if len(self.outputs) != len(self.classes):
            return f"there are {len(self.outputs)} outputs, but {len(self.classes)} classes"
        for output in self.outputs:
            if output.shape != wanted:
                return f"the shape of {output.name}, {output.shape}, does not follow from the input: {wanted}"
        return ""
