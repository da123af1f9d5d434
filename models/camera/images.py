"""Images as networks want them."""

from __future__ import annotations

import numpy as np

from .card import ImageSpec

__all__ = ["checked_image", "fit_image"]


def checked_image(image: np.ndarray) -> np.ndarray:
    """The image, if it is one.

    Raises:
        ValueError: It is not of shape (height, width, 3) and uint8, or has no pixels.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or 0 in image.shape:
        raise ValueError(f"image must be uint8 of shape (height, width, 3), BGR, not {image.dtype} of {image.shape}")
    return image


def fit_image(image: np.ndarray, spec: ImageSpec, out: np.ndarray) -> tuple[float, float]:
    """Writes an image into a network's input.

    Args:
        image: Shape (height, width, 3), uint8, BGR.
        spec: Of the card.
        out: Shape (1, 3, H, W), float32: filled.

    Returns:
        Pixels of the input a pixel of the image, across and down.
    """
    import cv2

    height, width = spec.shape[2:]
    rows, columns = image.shape[:2]
    if spec.fit == "letterbox":
        ratio = min(height / rows, width / columns)
        size = (max(1, int(columns * ratio)), max(1, int(rows * ratio)))
        scales = (ratio, ratio)
    else:
        size, scales = (width, height), (width / columns, height / rows)
    small = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    if spec.order == "rgb":
        small = small[:, :, ::-1]
    if size != (width, height):
        out[:] = spec.pad * spec.scale
    np.multiply(small.transpose(2, 0, 1), np.float32(spec.scale), out=out[0, :, : size[1], : size[0]])
    return scales
