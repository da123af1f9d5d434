"""From a LiDAR's points to a camera's pixels, and back with colours or scores: point painting.

Painting is that of PointPainting (Vora et al., CVPR 2020): each point takes what the image says at its pixel. A
point that the camera cannot see, because a nearer one hides it, can be told by a coarse depth buffer of the points
themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .arguments import real, whole, wholes
from .camera import Camera, borrow_image, camera_model, image_point, is_in_image
from .device import DEFAULT_DEVICE, resolve_device
from .image_values import paint
from .interop import Points, adopt, borrow_points, count_on, give
from .plan import capacity_for, plan_for
from .projection_parts import paint_in_parts, project_in_parts
from .threads import PackedLaunch, thread_count

__all__ = ["Painted", "PointPainting", "PointProjection", "Projected", "paint_points", "project_points"]

# Whether a point is in the image must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_INFINITE_DEPTH = 0x7F800000  # the bits of infinity
_METHODS = ("bilinear", "nearest")
_RESULTS = (wp.vec2, wp.float32, wp.bool)
_LEAST_OF_PART = 16_384  # points for which a thread of their own is worth its while


@wp.func
def _buffer_cell(pixel: wp.vec2, cell: int, cells: wp.array2d(dtype=wp.int32)) -> wp.vec2i:
    """Row and column of the depth buffer."""
    return wp.vec2i(
        wp.min(int(pixel[1] + 0.5) // cell, cells.shape[0] - 1), wp.min(int(pixel[0] + 0.5) // cell, cells.shape[1] - 1)
    )


@wp.kernel
def _project(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    camera: Camera,
    width: int,
    height: int,
    cell: int,
    # in out: infinite
    nearest: wp.array2d(dtype=wp.int32),
    # out
    pixels_out: wp.array(dtype=wp.vec2),
    depth_out: wp.array(dtype=wp.float32),
    visible_out: wp.array(dtype=wp.bool),
):
    """Pixel and depth of each point, and per cell of the depth buffer the nearest."""
    i = wp.tid()
    visible = bool(False)
    if i < count_in[0]:
        point = image_point(xyz_in[i], camera)
        pixel = wp.vec2(point[0], point[1])
        pixels_out[i] = pixel
        depth_out[i] = point[2]
        visible = is_in_image(point, width, height)
        if visible and cell > 0:
            at = _buffer_cell(pixel, cell, nearest)
            # The bits of a positive float are in the order of its value.
            wp.atomic_min(nearest, at[0], at[1], wp.cast(point[2], wp.int32))
    visible_out[i] = visible


@wp.kernel
def _hide(
    # in
    pixels_in: wp.array(dtype=wp.vec2),
    depth_in: wp.array(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    nearest_in: wp.array2d(dtype=wp.int32),
    cell: int,
    margin: float,
    # in out
    visible: wp.array(dtype=wp.bool),
):
    """Hides what lies behind the nearest point of its cell."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    if visible[i]:
        at = _buffer_cell(pixels_in[i], cell, nearest_in)
        visible[i] = depth_in[i] <= wp.cast(nearest_in[at[0], at[1]], wp.float32) + margin


def _in_parts(device: str) -> bool:
    """Whether few threads do much each, as suits a CPU, or many little."""
    return resolve_device(device) == DEFAULT_DEVICE


@dataclass(frozen=True, kw_only=True)
class PointProjection:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    image_size: tuple[int, int]
    """Width and height [pixels]."""
    occlusion_cell: int = 0
    """Side of the cells of the depth buffer [pixels], about the distance of neighbouring points in the image; 0 to
    leave hidden points visible."""
    occlusion_margin: float = 0.5
    """How far behind the nearest point of its cell another is still visible [m]."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    pixels: wp.array = field(init=False, repr=False, compare=False)
    """Out: u v of each point, integers at centres of pixels, shape (capacity,), vec2; NaN where it has none."""
    depth: wp.array = field(init=False, repr=False, compare=False)
    """Out: along the camera's axis [m], shape (capacity,), float32."""
    visible: wp.array = field(init=False, repr=False, compare=False)
    """Out: whether a point is in the image and not hidden, shape (capacity,), bool."""

    def __post_init__(self):
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be at least 1 point and below 2³¹, not {self.capacity}")
        if len(self.image_size) != 2 or not 1 <= min(self.image_size) <= max(self.image_size) <= 2**20:
            raise ValueError(f"image_size must be width and height, 1 to 2²⁰ pixels each, not {self.image_size}")
        if not 0 <= self.occlusion_cell < 2**31:
            raise ValueError(f"occlusion_cell must be 0 or a number of pixels, not {self.occlusion_cell}")
        if not (self.occlusion_margin >= 0 and math.isfinite(self.occlusion_margin)):
            raise ValueError(f"occlusion_margin must be 0 or more metres, not {self.occlusion_margin}")
        device = resolve_device(self.device)
        width, height = self.image_size
        cells = (
            (1, 1)
            if self.occlusion_cell == 0
            else (-(-height // self.occlusion_cell), -(-width // self.occlusion_cell))
        )

        def keep(name: str, shape: int | tuple[int, int], dtype: type) -> None:
            object.__setattr__(self, name, wp.zeros(shape, dtype=dtype, device=device))

        parts = max(1, min(thread_count(), self.capacity // _LEAST_OF_PART))
        object.__setattr__(self, "_parts", parts)
        given = [None, None, None, *self.image_size]
        object.__setattr__(self, "_packed", PackedLaunch(project_in_parts, parts, given, [None, None, None]))
        keep("_nearest", cells, wp.int32)
        keep("pixels", self.capacity, wp.vec2)
        keep("depth", self.capacity, wp.float32)
        keep("visible", self.capacity, wp.bool)

    def launch(self, xyz: wp.array, count: wp.array, camera: Camera) -> None:
        """Fills the outputs for the first `count[0]` points; the others are not visible.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
            camera: From `warploom.kernels.camera.camera_model`.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        self._project_into(self.pixels, self.depth, self.visible, xyz, count, camera)

    def _is_in_parts(self) -> bool:
        return not self.occlusion_cell and _in_parts(self.device)

    def _project_into(
        self, pixels: wp.array, depth: wp.array, visible: wp.array, xyz: wp.array, count: wp.array, camera: Camera
    ) -> None:
        """Writes where the caller wants it."""
        cell = self.occlusion_cell
        if self._is_in_parts():
            self._packed.launch(
                xyz_in=xyz, count_in=count, camera=camera, pixels_out=pixels, depth_out=depth, visible_out=visible
            )
            return
        if cell:
            self._nearest.fill_(_INFINITE_DEPTH)
        wp.launch(
            _project,
            xyz.shape[0],
            inputs=[xyz, count, camera, *self.image_size, cell, self._nearest],
            outputs=[pixels, depth, visible],
            device=self.device,
        )
        if cell:
            wp.launch(
                _hide,
                xyz.shape[0],
                inputs=[pixels, depth, count, self._nearest, cell, self.occlusion_margin, visible],
                device=self.device,
            )


@dataclass(frozen=True, kw_only=True)
class PointPainting:
    """A plan: projects points, and takes for each what an image says at its pixel."""

    channels: int
    """Channels of the image."""
    projection: PointProjection
    """Where the points are seen: the plan of it, whose outputs are filled too."""
    method: str = "bilinear"
    """`bilinear` between the four nearest pixels, or `nearest`, for labels."""

    values: wp.array = field(init=False, repr=False, compare=False)
    """Out: what the image says at each point, zero where it is not visible, shape (capacity, channels), float32."""

    def __post_init__(self):
        if not 1 <= self.channels < 2**31:
            raise ValueError(f"channels must be at least 1 and below 2³¹, not {self.channels}")
        if self.method not in _METHODS:
            raise ValueError(f"method must be 'bilinear' or 'nearest', not {self.method!r}")
        shape = (self.projection.capacity, self.channels)
        object.__setattr__(self, "values", wp.zeros(shape, dtype=wp.float32, device=self.projection.device))
        object.__setattr__(self, "_packed", {})

    def launch(self, xyz: wp.array, count: wp.array, camera: Camera, image: wp.array) -> None:
        """Fills `values` and the outputs of `projection` for the first `count[0]` points.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
            camera: From `warploom.kernels.camera.camera_model`.
            image: Shape (height, width, channels), uint8 or float32.
        """
        projection, n = self.projection, xyz.shape[0]
        if n > projection.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {projection.capacity}")
        self._paint_into(self.values, projection.visible, xyz, count, camera, image)

    def _paint_into(
        self, values: wp.array, visible: wp.array, xyz: wp.array, count: wp.array, camera: Camera, image: wp.array
    ) -> None:
        """Writes where the caller wants it."""
        projection = self.projection
        wanted = (*projection.image_size[::-1], self.channels)
        if tuple(image.shape) != wanted or image.dtype not in (wp.uint8, wp.float32):
            raise ValueError(f"image must be uint8 or float32 of shape {wanted}, not {image.dtype} of {image.shape}")
        pixels, depth, device = projection.pixels, projection.depth, projection.device
        is_bilinear = int(self.method == "bilinear")
        if not projection._is_in_parts():
            projection._project_into(pixels, depth, visible, xyz, count, camera)
        if not _in_parts(device):
            inputs = [pixels, visible, count, image, is_bilinear]
            wp.launch(paint, xyz.shape[0], inputs=inputs, outputs=[values], device=device)
            return
        packed = self._packed.get(image.dtype)
        if packed is None:
            is_projected = int(not projection._is_in_parts())
            given = [None, None, None, *projection.image_size, is_projected, None, is_bilinear, pixels, depth, None]
            packed = self._packed[image.dtype] = PackedLaunch(paint_in_parts, projection._parts, given, [None])
        packed.launch(xyz_in=xyz, count_in=count, camera=camera, image_in=image, visible=visible, values_out=values)


@dataclass(frozen=True, eq=False)
class Projected:
    """Where a camera sees points."""

    pixels: Any
    """u v, integers at centres of pixels, shape (n, 2), float32; NaN for what is not ahead of the camera."""
    depth: Any
    """Along the camera's axis [m], shape (n,), float32."""
    visible: Any
    """Whether a point is in the image and not hidden, shape (n,), bool."""


@dataclass(frozen=True, eq=False)
class Painted:
    """What an image says of points."""

    values: Any
    """One row per point, zero where it is not visible, shape (n, channels), float32."""
    visible: Any
    """Whether a point is in the image and not hidden, shape (n,), bool."""


def _projection_plan(borrowed: Points, image_size: Sequence[int], cell: int, margin: float) -> PointProjection:
    return plan_for(
        PointProjection,
        capacity=capacity_for(len(borrowed)),
        image_size=wholes(image_size, "image_size"),
        occlusion_cell=whole(cell, "occlusion_cell"),
        occlusion_margin=real(margin, "occlusion_margin"),
        device=borrowed.device,
    )


def project_points(
    points: Any,
    camera_from_lidar: Any,
    intrinsics: Any,
    image_size: Sequence[int],
    *,
    distortion: Sequence[float] | None = None,
    occlusion_cell: int = 0,
    occlusion_margin: float = 0.5,
) -> Projected:
    """Finds the pixels at which a camera sees points.

    Args:
        points: Positions [m], shape (n, 3 or more), floating.
        camera_from_lidar: From the points' frame to the camera's (x right, y down, z ahead), shape (4, 4).
        intrinsics: The camera's matrix, shape (3, 3) [pixels]; or a projection matrix as KITTI's, shape (3, 4).
        image_size: Width and height [pixels].
        distortion: OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]; by default none. Points so far to the side that the
            distortion would fold them back into the image have no pixel.
        occlusion_cell: Side [pixels] of the cells of a depth buffer, in which only what is near the nearest point is
            visible: about the distance of neighbouring points in the image. By default nothing hides anything.
        occlusion_margin: How far behind the nearest point of its cell another is still visible [m].

    Returns:
        Pixels, depths and which points are visible, of the family and on the device of `points`. Pixels of visible
        points are within 2e-3 of those computed in float64.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: A shape or a number does not fit; the message says which.
    """
    borrowed = borrow_points(points)
    camera = camera_model(camera_from_lidar, intrinsics, distortion)
    plan = _projection_plan(borrowed, image_size, occlusion_cell, occlusion_margin)
    n, family = len(borrowed), borrowed.family
    count = count_on(n, borrowed.device)
    if borrowed.device != DEFAULT_DEVICE:
        plan.launch(borrowed.xyz, count, camera)
        return Projected(*(give(array[:n], family) for array in (plan.pixels, plan.depth, plan.visible)))
    # Straight onto arrays of the caller's own.
    hosts = (np.empty((n, 2), np.float32), np.empty(n, np.float32), np.empty(n, bool))
    arrays = (
        wp.array(host, dtype=dtype, copy=False, device=DEFAULT_DEVICE)
        for host, dtype in zip(hosts, _RESULTS, strict=True)
    )
    plan._project_into(*arrays, borrowed.xyz, count, camera)
    return Projected(*(adopt(host, family) for host in hosts))


def paint_points(
    points: Any,
    image: Any,
    camera_from_lidar: Any,
    intrinsics: Any,
    *,
    distortion: Sequence[float] | None = None,
    method: str = "bilinear",
    occlusion_cell: int = 0,
    occlusion_margin: float = 0.5,
) -> Painted:
    """Gives each point what an image says at its pixel: colours, or the class scores of a segmentation.

    Args:
        points: Positions [m], shape (n, 3 or more), floating.
        image: Shape (height, width, channels) or (height, width), on the device of `points`; uint8 and float32 are
            taken as they are, other numbers as float32.
        camera_from_lidar: From the points' frame to the camera's (x right, y down, z ahead), shape (4, 4).
        intrinsics: The camera's matrix, shape (3, 3) [pixels]; or a projection matrix as KITTI's, shape (3, 4).
        distortion: OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]; by default none.
        method: `bilinear` between the four nearest pixels, or `nearest`, for labels.
        occlusion_cell: As `project_points` takes it.
        occlusion_margin: As `project_points` takes it.

    Returns:
        One row of values per point, zero where it is not visible, and which are, of the family and on the device of
        `points`. Values of [0, 1] are within 1e-3 of those computed in float64 where neighbouring pixels differ by
        less than a half.

    Raises:
        TypeError: `points` is not a floating array, or `image` none at all.
        ValueError: A shape or a number does not fit; the message says which.
    """
    borrowed = borrow_points(points)
    picture, owner = borrow_image(image)
    if str(picture.device) != borrowed.device:
        raise ValueError(f"points are on {borrowed.device} and image on {picture.device}; both must be on one device")
    camera = camera_model(camera_from_lidar, intrinsics, distortion)
    height, width, channels = picture.shape
    projection = _projection_plan(borrowed, (width, height), occlusion_cell, occlusion_margin)
    plan = plan_for(PointPainting, channels=channels, projection=projection, method=method)
    n, family = len(borrowed), borrowed.family
    count = count_on(n, borrowed.device)
    if borrowed.device != DEFAULT_DEVICE:
        plan.launch(borrowed.xyz, count, camera, picture)
        return Painted(give(plan.values[:n], family), give(projection.visible[:n], family))
    hosts = (np.empty((n, channels), np.float32), np.empty(n, bool))
    values, visible = (wp.array(host, copy=False, device=DEFAULT_DEVICE) for host in hosts)
    plan._paint_into(values, visible, borrowed.xyz, count, camera, picture)
    del owner
    return Painted(*(adopt(host, family) for host in hosts))
