"""Motion compensation: the points of a sweep, taken while the sensor moved, as if all had been taken at one time.

Between two poses the sensor is taken to move straight and to turn about one axis evenly (slerp; Shoemake, "Animating
rotation with quaternion curves", SIGGRAPH 1985). Poses are made relative to the one of the reference time in float64
on the host, so that a point loses nothing to the map's far origin; each point is then one thread's work in float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .arguments import real
from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, borrow, borrow_points, count_on, family_of, give
from .motion_parts import Segment, move_part
from .parts import parts_for, run_parts
from .plan import capacity_for, plan_for

__all__ = ["MotionCompensation", "compensate_motion"]

wp.set_module_options({"fuse_fp": False})

_LEAST_POINTS = 8192  # of a part on a CPU: less is done before another thread has begun


@wp.func
def _sine_to_right_angle(angle: float) -> float:
    """Sine of 0 … π/2, within 1e-7."""
    s = angle * angle
    return angle * (1.0 + s * (-0.16666666 + s * (8.3332423e-3 + s * (-1.9822762e-4 + s * 2.6348152e-6))))


@wp.kernel
def _move_points(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    t_in: wp.array(dtype=Any),
    row_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    times_in: wp.array(dtype=wp.float64),
    segments_in: wp.array(dtype=Segment),
    pose_count_in: wp.array(dtype=wp.int32),
    # in out: zero
    outside: wp.array(dtype=wp.int32),
    # out
    xyz_out: wp.array(dtype=wp.vec3),
):
    """One point a thread: finds its two poses, and moves it by what lies between."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    last = pose_count_in[0] - 1
    if last < 1:
        xyz_out[i] = xyz_in[i]
        return
    row = i
    if row_in:
        row = row_in[i]
    t = wp.float64(t_in[row])
    # Written so that NaN is outside, and of the first pose.
    if not (t >= times_in[0] and t <= times_in[last]):
        wp.atomic_add(outside, 0, 1)
        t = wp.where(t > times_in[last], times_in[last], times_in[0])
    low = int(0)
    high = int(last)
    while high - low > 1:
        middle = (low + high) // 2
        if times_in[middle] <= t:
            low = middle
        else:
            high = middle
    segment = segments_in[low]
    share = wp.min(float(t - times_in[low]) * segment.per_second, 1.0)
    half = share * segment.half_angle
    sine = _sine_to_right_angle(half)
    cosine = _sine_to_right_angle(1.5707964 - half)
    p = xyz_in[i]
    across = wp.cross(segment.axis, p)
    turned = p + (2.0 * sine * cosine) * across + (2.0 * sine * sine) * wp.cross(segment.axis, across)
    xyz_out[i] = segment.rotation * turned + (segment.position + share * segment.step)


for _dtype in (wp.float32, wp.float64):
    wp.overload(_move_points, {"t_in": wp.array(dtype=_dtype)})


@dataclass(frozen=True, kw_only=True)
class MotionCompensation:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    max_poses: int = 2
    """Poses that `set_poses` can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    xyz: wp.array = field(init=False, repr=False, compare=False)
    """Out: positions in the sensor's frame at the reference time [m], shape (capacity,), vec3."""
    outside: wp.array = field(init=False, repr=False, compare=False)
    """Out: points whose time is not within that of the poses, shape (1,), int32; they were moved by the nearest
    pose."""

    def __post_init__(self):
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be at least 1 point and below 2³¹, not {self.capacity}")
        if not 2 <= self.max_poses < 2**31:
            raise ValueError(f"max_poses must be at least 2 and below 2³¹, not {self.max_poses}")
        device = resolve_device(self.device)
        object.__setattr__(self, "device", device)

        def keep(name: str, shape: int, dtype: Any) -> None:
            object.__setattr__(self, name, wp.zeros(shape, dtype=dtype, device=device))

        keep("_times", self.max_poses, wp.float64)
        keep("_segments", self.max_poses - 1, Segment)
        keep("_pose_count", 1, wp.int32)
        keep("xyz", self.capacity, wp.vec3)
        keep("outside", 1, wp.int32)
        if device == DEFAULT_DEVICE:  # the host writes into them as they are
            for name in ("_times", "_segments", "_pose_count"):
                object.__setattr__(self, f"{name}_on_host", getattr(self, name).numpy())

    def set_poses(self, poses: np.ndarray, times: Sequence[float], reference_time: float) -> None:
        """Takes the motion that later launches undo, captured ones too; it copies to the device, outside of a capture.

        Args:
            poses: Sensor to world, shape (m, 4, 4), 2 ≤ m ≤ max_poses: rotations and positions [m].
            times: When the sensor had them, rising, shape (m,) [s], of the same clock as the points.
            reference_time: The time [s], within `times`, in whose sensor frame the points shall be.

        Raises:
            ValueError: A shape or a number does not fit; the message says which.
        """
        stamps = np.asarray(times, np.float64)
        segments = _segments_of(_checked_poses(poses), stamps, real(reference_time, "reference_time"))
        if len(stamps) > self.max_poses:
            raise ValueError(f"poses are {len(stamps)}, more than the plan's max_poses of {self.max_poses}")
        self._put("_times", stamps)
        self._put("_segments", segments)
        self._put("_pose_count", np.array([len(stamps)], np.int32))

    def stand_still(self) -> None:
        """Lets later launches leave the points where they are, as those of a new plan do."""
        self._put("_pose_count", np.zeros(1, np.int32))

    def _put(self, name: str, values: np.ndarray) -> None:
        if self.device == DEFAULT_DEVICE:
            getattr(self, f"{name}_on_host")[: len(values)] = values
        else:
            getattr(self, name)[: len(values)].assign(values)

    def launch(
        self,
        xyz: wp.array,
        t: wp.array,
        count: wp.array,
        *,
        rows: wp.array | None = None,
        moved: wp.array | None = None,
    ) -> None:
        """Fills `xyz` and `outside` from the first `count[0]` points.

        Args:
            xyz: Positions in the sensor's frame, each at its own time [m], shape (n,), vec3, n ≤ capacity.
            t: Time of each point [s], shape (n or more,), float32 or float64.
            count: Shape (1,), int32.
            rows: Where in `t` each point's time is, shape (n or more,), int32; None: at the point's own place.
            moved: Where the points go, shape (n or more,), vec3, which may be where they come from; None: `xyz`.
        """
        n = xyz.shape[0]
        if moved is None:
            if n > self.capacity:
                raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
            moved = self.xyz
        if t.dtype not in (wp.float32, wp.float64) or (rows is None and t.shape[0] < n):
            raise ValueError(f"t must be float32 or float64 with at least {n} rows, as there are points")
        self.outside.zero_()
        given = [xyz, t, rows, count, self._times, self._segments, self._pose_count, self.outside]
        if self.device == DEFAULT_DEVICE:
            run_parts(move_part, parts_for(n, _LEAST_POINTS), self.device, given, [moved])
        else:
            wp.launch(_move_points, n, inputs=given, outputs=[moved], device=self.device)


def _checked_poses(poses: Any) -> np.ndarray:
    poses = np.asarray(poses, np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) < 2:
        raise ValueError(f"poses must have shape (m, 4, 4) with m of 2 or more, not {poses.shape}")
    turns = poses[:, :3, :3]
    off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max()
    if not (np.isfinite(poses).all() and off < 1e-4 and (np.linalg.det(turns) > 0).all()):
        raise ValueError("poses must be rigid: finite, their upper left 3 × 3 parts rotations")
    return poses


def _quaternions(turns: np.ndarray) -> np.ndarray:
    """Quaternions w x y z of rotations, shape (m, 4), w ≥ 0; of four formulas that of the largest part."""
    m00, m11, m22 = turns[:, 0, 0], turns[:, 1, 1], turns[:, 2, 2]
    w = turns[:, [2, 0, 1], [1, 2, 0]] - turns[:, [1, 2, 0], [2, 0, 1]]
    s = turns[:, [2, 0, 1], [1, 2, 0]] + turns[:, [1, 2, 0], [2, 0, 1]]
    four = np.stack(
        [
            np.stack([1 + m00 + m11 + m22, w[:, 0], w[:, 1], w[:, 2]], -1),
            np.stack([w[:, 0], 1 + m00 - m11 - m22, s[:, 2], s[:, 1]], -1),
            np.stack([w[:, 1], s[:, 2], 1 - m00 + m11 - m22, s[:, 0]], -1),
            np.stack([w[:, 2], s[:, 1], s[:, 0], 1 - m00 - m11 + m22], -1),
        ]
    )
    best = four[np.abs(four[range(4), :, range(4)]).argmax(axis=0), np.arange(len(turns))]
    best = best / np.linalg.norm(best, axis=1, keepdims=True)
    return np.where(best[:, :1] < 0, -best, best)


def _turned(axis: np.ndarray, angle: float) -> np.ndarray:
    """The rotation about an axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _segments_of(poses: np.ndarray, times: np.ndarray, reference_time: float) -> np.ndarray:
    """From each pose to the next, seen from the pose of the reference time; a structured array, shape (m - 1,)."""
    if times.shape != (len(poses),) or not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise ValueError(f"times must be {len(poses)} rising numbers [s], one for each pose, not {times.tolist()}")
    if not times[0] <= reference_time <= times[-1]:
        raise ValueError(f"reference_time must be within times, {times[0]} … {times[-1]} s, not {reference_time}")
    turns, positions = poses[:, :3, :3], poses[:, :3, 3]
    between = _quaternions(turns[:-1].transpose(0, 2, 1) @ turns[1:])
    sine = np.linalg.norm(between[:, 1:], axis=1)
    half_angle = np.arctan2(sine, between[:, 0])
    axis = between[:, 1:] / np.where(sine > 0, sine, 1)[:, None]
    k = min(int(np.searchsorted(times, reference_time, side="right")) - 1, len(poses) - 2)
    share = (reference_time - times[k]) / (times[k + 1] - times[k])
    back = (turns[k] @ _turned(axis[k], 2 * share * half_angle[k])).T
    origin = positions[k] + share * (positions[k + 1] - positions[k])
    segments = np.zeros(len(poses) - 1, Segment.numpy_dtype())
    segments["rotation"] = back @ turns[:-1]
    segments["position"] = (positions[:-1] - origin) @ back.T
    segments["step"] = np.diff(positions, axis=0) @ back.T
    segments["axis"], segments["half_angle"] = axis, half_angle
    segments["per_second"] = 1 / np.diff(times)
    return segments


def compensate_motion(points: Any, t: Any, poses: np.ndarray, times: Sequence[float], reference_time: float) -> Any:
    """Undoes the sensor's own motion during a sweep ("deskewing").

    Args:
        points: Positions in the sensor's frame, each at its own time [m], and whatever else in further columns, shape
            (n, 3 or more), floating.
        t: Time of each point [s], shape (n,), on the device of `points`. One outside `times` takes the
            nearest pose.
        poses: Sensor to world, shape (m, 4, 4), m ≥ 2, on the host: of start and end, or of as many times as known.
        times: When the sensor had them, rising, shape (m,) [s], of the same clock as `t`.
        reference_time: The time [s], within `times`, in whose sensor frame the points shall be.

    Returns:
        The points in the sensor's frame at the reference time, their other columns as they were, shape (n, C),
        float32, of the family and on the device of `points`. The error is below 2e-6 of the distances involved.

    Raises:
        TypeError: `points` is not a floating array, or `t` none.
        ValueError: A shape or a number does not fit; the message says which.
    """
    borrowed = borrow_points(points)
    n = len(borrowed)
    family_of(t, "t")
    wide = str(t.dtype).endswith(("float64", "float64'>"))
    stamps, owner = borrow(t, wp.float64 if wide else wp.float32, (n,), "t")
    if str(stamps.device) != borrowed.device:
        raise ValueError(f"points are on {borrowed.device} and t on {stamps.device}; both must be on one device")
    plan = plan_for(
        MotionCompensation,
        capacity=1024,  # its own output is not used here
        max_poses=16 if len(poses) <= 16 else capacity_for(len(poses)),
        device=borrowed.device,
    )
    plan.set_poses(poses, times, reference_time)
    on_host = borrowed.device == DEFAULT_DEVICE
    if on_host:
        host = np.array(borrowed.table.numpy(), order="C")
        table = wp.array(host, copy=False, device=DEFAULT_DEVICE)
    else:
        host, table = None, wp.clone(borrowed.table)
    moved = wp.array(
        ptr=table.ptr if n else None, dtype=wp.vec3, shape=(n,), strides=(table.strides[0],), device=table.device
    )
    plan.launch(borrowed.xyz, stamps, count_on(n, borrowed.device), moved=moved)
    del owner
    return adopt(host, borrowed.family) if host is not None else give(table, borrowed.family)
