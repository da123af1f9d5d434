"""Inverse perspective mapping: a camera's image of the ground as seen from above.

Mallot et al., "Inverse perspective mapping simplifies optical flow computation and obstacle detection", 1991. The
ground is taken to be a plane; what stands on it is smeared away from the camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .camera import Camera, borrow_image, camera_model, image_point, is_in_image
from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, family_of, give
from .plan import plan_for

__all__ = ["GroundImage", "InversePerspective", "inverse_perspective"]

# What is in the image must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_FLAT = (0.0, 0.0, 1.0, 0.0)


@wp.struct
class _Ground:
    first: wp.vec3  # the centre of the first cell
    along_row: wp.vec3  # from a row to the next
    along_column: wp.vec3


@wp.kernel
def _sample_ground(
    # in
    image_in: wp.array(dtype=Any),
    width: int,
    height: int,
    channels: int,
    camera: Camera,
    ground: _Ground,
    rounding: float,
    columns: int,
    # out
    ground_out: wp.array(dtype=Any),
    seen_out: wp.array(dtype=wp.bool),
):
    """One cell a thread: what the image says, bilinearly, where the camera sees the cell's centre."""
    cell = wp.tid()
    p = ground.first + float(cell // columns) * ground.along_row + float(cell % columns) * ground.along_column
    pixel = image_point(p, camera)
    seen = is_in_image(pixel, width, height)
    seen_out[cell] = seen
    to = cell * channels
    if not seen:
        for channel in range(channels):
            ground_out[to + channel] = ground_out.dtype(0.0)
        return
    u = wp.clamp(pixel[0], 0.0, float(width - 1))
    v = wp.clamp(pixel[1], 0.0, float(height - 1))
    left = int(u)
    top = int(v)
    # The four pixels about it, of which those past the edge weigh nothing.
    here = (top * width + left) * channels
    right = wp.where(left < width - 1, here + channels, here)
    down = wp.where(top < height - 1, width * channels, 0)
    a = u - float(left)
    b = v - float(top)
    for channel in range(channels):
        above = float(image_in[here + channel])
        above += (float(image_in[right + channel]) - above) * a
        below = float(image_in[here + down + channel])
        below += (float(image_in[right + down + channel]) - below) * a
        ground_out[to + channel] = ground_out.dtype(above + (below - above) * b + rounding)


for _dtype in (wp.uint8, wp.float32):
    wp.overload(_sample_ground, {"image_in": wp.array(dtype=_dtype), "ground_out": wp.array(dtype=_dtype)})


@dataclass(frozen=True, kw_only=True)
class InversePerspective:
    """A plan: draws the ground from a camera's image; `launch` allocates nothing and reads nothing back."""

    bev_range: tuple[float, ...]
    """xmin ymin xmax ymax [m] of the ground that is drawn."""
    shape: tuple[int, int]
    """Rows, along x, and columns, along y."""
    channels: int = 3
    """Channels of the image."""
    plane: tuple[float, ...] = _FLAT
    """a b c d of the ground, a x + b y + c z + d = 0 in the vehicle's frame."""
    dtype: type = wp.uint8
    """Of the image: uint8 or float32."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    ground: wp.array = field(init=False, repr=False, compare=False)
    """Out: the ground, shape (rows, columns, channels), of `dtype`; zero where the camera does not see it."""
    seen: wp.array = field(init=False, repr=False, compare=False)
    """Out: where the camera sees it, shape (rows, columns), bool."""

    def __post_init__(self):
        low, high = self.bev_range[:2], self.bev_range[2:]
        if len(self.bev_range) != 4 or not all(a < b and math.isfinite(b - a) for a, b in zip(low, high, strict=True)):
            raise ValueError(f"bev_range must be xmin ymin xmax ymax, finite, with min < max, not {self.bev_range}")
        if len(self.shape) != 2 or min(self.shape) < 1 or self.shape[0] * self.shape[1] * self.channels > 2**30:
            raise ValueError(
                f"shape must be rows and columns, at least 1 each, at most 2³⁰ numbers in all, not {self.shape}"
            )
        if self.channels < 1:
            raise ValueError(f"channels must be at least 1, not {self.channels}")
        if len(self.plane) != 4 or not all(map(math.isfinite, self.plane)) or self.plane[2] == 0:
            raise ValueError(f"plane must be a b c d, finite, with c other than 0, not {self.plane}")
        if self.dtype not in (wp.uint8, wp.float32):
            raise ValueError(f"dtype must be uint8 or float32, not {self.dtype}")
        device = resolve_device(self.device)
        a, b, c, d = self.plane
        steps = [(high[i] - low[i]) / self.shape[i] for i in (0, 1)]
        x, y = low[0] + steps[0] / 2, low[1] + steps[1] / 2
        ground = _Ground()
        ground.first = wp.vec3(x, y, -(a * x + b * y + d) / c)
        ground.along_row = wp.vec3(steps[0], 0.0, -a * steps[0] / c)
        ground.along_column = wp.vec3(0.0, steps[1], -b * steps[1] / c)
        object.__setattr__(self, "_ground", ground)
        object.__setattr__(self, "ground", wp.zeros((*self.shape, self.channels), dtype=self.dtype, device=device))
        object.__setattr__(self, "seen", wp.zeros(self.shape, dtype=wp.bool, device=device))

    def launch(self, image: wp.array, camera: Camera) -> None:
        """Fills `ground` and `seen`.

        Args:
            image: Shape (height, width, channels), of `dtype`, contiguous.
            camera: From `warploom.kernels.camera.camera_model`, for points in the vehicle's frame.
        """
        self._sample_into(self.ground, self.seen, image, camera)

    def _sample_into(self, ground: wp.array, seen: wp.array, image: wp.array, camera: Camera) -> None:
        if image.ndim != 3 or image.shape[2] != self.channels or image.dtype != self.dtype or not image.is_contiguous:
            raise ValueError(
                f"image must be contiguous {self.dtype.__name__} of shape (height, width, {self.channels}), not "
                f"{image.dtype.__name__} of {image.shape}"
            )
        height, width, channels = image.shape
        if height * width * channels > 2**31 - 1:
            raise ValueError(f"image of shape {image.shape} has more than 2³¹ − 1 numbers")
        rounding = 0.5 if self.dtype == wp.uint8 else 0.0
        wp.launch(
            _sample_ground,
            self.shape[0] * self.shape[1],
            inputs=[image.flatten(), width, height, channels, camera, self._ground, rounding, self.shape[1]],
            outputs=[ground.flatten(), seen.flatten()],
            device=self.device,
        )


@dataclass(frozen=True, eq=False)
class GroundImage:
    """What `inverse_perspective` drew."""

    image: Any
    """The ground, shape (rows, columns) or (rows, columns, channels); zero where the camera does not see it."""
    seen: Any
    """Where the camera sees it, shape (rows, columns), bool."""


def inverse_perspective(
    image: Any,
    intrinsics: Any,
    vehicle_from_camera: Any,
    bev_range: Sequence[float],
    shape: Sequence[int],
    *,
    plane: Sequence[float] = _FLAT,
    distortion: Sequence[float] | None = None,
) -> GroundImage:
    """Draws the ground that a camera sees as from above, bilinearly.

    Rows and columns are those of `bev`: row 0 is at xmin and rows rise with x; column 0 is at ymin and columns rise
    with y.

    Args:
        image: Shape (height, width, channels) or (height, width); uint8 and float32 are taken as they are, other
            numbers as float32.
        intrinsics: The camera's matrix, shape (3, 3) [pixels]; or a projection matrix as KITTI's, shape (3, 4).
        vehicle_from_camera: From the camera's frame (x right, y down, z ahead) to the vehicle's, shape (4, 4).
        bev_range: xmin ymin xmax ymax [m] in the vehicle's frame.
        shape: Rows and columns.
        plane: a b c d of the ground, a x + b y + c z + d = 0 in the vehicle's frame; by default z = 0.
        distortion: OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]; by default none.

    Returns:
        The ground, uint8 (rounded) or float32, and where it is seen, of the family and on the device of `image`.

    Raises:
        TypeError: `image` is no array.
        ValueError: A shape or a number does not fit; the message says which.
    """
    family = family_of(image, "image")
    picture, owner = borrow_image(image)
    pose = np.asarray(vehicle_from_camera, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or abs(np.linalg.det(pose)) < 1e-9:
        raise ValueError(f"vehicle_from_camera must be a finite rigid transform of shape (4, 4), not {pose}")
    camera = camera_model(np.linalg.inv(pose), intrinsics, distortion)
    plan = plan_for(
        InversePerspective,
        bev_range=tuple(float(limit) for limit in bev_range),
        shape=tuple(int(length) for length in shape),
        channels=picture.shape[2],
        plane=tuple(float(number) for number in plane),
        dtype=picture.dtype,
        device=family.device,
    )
    flat = len(image.shape) == 2
    if family.device != DEFAULT_DEVICE:
        plan.launch(picture, camera)
        ground = plan.ground.reshape(plan.shape) if flat else plan.ground
        return GroundImage(give(ground, family), give(plan.seen, family))
    host = np.empty(plan.ground.shape, wp.dtype_to_numpy(plan.dtype))
    seen = np.empty(plan.shape, bool)
    arrays = [
        wp.array(host, dtype=plan.dtype, copy=False, device=DEFAULT_DEVICE),
        wp.array(seen, dtype=wp.bool, copy=False, device=DEFAULT_DEVICE),
    ]
    plan._sample_into(*arrays, picture, camera)
    del owner
    return GroundImage(adopt(host.reshape(plan.shape) if flat else host, family), adopt(seen, family))
