"""The points in and around boxes, as a network of points takes them: up to so many of each box, in the box's frame.

What a box holds decides what it is (PointRCNN, Shi, Wang, Li, CVPR 2019), and points say of a person's shape what cells
of a quarter of a metre cannot. To the place of each point come its distances to the six sides, without which a network
does not know how large the box is that it judges (LiDAR R-CNN, Li, Wang, Wang, CVPR 2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from .device import resolve_device
from .threads import launch_parts, thread_count

__all__ = ["BOX_CHANNELS", "POINT_CHANNELS", "BoxPoints"]

# Which points lie in a box must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

POINT_CHANNELS = (
    "along", "across", "up", "to_front", "to_rear", "to_left", "to_right", "to_top", "to_bottom",
    "above_ground", "there",
)  # fmt: skip
"""Of each point: its place in the box's frame [m], how far inwards of each side it lies [m], its height above the
ground [m], and 1; a row of zeros is no point."""

BOX_CHANNELS = (
    "log_l", "log_w", "log_h", "log_range", "log_points", "bottom", "view_along", "view_across", "score",
)  # fmt: skip
"""Of each box: logarithms of its sizes and of its distance [m] and of the points in it plus one, the height of its
bottom above the ground [m], the direction to the sensor in its frame, and its score; a one for its class follows."""

_CELL = wp.constant(0.5)  # [m] edge of a cell of the map that tells whose a point may be
_CELLS_OF_METRE = wp.constant(2.0)
_CPU_RUN = 4096
_GPU_RUN = 256
_MIX = wp.constant(wp.uint32(0x9E3779B1))
_NEAREST = wp.constant(0.1)  # [m] of which a logarithm is taken at least
_WIDTH = wp.constant(len(POINT_CHANNELS))
_OF_BOX = wp.constant(len(BOX_CHANNELS))


@wp.func
def _local(pose: wp.vec4, x: float, y: float) -> wp.vec2:
    """A place along and across a box whose x, y, and cosine and sine of yaw are these."""
    dx = x - pose[0]
    dy = y - pose[1]
    return wp.vec2(dx * pose[2] + dy * pose[3], dy * pose[2] - dx * pose[3])


@wp.func
def _holds(pose: wp.vec4, reach: wp.vec4, p: wp.vec3) -> bool:
    """Whether a grown box has a point; `reach`: half its length and width, its lowest and its highest z."""
    if p[2] < reach[2] or not (p[2] <= reach[3]):
        return False
    at = _local(pose, p[0], p[1])
    return wp.abs(at[0]) <= reach[0] and wp.abs(at[1]) <= reach[1]


@wp.kernel
def _mark(
    # in
    boxes_in: wp.array2d(dtype=wp.float32),
    keep_in: wp.array(dtype=wp.int32),
    keep_count_in: wp.array(dtype=wp.int32),
    low_x: float,
    low_y: float,
    around: float,
    over_bottom: float,
    over_top: float,
    # in out
    marks: wp.array3d(dtype=wp.uint32),
    covered: wp.array2d(dtype=wp.int32),
    # out
    pose_out: wp.array(dtype=wp.vec4),
    reach_out: wp.array(dtype=wp.vec4),
):
    """Sets a box's bit in the cells that it may have points in."""
    k = wp.tid()
    if k >= keep_count_in[0]:
        return
    b = keep_in[k]
    pose = wp.vec4(boxes_in[b, 0], boxes_in[b, 1], wp.cos(boxes_in[b, 6]), wp.sin(boxes_in[b, 6]))
    half = 0.5 * boxes_in[b, 3] + around
    wide = 0.5 * boxes_in[b, 4] + around
    tall = 0.5 * boxes_in[b, 5]
    pose_out[k] = pose
    reach_out[k] = wp.vec4(half, wide, boxes_in[b, 2] - tall + over_bottom, boxes_in[b, 2] + tall + over_top)
    c = wp.abs(pose[2])
    s = wp.abs(pose[3])
    reach_x = half * c + wide * s
    reach_y = half * s + wide * c
    first_row = wp.max(int(wp.floor((pose[1] - reach_y - low_y) / _CELL)), 0)
    last_row = wp.min(int(wp.floor((pose[1] + reach_y - low_y) / _CELL)), marks.shape[0] - 1)
    first_column = wp.max(int(wp.floor((pose[0] - reach_x - low_x) / _CELL)), 0)
    last_column = wp.min(int(wp.floor((pose[0] + reach_x - low_x) / _CELL)), marks.shape[1] - 1)
    # No more than half a cell's diagonal beyond the box, and a little for rounding.
    half = half + 0.72 * _CELL
    wide = wide + 0.72 * _CELL
    bit = wp.uint32(1) << wp.uint32(k & 31)
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            at = _local(pose, low_x + (float(column) + 0.5) * _CELL, low_y + (float(row) + 0.5) * _CELL)
            if wp.abs(at[0]) <= half and wp.abs(at[1]) <= wide:
                wp.atomic_or(marks, row, column, k >> 5, bit)
                covered[row, column] = 1


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __ffs(bits) - 1;
#else
return __builtin_ctz(bits);
#endif
""")
def _lowest(bits: wp.uint32) -> int:
    """The number of the lowest bit that is set, of at least one."""


@wp.kernel
def _find(
    part: int,
    parts: int,
    # in
    lanes: int,
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    marks_in: wp.array3d(dtype=wp.uint32),
    covered_in: wp.array2d(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.vec4),
    reach_in: wp.array(dtype=wp.vec4),
    low_x: float,
    low_y: float,
    run: int,
    # out
    ranks_out: wp.array2d(dtype=wp.int32),
    listed_out: wp.array(dtype=wp.int32),
    list_out: wp.array(dtype=wp.int32),
    bits_out: wp.array2d(dtype=wp.uint32),
):
    """Lists the points of each run that are in boxes, each with the bits of its boxes, and counts those of each box."""
    rows = float(covered_in.shape[0])
    columns = float(covered_in.shape[1])
    for chunk in range(part + parts * wp.tid(), ranks_out.shape[0], parts * lanes):
        for k in range(ranks_out.shape[1]):
            ranks_out[chunk, k] = 0
        slot = int(chunk * run)
        for i in range(chunk * run, wp.min((chunk + 1) * run, count_in[0])):
            p = xyz_in[i]
            u = (p[0] - low_x) * _CELLS_OF_METRE
            v = (p[1] - low_y) * _CELLS_OF_METRE
            # Nested, as a kernel evaluates both sides of an `and`.
            if u >= 0.0 and v >= 0.0 and u < columns and v < rows:  # noqa: SIM102
                if covered_in[int(v), int(u)] != 0:
                    any_box = bool(False)
                    for word in range(marks_in.shape[2]):
                        bits = marks_in[int(v), int(u), word]
                        inside = wp.uint32(0)
                        while bits != wp.uint32(0):
                            bit = _lowest(bits)
                            bits = bits & (bits - wp.uint32(1))
                            k = word * 32 + bit
                            if _holds(pose_in[k], reach_in[k], p):
                                inside = inside | (wp.uint32(1) << wp.uint32(bit))
                                ranks_out[chunk, k] = ranks_out[chunk, k] + 1
                        bits_out[slot, word] = inside
                        any_box = any_box or inside != wp.uint32(0)
                    if any_box:
                        list_out[slot] = i
                        slot += 1
        listed_out[chunk] = slot


@wp.kernel
def _describe(
    # in
    boxes_in: wp.array2d(dtype=wp.float32),
    scores_in: wp.array(dtype=wp.float32),
    kinds_in: wp.array(dtype=wp.int32),
    keep_in: wp.array(dtype=wp.int32),
    keep_count_in: wp.array(dtype=wp.int32),
    sensor_height_in: wp.array(dtype=wp.float32),
    # in out
    ranks: wp.array2d(dtype=wp.int32),
    # out
    totals_out: wp.array(dtype=wp.int32),
    described_out: wp.array2d(dtype=wp.float32),
):
    """Makes counts of a box's points in runs those before each run, and says what is known of the box."""
    k = wp.tid()
    total = int(0)
    if k < keep_count_in[0]:
        for chunk in range(ranks.shape[0]):
            found = ranks[chunk, k]
            ranks[chunk, k] = total
            total += found
    totals_out[k] = total
    for channel in range(described_out.shape[1]):
        described_out[k, channel] = 0.0
    if k >= keep_count_in[0]:
        return
    b = keep_in[k]
    x = boxes_in[b, 0]
    y = boxes_in[b, 1]
    away = wp.max(wp.sqrt(x * x + y * y), _NEAREST)
    c = wp.cos(boxes_in[b, 6])
    s = wp.sin(boxes_in[b, 6])
    for size in range(3):
        described_out[k, size] = wp.log(wp.max(boxes_in[b, 3 + size], _NEAREST))
    described_out[k, 3] = wp.log(away)
    described_out[k, 4] = wp.log(1.0 + float(total))
    described_out[k, 5] = boxes_in[b, 2] - 0.5 * boxes_in[b, 5] + sensor_height_in[0]
    described_out[k, 6] = -(x * c + y * s) / away
    described_out[k, 7] = (x * s - y * c) / away
    described_out[k, 8] = scores_in[b]
    described_out[k, _OF_BOX + kinds_in[b]] = 1.0


@wp.kernel
def _clear(
    # in
    totals_in: wp.array(dtype=wp.int32),
    # out
    points_out: wp.array3d(dtype=wp.float32),
):
    """Clears the rows of points that a box does not have."""
    k, slot = wp.tid()  # pyright: ignore[reportAssignmentType]
    if slot >= totals_in[k]:
        for channel in range(_WIDTH):
            points_out[k, slot, channel] = 0.0


@wp.func
def _slot_of(rank: int, total: int, room: int) -> int:
    """The row of a box's point, −1 where it is left out.

    Of more points than rows, one is taken of each of as many equal shares, at a place in it that a hash says: every so
    manieth would be of one ring where points come column by column.
    """
    if total <= room:
        return rank
    share = (rank * room + room - 1) / total
    first = share * total / room
    mixed = (wp.uint32(share) + wp.uint32(1)) * _MIX
    chosen = first + int((mixed >> wp.uint32(8)) % wp.uint32((share + 1) * total / room - first))
    return wp.where(rank == chosen, share, -1)


@wp.kernel
def _take(
    part: int,
    parts: int,
    # in
    lanes: int,
    xyz_in: wp.array(dtype=wp.vec3),
    pose_in: wp.array(dtype=wp.vec4),
    listed_in: wp.array(dtype=wp.int32),
    list_in: wp.array(dtype=wp.int32),
    bits_in: wp.array2d(dtype=wp.uint32),
    run: int,
    boxes_in: wp.array2d(dtype=wp.float32),
    keep_in: wp.array(dtype=wp.int32),
    totals_in: wp.array(dtype=wp.int32),
    sensor_height_in: wp.array(dtype=wp.float32),
    # in out
    ranks: wp.array2d(dtype=wp.int32),
    # out
    points_out: wp.array3d(dtype=wp.float32),
):
    """Writes the points of each box, or of many an even choice."""
    for chunk in range(part + parts * wp.tid(), ranks.shape[0], parts * lanes):
        for listed in range(chunk * run, listed_in[chunk]):
            for word in range(bits_in.shape[1]):
                bits = bits_in[listed, word]
                while bits != wp.uint32(0):
                    k = word * 32 + _lowest(bits)
                    bits = bits & (bits - wp.uint32(1))
                    rank = ranks[chunk, k]
                    ranks[chunk, k] = rank + 1
                    slot = _slot_of(rank, totals_in[k], points_out.shape[1])
                    if slot >= 0:
                        p = xyz_in[list_in[listed]]
                        b = keep_in[k]
                        at = _local(pose_in[k], p[0], p[1])
                        up = p[2] - boxes_in[b, 2]
                        half = 0.5 * boxes_in[b, 3]
                        wide = 0.5 * boxes_in[b, 4]
                        tall = 0.5 * boxes_in[b, 5]
                        points_out[k, slot, 0] = at[0]
                        points_out[k, slot, 1] = at[1]
                        points_out[k, slot, 2] = up
                        points_out[k, slot, 3] = half - at[0]
                        points_out[k, slot, 4] = half + at[0]
                        points_out[k, slot, 5] = wide - at[1]
                        points_out[k, slot, 6] = wide + at[1]
                        points_out[k, slot, 7] = tall - up
                        points_out[k, slot, 8] = tall + up
                        points_out[k, slot, 9] = p[2] + sensor_height_in[0]
                        points_out[k, slot, 10] = 1.0


@dataclass(frozen=True, kw_only=True)
class BoxPoints:
    """A plan: the points of up to `boxes` boxes, of up to `capacity` points; the same on any number of threads.

    Attributes:
        points: Shape (boxes, points_of_box, 11), float32, see `POINT_CHANNELS`; zeros where there is no point or box.
        described: Shape (boxes, 9 + classes), float32, see `BOX_CHANNELS`; zeros where there is no box.
        totals: Points in each grown box, shape (boxes,), int32.
    """

    capacity: int
    """Points that one launch can take."""
    boxes: int
    """Boxes that one launch looks at."""
    points_of_box: int
    """Points that are taken of a box."""
    classes: int
    """Classes of boxes."""
    around: float = 0.75
    """By which a box is grown on its four sides [m]."""
    over_bottom: float = 0.1
    """From how far above its bottom it has points [m]: what is lower is the road's."""
    over_top: float = 1.0
    """Up to how far above its top it has points [m]."""
    origin: tuple[float, float] = (-60.0, -60.0)
    """Lowest x and y that points of boxes have [m]."""
    size: tuple[float, float] = (120.0, 120.0)
    """Extent along x and y from there [m]."""
    points: wp.array | None = None
    """Where they are written; None: an array of its own."""
    described: wp.array | None = None
    """Likewise."""
    device: str = "cpu"
    """A Warp device, such as `cpu` or `cuda:0`."""

    def __post_init__(self):
        for name in ("capacity", "boxes", "points_of_box", "classes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        # A rank times the rows must fit into 31 bits.
        if (self.capacity + 1) * self.points_of_box >= 2**31:
            raise ValueError(
                f"capacity times points_of_box must be below 2³¹, not {self.capacity * self.points_of_box}"
            )
        if not self.around >= 0.0:
            raise ValueError(f"around must be at least 0, not {self.around}")
        if not (self.size[0] > 0.0 and self.size[1] > 0.0):
            raise ValueError(f"size must be positive, not {self.size}")
        device = resolve_device(self.device)

        def keep(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, shape: int | Sequence[int], dtype: type) -> None:
            keep(name, wp.zeros(shape, dtype=dtype, device=device))

        for name, shape in (
            ("points", (self.boxes, self.points_of_box, len(POINT_CHANNELS))),
            ("described", (self.boxes, len(BOX_CHANNELS) + self.classes)),
        ):
            if getattr(self, name) is None:
                buffer(name, shape, wp.float32)
            elif tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"{name} must have the shape {shape}, not {tuple(getattr(self, name).shape)}")
        columns, rows = (int(np.ceil(extent / float(_CELL))) for extent in self.size)
        keep("_run", _CPU_RUN if device == "cpu" else _GPU_RUN)
        buffer("_marks", (rows, columns, (self.boxes + 31) // 32), wp.uint32)
        buffer("_covered", (rows, columns), wp.int32)
        buffer("_pose", self.boxes, wp.vec4)
        buffer("_reach", self.boxes, wp.vec4)
        chunks = -(-self.capacity // self._run)
        buffer("_ranks", (chunks, self.boxes), wp.int32)
        buffer("_listed", chunks, wp.int32)
        buffer("_list", chunks * self._run, wp.int32)
        buffer("_bits", (chunks * self._run, (self.boxes + 31) // 32), wp.uint32)
        buffer("_height", 1, wp.float32)
        buffer("totals", self.boxes, wp.int32)
        keep("_parts", thread_count() if device == "cpu" else 1)

    def launch(
        self,
        xyz: wp.array,
        count: wp.array,
        boxes: wp.array,
        scores: wp.array,
        kinds: wp.array,
        keep: wp.array,
        keep_count: wp.array,
        sensor_height: float | wp.array,
    ) -> None:
        """Fills `points`, `described` and `totals`.

        Args:
            xyz: Positions in the frame of the boxes, whose origin is the sensor [m], shape (n,), vec3, n ≤ capacity.
            count: Number of points, shape (1,), int32.
            boxes: Shape (b, 7), float32: x y z l w h yaw.
            scores: Shape (b,), float32.
            kinds: Their classes, shape (b,), int32.
            keep: Which of them, shape (k,), int32; those after the first `boxes` are not looked at.
            keep_count: How many of these, shape (1,), int32.
            sensor_height: Height of the sensor above the ground [m]: a number or a device array of one float32.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"{n} points are more than the plan's capacity of {self.capacity}")
        device = self.totals.device
        height = sensor_height
        if not isinstance(height, wp.array):
            height = self._height
            height.fill_(float(sensor_height))
        most = min(self.boxes, keep.shape[0])
        low = [float(value) for value in self.origin]
        chunks = -(-n // self._run)
        ranks = self._ranks[: max(chunks, 1)]
        self._marks.zero_()
        self._covered.zero_()
        wp.launch(
            _mark, most,
            inputs=[boxes, keep, keep_count, *low, float(self.around), float(self.over_bottom), float(self.over_top)],
            outputs=[self._marks, self._covered, self._pose, self._reach], device=device,
        )  # fmt: skip
        lists = [self._listed, self._list, self._bits]
        seen = [xyz, count, self._marks, self._covered, self._pose, self._reach, *low, self._run]
        self._launch_chunks(_find, ranks, seen, [ranks, *lists])
        wp.launch(
            _describe, self.boxes, inputs=[boxes, scores, kinds, keep, keep_count, height],
            outputs=[ranks, self.totals, self.described], device=device,
        )  # fmt: skip
        wp.launch(_clear, (self.boxes, self.points_of_box), inputs=[self.totals], outputs=[self.points], device=device)
        seen = [xyz, self._pose, *lists, self._run, boxes, keep, self.totals, height]
        self._launch_chunks(_take, ranks, seen, [ranks, self.points])

    def _launch_chunks(self, kernel: wp.Kernel, ranks: wp.array, inputs: list, outputs: list) -> None:
        """On a CPU the runs of points are shared out among its threads; a GPU has a thread for each."""
        chunks = ranks.shape[0]
        if ranks.device.is_cpu:
            launch_parts(kernel, max(1, min(self._parts, chunks)), [1, *inputs], outputs)
        else:
            wp.launch(kernel, chunks, inputs=[0, 1, chunks, *inputs], outputs=outputs, device=ranks.device)
