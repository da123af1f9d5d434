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

from .arguments import reals, table, wholes
from .camera import Camera, borrow_image, camera_model, image_point, is_in_image
from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, family_of, give
from .inverse_perspective_parts import Bytes, Weights, sample_parts
from .plan import plan_for
from .threads import PackedLaunch, thread_count

__all__ = ["GroundImage", "InversePerspective", "inverse_perspective"]

# What is in the image must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_FLAT = (0.0, 0.0, 1.0, 0.0)
_UNSEEN = wp.constant(-1)
_WHOLE = wp.constant(8192)  # what the weights of four pixels add up to, as in inverse_perspective_parts.py
_LEAST_OF_PART = 16_384  # cells for which a thread of their own is worth its while


@wp.struct
class _Ground:
    first: wp.vec3  # the centre of the first cell
    along_row: wp.vec3  # from a row to the next
    along_column: wp.vec3


@wp.kernel
def _find_pixels(
    # in
    camera: Camera,
    ground: _Ground,
    width: int,
    height: int,
    columns: int,
    # out
    place_out: wp.array(dtype=wp.int32),
    share_out: wp.array(dtype=wp.vec2),
    weights_out: wp.array(dtype=Weights),
    seen_out: wp.array(dtype=wp.bool),
):
    """Per cell the upper left of the four pixels about its centre, and how far it is towards the lower right.

    For three bytes a pixel the weights of the four, whole numbers, whose sum is `_WHOLE` where the cell is seen.
    """
    cell = wp.tid()
    p = ground.first + float(cell // columns) * ground.along_row + float(cell % columns) * ground.along_column
    pixel = image_point(p, camera)
    seen = is_in_image(pixel, width, height)
    place = int(_UNSEEN)
    a = float(0.0)
    b = float(0.0)
    if seen:
        u = wp.clamp(pixel[0], 0.0, float(width - 1))
        v = wp.clamp(pixel[1], 0.0, float(height - 1))
        # The last row and column are reached from those before them.
        left = wp.max(wp.min(int(u), width - 2), 0)
        top = wp.max(wp.min(int(v), height - 2), 0)
        place = top * width + left
        a = u - float(left)
        b = v - float(top)
    seen_out[cell] = seen
    if weights_out:
        place_out[cell] = wp.max(place, 0)
        whole = wp.where(seen, _WHOLE, 0)
        # Rounded one after the other, so that they add up.
        below = int(float(whole) * b + 0.5)
        above_right = int(float(whole - below) * a + 0.5)
        below_right = int(float(below) * a + 0.5)
        weights_out[cell] = Weights(
            wp.uint16(whole - below - above_right),
            wp.uint16(above_right),
            wp.uint16(below - below_right),
            wp.uint16(below_right),
        )
    else:
        place_out[cell] = place
        share_out[cell] = wp.vec2(a, b)


@wp.kernel
def _sample_three_bytes(
    # in
    image_in: wp.array(dtype=Bytes),
    place_in: wp.array(dtype=wp.int32),
    weights_in: wp.array(dtype=Weights),
    right: int,
    down: int,
    # out
    ground_out: wp.array(dtype=Bytes),
):
    """One cell a thread, for the images that most cameras give."""
    cell = wp.tid()
    place = place_in[cell]
    weights = weights_in[cell]
    p = image_in[place]
    q = image_in[place + right]
    r = image_in[place + down]
    s = image_in[place + down + right]
    value = Bytes()
    for channel in range(3):
        total = int(p[channel]) * int(weights[0]) + int(q[channel]) * int(weights[1])
        total += int(r[channel]) * int(weights[2]) + int(s[channel]) * int(weights[3])
        value[channel] = wp.uint8((total + _WHOLE / 2) / _WHOLE)
    ground_out[cell] = value


@wp.kernel
def _sample(
    # in
    image_in: wp.array2d(dtype=Any),
    place_in: wp.array(dtype=wp.int32),
    share_in: wp.array(dtype=wp.vec2),
    right: int,
    down: int,
    rounding: float,
    # out
    ground_out: wp.array2d(dtype=Any),
):
    """One cell a thread, for images of any channels."""
    cell = wp.tid()
    place = place_in[cell]
    if place == _UNSEEN:
        for channel in range(image_in.shape[1]):
            ground_out[cell, channel] = ground_out.dtype(0.0)
        return
    a = share_in[cell][0]
    b = share_in[cell][1]
    for channel in range(image_in.shape[1]):
        above = float(image_in[place, channel]) * (1.0 - a) + float(image_in[place + right, channel]) * a
        below = float(image_in[place + down, channel]) * (1.0 - a) + float(image_in[place + down + right, channel]) * a
        ground_out[cell, channel] = ground_out.dtype(above * (1.0 - b) + below * b + rounding)


for _dtype in (wp.uint8, wp.float32):
    wp.overload(_sample, {"image_in": wp.array2d(dtype=_dtype), "ground_out": wp.array2d(dtype=_dtype)})


@dataclass(frozen=True, kw_only=True)
class InversePerspective:
    """A plan: `set_camera` finds the pixel of each cell of the ground, `launch` draws the ground from an image.

    Both allocate nothing and read nothing back.
    """

    image_size: tuple[int, int]
    """Width and height [pixels]."""
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
        if len(self.image_size) != 2 or min(self.image_size) < 1:
            raise ValueError(f"image_size must be width and height, at least 1 pixel each, not {self.image_size}")
        if self.image_size[0] * self.image_size[1] * self.channels > 2**31 - 1:
            raise ValueError(f"image_size {self.image_size} with {self.channels} channels is more than 2³¹ − 1 numbers")
        low, high = self.bev_range[:2], self.bev_range[2:]
        if len(self.bev_range) != 4 or not all(a < b and math.isfinite(b - a) for a, b in zip(low, high, strict=True)):
            raise ValueError(f"bev_range must be xmin ymin xmax ymax, finite, with min < max, not {self.bev_range}")
        if len(self.shape) != 2 or min(self.shape) < 1 or self.shape[0] * self.shape[1] * self.channels > 2**30:
            raise ValueError(
                f"shape must be rows and columns, at least 1 each, at most 2³⁰ numbers in all, not {self.shape}"
            )
        if not 1 <= self.channels < 2**31:
            raise ValueError(f"channels must be at least 1 and below 2³¹, not {self.channels}")
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
        cells = self.shape[0] * self.shape[1]
        width, height = self.image_size

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("_ground", ground)
        keep("_drawn_for", None)
        three_bytes = self.channels == 3 and self.dtype == wp.uint8
        keep("_place", wp.full(cells, 0 if three_bytes else _UNSEEN, dtype=wp.int32, device=device))
        keep("_share", None if three_bytes else wp.zeros(cells, dtype=wp.vec2, device=device))
        keep("_weights", wp.zeros(cells, dtype=Weights, device=device) if three_bytes else None)
        packed = None
        if three_bytes and width * height >= 3 and _in_parts(device):
            parts = max(1, min(thread_count(), cells // _LEAST_OF_PART))
            down = width * min(height - 1, 1)
            packed = PackedLaunch(sample_parts, parts, [None, self._place, self._weights, down], [None])
        keep("_packed", packed)
        keep("ground", wp.zeros((*self.shape, self.channels), dtype=self.dtype, device=device))
        keep("seen", wp.zeros(self.shape, dtype=wp.bool, device=device))

    def set_camera(self, camera: Camera) -> None:
        """Finds the pixels of the cells, and fills `seen`.

        Args:
            camera: From `warploom.kernels.camera.camera_model`, for points in the vehicle's frame.
        """
        wp.launch(
            _find_pixels,
            self.shape[0] * self.shape[1],
            inputs=[camera, self._ground, *self.image_size, self.shape[1]],
            outputs=[self._place, self._share, self._weights, self.seen.flatten()],
            device=self.device,
        )

    def launch(self, image: wp.array) -> None:
        """Fills `ground`; before the first `set_camera`, with zeros.

        Args:
            image: Shape (height, width, channels), of `dtype`, contiguous.
        """
        self._sample_into(self.ground, image)

    def _sample_into(self, ground: wp.array, image: wp.array) -> None:
        width, height = self.image_size
        wanted = (height, width, self.channels)
        if tuple(image.shape) != wanted or image.dtype != self.dtype or not image.is_contiguous:
            raise ValueError(
                f"image must be contiguous {self.dtype.__name__} of shape {wanted}, not {image.dtype.__name__} of "
                f"{image.shape}"
            )
        # A picture of one row or column has no neighbours there.
        steps = [min(width - 1, 1), width * min(height - 1, 1)]
        cells = self._place.shape[0]
        if self._weights is not None:
            flat, drawn = _as_pixels(image), _as_pixels(ground)
            if self._packed is not None:
                self._packed.launch(image_in=flat, ground_out=drawn)
            else:
                inputs = [flat, self._place, self._weights, *steps]
                wp.launch(_sample_three_bytes, cells, inputs=inputs, outputs=[drawn], device=self.device)
        else:
            flat, drawn = (array.reshape((-1, self.channels)) for array in (image, ground))
            rounding = 0.5 if self.dtype == wp.uint8 else 0.0
            inputs = [flat, self._place, self._share, *steps, rounding]
            wp.launch(_sample, cells, inputs=inputs, outputs=[drawn], device=self.device)


def _in_parts(device: str) -> bool:
    """Whether few threads do much each, as suits a CPU, or many little."""
    return resolve_device(device) == DEFAULT_DEVICE


def _as_pixels(image: wp.array) -> wp.array:
    """A view of an image of three bytes a pixel as an array of pixels."""
    return wp.array(ptr=image.ptr, dtype=Bytes, shape=image.shape[0] * image.shape[1], device=image.device)


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
        The ground, uint8 (within 0.6 of what the pixels found give) or float32, and where it is seen, of the family
        and on the device of `image`.

    Raises:
        TypeError: `image` is no array.
        ValueError: A shape or a number does not fit; the message says which.
    """
    family = family_of(image, "image")
    picture, owner = borrow_image(image)
    pose = table(vehicle_from_camera, "vehicle_from_camera")
    plan = plan_for(
        InversePerspective,
        image_size=(picture.shape[1], picture.shape[0]),
        bev_range=reals(bev_range, "bev_range"),
        shape=wholes(shape, "shape"),
        channels=picture.shape[2],
        plane=reals(plane, "plane"),
        dtype=picture.dtype,
        device=family.device,
    )
    # Cameras and planes seldom move: the pixels found last time mostly do.
    lens = None if distortion is None else table(distortion, "distortion").tolist()
    drawn_for = repr((pose.tolist(), table(intrinsics, "intrinsics").tolist(), lens))
    if drawn_for != plan._drawn_for:
        if pose.shape != (4, 4) or not np.isfinite(pose).all() or abs(np.linalg.det(pose)) < 1e-9:
            raise ValueError(f"vehicle_from_camera must be a finite rigid transform of shape (4, 4), not {pose}")
        plan.set_camera(camera_model(np.linalg.inv(pose), intrinsics, distortion))
        object.__setattr__(plan, "_drawn_for", drawn_for)
    flat = len(image.shape) == 2
    if family.device != DEFAULT_DEVICE:
        plan.launch(picture)
        ground = plan.ground.reshape(plan.shape) if flat else plan.ground
        return GroundImage(give(ground, family), give(plan.seen, family))
    host = np.empty(plan.ground.shape, wp.dtype_to_numpy(plan.dtype))
    plan._sample_into(wp.array(host, dtype=plan.dtype, copy=False, device=DEFAULT_DEVICE), picture)
    del owner
    return GroundImage(adopt(host.reshape(plan.shape) if flat else host, family), give(plan.seen, family))
