"""Networks that say of every pixel whether it is of a class, such as TwinLiteNet's drivable area and lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from ...kernels.device import resolve_device
from ..card import load_card
from ..network import Network
from .card import MaskCard
from .images import checked_image, fit_image

__all__ = ["ImageMasks", "MaskHead"]


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageMasks:
    """What each pixel of one image is of."""

    masks: np.ndarray
    """Shape (classes, height, width) of the image, bool."""
    names: tuple[str, ...]
    """The card's classes."""

    def __getitem__(self, name: str) -> np.ndarray:
        return self.masks[self.names.index(name)]


class MaskHead:
    """The network of one card, loaded and bound to its buffers.

    Args:
        card: The card (YAML), its ONNX file beside it.
        device: A Warp device: where the network runs if there is a provider for it.
        threads: CPU threads of the network.
        precision: What it computes in on a GPU.
        providers: Where it may run, the best first.

    Attributes:
        provider: Where the network runs.
        fallback: Empty where that is the first choice; else what is missing.

    Raises:
        ModelError: The card or its model is missing, not valid, or the two do not fit.
    """

    def __init__(
        self,
        card: str | Path,
        *,
        device: str = "cpu",
        threads: int = 2,
        precision: str = "fp32",
        providers: Sequence[str] | None = None,
    ):
        self.card, model = load_card(card, MaskCard)
        self.device = resolve_device(device)
        spec = self.card.input
        self._network = Network(
            model,
            {spec.name: spec.shape},
            {output.name: output.shape for output in self.card.outputs},
            device=self.device,
            threads=threads,
            precision=precision,
            providers=providers,
            classes=self.card.classes,
        )
        self.provider, self.fallback = self._network.provider, self._network.fallback
        self._host = np.zeros(spec.shape, np.float32)
        self._in = wp.array(self._host, dtype=wp.float32, device=self.device, copy=self.device != "cpu")
        self._network.bind_input(spec.name, self._in)
        self._out = []
        for output in self.card.outputs:
            self._out.append(wp.zeros(output.shape, dtype=wp.float32, device=self.device))
            self._network.bind_output(output.name, self._out[-1])

    def detect(self, image: np.ndarray) -> ImageMasks:
        """The masks of an image.

        Args:
            image: Shape (height, width, 3), uint8, BGR as OpenCV reads it.
        """
        import cv2

        image = checked_image(image)
        fit_image(image, self.card.input, self._host)
        if self.device != "cpu":
            self._in.assign(self._host)
        self._network.run()
        size = (image.shape[1], image.shape[0])
        masks = []
        for array in self._out:
            logits = array.numpy()[0]
            small = (logits[1] > logits[0]).astype(np.uint8)
            masks.append(cv2.resize(small, size, interpolation=cv2.INTER_NEAREST).astype(bool))
        return ImageMasks(masks=np.stack(masks), names=self.card.classes)

    def warm_up(self) -> None:
        """Runs once on a grey image."""
        self.detect(np.full((*self.card.input.shape[2:], 3), 114, np.uint8))
