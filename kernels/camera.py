"""The pinhole camera with OpenCV's distortion: what projection, painting and inverse perspective mapping share.

Pixels are OpenCV's: integers are centres of pixels, so that an image reaches from −0.5 to its size less 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from . import device as _device  # noqa: F401  (starts Warp)
from .arguments import table
from .interop import borrow, family_of

__all__ = ["Camera", "borrow_image", "camera_model", "image_point", "is_in_image"]

_COEFFICIENTS = (0, 4, 5, 8)
_WIDEST = 20.0  # tangent of the angle to the axis up to which a fold of the distortion is looked for


@wp.struct
class Camera:
    """Numbers of a camera for kernels; `camera_model` makes it."""

    rotation: wp.mat33
    translation: wp.vec3
    focal: wp.vec2
    skew: float
    centre: wp.vec2
    radial: wp.vec3
    radial_below: wp.vec3  # of the denominator
    tangential: wp.vec2
    is_distorted: int
    widest_squared: float


def camera_model(camera_from_points: Any, intrinsics: Any, distortion: Sequence[float] | None = None) -> Camera:
    """What kernels need of a camera; for the same numbers the same object, to be read only.

    Args:
        camera_from_points: From the frame of the points to the camera's (x right, y down, z ahead), shape (4, 4).
        intrinsics: Shape (3, 3): focal lengths, skew and centre [pixels]; or (3, 4), a projection matrix as KITTI's,
            whose fourth column moves the camera.
        distortion: OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]; None for none.

    Raises:
        ValueError: A shape or a number does not fit; the message says which.
    """
    pose, matrix = table(camera_from_points, "camera_from_points"), table(intrinsics, "intrinsics")
    numbers = np.zeros(0) if distortion is None else table(distortion, "distortion").ravel()
    return _camera(pose.shape, pose.tobytes(), matrix.shape, matrix.tobytes(), numbers.tobytes())


@lru_cache(maxsize=64)  # cameras seldom change
def _camera(pose_shape: tuple, pose_bytes: bytes, matrix_shape: tuple, matrix_bytes: bytes, numbers: bytes) -> Camera:
    pose = np.frombuffer(pose_bytes).reshape(pose_shape)
    matrix = np.frombuffer(matrix_bytes).reshape(matrix_shape)
    distortion = np.frombuffer(numbers)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise ValueError(f"camera_from_… must be a finite transform of shape (4, 4) with last row 0 0 0 1, not {pose}")
    turn = pose[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3:
        raise ValueError(f"camera_from_… must be rigid, its upper left 3 × 3 part a rotation, not {turn.tolist()}")
    if matrix.shape not in ((3, 3), (3, 4)) or not np.isfinite(matrix).all():
        raise ValueError(f"intrinsics must be finite, of shape (3, 3) or (3, 4), not {matrix}")
    below = np.abs([*matrix[1:, 0], matrix[2, 1], matrix[2, 2] - 1]).max()
    if below > 1e-9 or not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise ValueError(
            f"intrinsics must be upper triangular with positive focal lengths and last row 0 0 1, not {matrix.tolist()}"
        )
    if len(distortion) not in _COEFFICIENTS or not np.isfinite(distortion).all():
        raise ValueError(f"distortion must be 4, 5 or 8 finite numbers, k1 k2 p1 p2 [k3 [k4 k5 k6]], not {distortion}")
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(distortion, (0, 8 - len(distortion)))
    moved = np.linalg.solve(matrix[:, :3], matrix[:, 3]) if matrix.shape[1] == 4 else np.zeros(3)
    camera = Camera()
    camera.rotation = wp.mat33(*turn.ravel())
    camera.translation = wp.vec3(*(pose[:3, 3] + moved))
    camera.focal = wp.vec2(matrix[0, 0], matrix[1, 1])
    camera.skew = matrix[0, 1]
    camera.centre = wp.vec2(matrix[0, 2], matrix[1, 2])
    camera.radial, camera.radial_below = wp.vec3(k1, k2, k3), wp.vec3(k4, k5, k6)
    camera.tangential = wp.vec2(p1, p2)
    camera.is_distorted = int(distortion.any())
    camera.widest_squared = _fold((k1, k2, k3), (k4, k5, k6)) ** 2 if camera.is_distorted else np.inf
    return camera


@lru_cache(maxsize=64)
def _fold(radial: tuple[float, float, float], radial_below: tuple[float, float, float]) -> float:
    """The tangent of the angle to the axis at which a radial distortion begins to fold the image onto itself."""
    r = np.linspace(0, _WIDEST, 20_001)
    denominator = np.polyval([*radial_below[::-1], 1.0], r * r)
    rising = np.diff(r * np.polyval([*radial[::-1], 1.0], r * r) / np.where(denominator == 0, np.nan, denominator)) > 0
    rising &= denominator[1:] > 0
    return np.inf if rising.all() else float(r[np.argmin(rising)])


def borrow_image(image: Any) -> tuple[wp.array, Any]:
    """Views an image as a Warp array of shape (height, width, channels), uint8 or float32; and what owns it."""
    family_of(image, "image")
    if len(image.shape) not in (2, 3) or min(image.shape) < 1:
        raise ValueError(f"image must have shape (height, width) or (height, width, channels), not {image.shape}")
    kind = wp.uint8 if "uint8" in str(image.dtype) else wp.float32
    picture, owner = borrow(image, kind, (None,) * len(image.shape), "image")
    return (picture if picture.ndim == 3 else picture.reshape((*picture.shape, 1))), (owner, picture)


@wp.func
def image_point(p: wp.vec3, camera: Camera) -> wp.vec3:
    """Pixel u v and depth [m]; NaN for the pixel of what is not ahead of the camera, or where its lens folds."""
    c = camera.rotation * p + camera.translation
    nowhere = float(wp.nan)
    u = nowhere
    v = nowhere
    if c[2] > 0.0:
        x = c[0] / c[2]
        y = c[1] / c[2]
        seen = bool(True)
        if camera.is_distorted != 0:
            s = x * x + y * y
            seen = s < camera.widest_squared
            a = camera.radial
            b = camera.radial_below
            t = camera.tangential
            scale = 1.0 + s * (a[0] + s * (a[1] + s * a[2]))
            scale = scale / (1.0 + s * (b[0] + s * (b[1] + s * b[2])))
            twice = 2.0 * x * y
            straight_x = x
            x = x * scale + t[0] * twice + t[1] * (s + 2.0 * x * x)
            y = y * scale + t[0] * (s + 2.0 * y * y) + t[1] * (2.0 * straight_x * y)
        if seen:
            u = camera.focal[0] * x + camera.skew * y + camera.centre[0]
            v = camera.focal[1] * y + camera.centre[1]
    return wp.vec3(u, v, c[2])


@wp.func
def is_in_image(pixel: wp.vec3, width: int, height: int) -> bool:
    """Whether a point is seen on a pixel of the image; false for NaN."""
    return pixel[0] >= -0.5 and pixel[1] >= -0.5 and pixel[0] < float(width) - 0.5 and pixel[1] < float(height) - 0.5
