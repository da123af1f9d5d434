"""What an object detector makes of a camera's image, without the image: true boxes with misses, errors and false ones.

The chance to be found rises with the height in the image and the share that is visible, as for detectors of road users
(most of those below 15 pixels are missed, nearly all above 50 are found); a box is off by some pixels and some percent
of its size; small objects are taken for others now and then. Errors of one image know nothing of those of the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..classes import CYCLIST, PEDESTRIAN, VEHICLE
from ..geometry import box_corners
from .arguments import check_numbers
from .cameras import Camera
from .frame import SimulatedFrame

__all__ = ["CameraDetections", "CameraDetector"]

_ROAD_USERS = (VEHICLE, PEDESTRIAN, CYCLIST)
_NEAREST = 0.5  # before the camera [m]
_LEAST_PIXELS = 5.0  # of height


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraDetections:
    """The objects that were found in one image."""

    boxes: np.ndarray
    """Left, top, right, bottom [pixels], shape (k, 4), float32."""
    scores: np.ndarray
    """In [0, 1], shape (k,), float32."""
    classes: np.ndarray
    """Indices into `models.classes.CLASSES`, shape (k,), int32."""
    ids: np.ndarray
    """Truth: the object of each, −1 for a false one; shape (k,), int64."""


@dataclass(frozen=True, kw_only=True)
class CameraDetector:
    """How well objects are found in images."""

    half_height: float = 18.0
    """Where half of what is wholly visible is found [pixels]."""
    best: float = 0.97
    """The chance that a large one is found."""
    edge_noise: float = 1.0
    """Standard deviation of an edge [pixels]."""
    size_noise: float = 0.03
    """And besides, of the box's size."""
    confusion: float = 0.25
    """How often one of `half_height` is taken for another class; less in proportion to its height."""
    false_objects: float = 0.3
    """Mean number in an image."""

    def __post_init__(self):
        check_numbers(
            self, above_0=("half_height",), from_0=("edge_noise", "size_noise", "false_objects"),
            shares=("best", "confusion"),
        )  # fmt: skip

    def detect(self, frame: SimulatedFrame, camera: Camera, *, seed: int) -> CameraDetections:
        """What is found of the objects of a frame.

        Args:
            frame: The truth at the time of the exposure; hidden objects are not found, or without points where it does
                not say `visible`.
            camera: Where it looks.
            seed: Of misses, errors and false objects.
        """
        random = np.random.default_rng([seed & 0x7FFFFFFF, 29])
        known = np.flatnonzero(np.isin(frame.classes, _ROAD_USERS))
        shown = frame.visible if frame.visible is not None else (frame.counts > 0).astype(np.float32)
        uvw = box_corners(frame.boxes[known].astype(np.float64)) @ camera.projection[:, :3].T + camera.projection[:, 3]
        before = (uvw[..., 2] > _NEAREST).all(1)
        uv = uvw[..., :2] / np.maximum(uvw[..., 2:], _NEAREST)
        whole = np.concatenate([uv.min(1), uv.max(1)], axis=1)
        edges = np.array([camera.width, camera.height] * 2, np.float64)
        cut = np.clip(whole, 0.0, edges)
        height, inside = cut[:, 3] - cut[:, 1], np.prod(cut[:, 2:] - cut[:, :2], axis=1)
        inside = inside / np.maximum(np.prod(whole[:, 2:] - whole[:, :2], axis=1), 1e-9)
        apparent = np.maximum(height * np.sqrt(shown[known] * inside), 1e-3)
        chance = self.best / (1.0 + (self.half_height / apparent) ** 4)
        seen = before & (height > _LEAST_PIXELS) & (inside > 0.2) & (shown[known] > 0.1)
        seen &= random.random(len(known)) < chance
        box, tall = cut[seen], height[seen]
        size = np.stack([box[:, 2] - box[:, 0], tall] * 2, 1)
        box = box + random.normal(0, 1, box.shape) * np.hypot(self.edge_noise, self.size_noise * size)
        classes = frame.classes[known][seen].copy()
        mistaken = random.random(len(classes)) < self.confusion * np.minimum(self.half_height / tall, 1.0)
        classes[mistaken] = random.choice(_ROAD_USERS, mistaken.sum())
        scores = np.clip(0.25 + 0.7 * chance[seen] + random.normal(0, 0.1, len(box)), 0.05, 0.99)

        false = int(random.poisson(self.false_objects))
        corner = random.uniform([0, 0.3 * camera.height], [camera.width, 0.7 * camera.height], (false, 2))
        extent = random.uniform(10, 60, (false, 2))
        return CameraDetections(
            boxes=np.clip(np.concatenate([box, np.concatenate([corner, corner + extent], 1)]), 0, edges).astype(
                np.float32
            ),
            scores=np.concatenate([scores, random.uniform(0.1, 0.5, false)]).astype(np.float32),
            classes=np.concatenate([classes, random.choice(_ROAD_USERS, false)]).astype(np.int32),
            ids=np.concatenate([frame.ids[known][seen], np.full(false, -1)]).astype(np.int64),
        )
