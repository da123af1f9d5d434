"""The chain: a frame's kernels as one plan, from the raw points to clusters, boxes, pillars and maps from above.

What one stage finds stays on the device for the next: counts too, so nothing waits for the host between the stages.
Stages that do not need each other run side by side: on a CPU on its threads, on a GPU on streams of one graph, which
is recorded when the chain is made and replayed for each frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from .bev import BevMaps
from .boxes import FitBoxes
from .chain_result import COUNTS, ChainResult, collect_counts, read_counts, result_of
from .cluster import EuclideanCluster
from .cpu_graph import CpuGraph, is_alone
from .device import DEFAULT_DEVICE, resolve_device
from .filters import PointFilter
from .ground import GroundSegment
from .interop import Family, Points, borrow_points, family_of
from .motion import MotionCompensation
from .pillar import PillarGrid
from .selection import select_heights
from .threads import run_together
from .voxel import Voxelize

__all__ = ["CHAIN_STAGES", "ChainConfig", "KernelChain"]

CHAIN_STAGES = ("cluster", "boxes", "pillars", "channels", "bev")
"""What may follow the filter and the ground, which every chain has."""

_COLUMNS = 4  # of a point: x y z intensity


@dataclass(frozen=True, kw_only=True)
class ChainConfig:
    """What the stages of a chain do; the defaults are those of the pipeline where it has the stage."""

    stages: tuple[str, ...] = ("cluster", "boxes", "pillars", "bev")
    """Which of `CHAIN_STAGES` run after filter and ground; `boxes` needs `cluster`."""

    point_range: tuple[float, ...] | None = (-100.0, -100.0, -10.0, 100.0, 100.0, 10.0)
    """Filter: xmin ymin zmin xmax ymax zmax [m] of what stays, upper bounds open; None for everywhere."""
    ego_box: tuple[float, ...] | None = (-2.5, -1.2, -2.5, 2.5, 1.2, 0.5)
    """Filter: the same of the own vehicle, whose points go; None for none."""

    max_poses: int = 0
    """Motion: poses of a sweep that `upload` may be given, 2 or more, to move its points to where they were seen from
    at one time; 0 leaves the step out."""

    sensor_height: float | None = None
    """Ground: height of the frame's origin above it [m], held to within 0.5 m; None to estimate it in each frame."""

    radius: float = 0.5
    """Clusters: longest step [m] that joins two points."""
    radius_per_metre: float = 0.0
    """Clusters: by how much it grows per metre of range."""
    min_size: int = 10
    """Clusters: points that make one."""
    min_height: float = 0.1
    """Clusters: points lower above the ground take no part [m]."""
    max_height: float = 4.0
    """Clusters: nor do higher ones [m]."""

    box_method: str = "l_shape"
    """Boxes: `l_shape` or `min_area`."""
    min_box_size: float = 0.1
    """Boxes: least length, width and height [m]."""
    max_boxes: int = 1024
    """Boxes that there is room for; clusters beyond get none, and are counted."""

    pillar_size: tuple[float, float, float] = (0.16, 0.16, 4.0)
    """Pillars: edges of a voxel along x y z [m]."""
    pillar_range: tuple[float, ...] = (0.0, -39.68, -3.0, 69.12, 39.68, 1.0)
    """Pillars: xmin ymin zmin xmax ymax zmax [m], upper bounds open."""
    max_points: int = 32
    """Pillars: points that one keeps."""
    max_pillars: int = 40_000
    """Pillars that there is room for."""

    channel_range: tuple[float, ...] = (-60.0, -60.0, -2.0, 60.0, 60.0, 6.0)
    """Channels, the detection head's input: xmin ymin zmin xmax ymax zmax [m], z above the ground."""
    channel_cell: float = 0.25
    """Channels: edge of a cell [m]."""

    bev_range: tuple[float, ...] = (0.0, -25.0, -2.73, 50.0, 25.0, 1.27)
    """BEV maps: xmin ymin zmin xmax ymax zmax [m] of the points drawn, upper bounds open."""
    bev_shape: tuple[int, int] = (608, 608)
    """BEV maps: rows, along x, and columns, along y."""

    def __post_init__(self):
        unknown = [stage for stage in self.stages if stage not in CHAIN_STAGES]
        if unknown:
            raise ValueError(f"stages must be of {', '.join(CHAIN_STAGES)}, not {', '.join(map(repr, unknown))}")
        if "boxes" in self.stages and "cluster" not in self.stages:
            raise ValueError("stages with 'boxes' must have 'cluster', around whose clusters they are")
        if self.max_poses < 0 or self.max_poses == 1:
            raise ValueError(f"max_poses must be 0, or 2 or more, not {self.max_poses}")
        if not self.min_height <= self.max_height:
            raise ValueError(
                f"min_height must be at most max_height, not {self.min_height} with a max_height of {self.max_height}"
            )


@dataclass(frozen=True, kw_only=True)
class KernelChain:
    """A plan: filter, ground, clusters, boxes, pillars, channels and maps of clouds of up to `capacity` points.

        chain = KernelChain(config=ChainConfig(radius=0.6, stages=("cluster", "boxes")), device="cuda:0")
        for points in scans:
            result = chain(points)

    Or by steps that neither allocate nor wait for the device: `upload`, `launch`, and what the arrays below then hold
    for the next kernel; `result` waits, reads the counts once and trims the arrays by them. Instead of `upload`, a
    kernel of the caller's may write `points` and `count`.

    The results are to the bit those of the stages' own functions, called one after the other; captured or not, and on
    any number of threads. A chain serves one frame at a time.
    """

    config: ChainConfig = ChainConfig()
    """What the stages do."""
    capacity: int = 200_000
    """Points of a frame that there is room for; further ones are left out and counted."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    captured: bool | None = None
    """Whether the launches are recorded once and replayed: as one CUDA graph, or as Warp's graphs for a CPU.

    None: yes on a GPU; on a CPU where no other thread of the process is alive. While a chain is made that records, no
    other thread may launch kernels on its device, for Warp would record them too. A recorded frame costs Python next to
    nothing, a direct one some 30 µs for each launch."""

    points: wp.array = field(init=False, repr=False, compare=False)
    """In: x y z [m] and intensity, shape (capacity, 4), float32."""
    count: wp.array = field(init=False, repr=False, compare=False)
    """In: how many points there are, shape (1,), int32; it may be more than `capacity`."""
    t: wp.array = field(init=False, repr=False, compare=False)
    """In, where the chain has motion: time of each point from the one that all shall be seen at [s], shape (capacity,),
    float32."""
    xyz: wp.array = field(init=False, repr=False, compare=False)
    """Positions of the points that passed the filter [m], in order, shape (capacity,), vec3."""
    intensity: wp.array = field(init=False, repr=False, compare=False)
    """Their intensities, shape (capacity,), float32."""
    index: wp.array = field(init=False, repr=False, compare=False)
    """Their places in the input, shape (capacity,), int32."""
    kept: wp.array = field(init=False, repr=False, compare=False)
    """How many they are, shape (1,), int32."""
    ground: wp.array = field(init=False, repr=False, compare=False)
    """Whether each of them is ground, shape (capacity,), bool."""
    height: wp.array = field(init=False, repr=False, compare=False)
    """Height of each above the ground [m], shape (capacity,), float32."""
    sensor_height: wp.array = field(init=False, repr=False, compare=False)
    """Of the frame's origin above the ground near it [m], shape (1,), float32."""
    labels: wp.array | None = field(init=False, repr=False, compare=False)
    """The cluster of each, −1 for none, shape (capacity,), int32; None without the stage."""
    cluster_count: wp.array | None = field(init=False, repr=False, compare=False)
    """How many clusters there are, shape (1,), int32."""
    boxes: wp.array | None = field(init=False, repr=False, compare=False)
    """x y z l w h [m] and yaw [rad] by cluster, shape (max_boxes, 7), float32; NaN from `cluster_count` on."""
    pillars: Voxelize | None = field(init=False, repr=False, compare=False)
    """The plan that holds `features`, `coords`, `counts`, `voxel_count` and `dropped` of the pillars."""
    channels: wp.array | None = field(init=False, repr=False, compare=False)
    """The detection head's input, shape (1, C, H, W), float32: see `pillarize`."""
    maps: wp.array | None = field(init=False, repr=False, compare=False)
    """Height, intensity and density, shape (3, rows, columns), float32: see `bev`."""
    counts: wp.array = field(init=False, repr=False, compare=False)
    """All counts of the frame, in the order of `COUNTS` in `chain_result`, shape (n,), int32; `result` reads it."""

    def __post_init__(self):
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be at least 1 point and below 2³¹, not {self.capacity}")
        device = resolve_device(self.device)
        object.__setattr__(self, "device", device)
        config, room = self.config, {"capacity": self.capacity, "device": device}
        has = {stage: stage in config.stages for stage in CHAIN_STAGES}
        select = PointFilter(point_range=config.point_range, ego_box=config.ego_box, **room)
        motion = config.max_poses and MotionCompensation(capacity=1, max_poses=config.max_poses, device=device)
        ground = GroundSegment(sensor_height=config.sensor_height, **room)
        cluster = has["cluster"] and EuclideanCluster(
            radius=config.radius, radius_per_metre=config.radius_per_metre, min_size=config.min_size, **room
        )
        boxes = has["boxes"] and FitBoxes(
            max_clusters=config.max_boxes, method=config.box_method, min_size=config.min_box_size, **room
        )
        pillars = has["pillars"] and Voxelize(
            voxel_size=config.pillar_size,
            point_range=config.pillar_range,
            columns=_COLUMNS,
            max_points=config.max_points,
            max_voxels=config.max_pillars,
            **room,
        )
        channels = has["channels"] and PillarGrid(point_range=config.channel_range, cell=config.channel_cell, **room)
        maps = has["bev"] and BevMaps(point_range=config.bev_range, shape=config.bev_shape, **room)

        def keep(**values: Any) -> None:
            for name, value in values.items():
                object.__setattr__(self, name, value)

        keep(
            _filter=select,
            _motion=motion,
            _ground=ground,
            _cluster=cluster,
            _boxes=boxes,
            _channels=channels,
            _bev=maps,
        )
        points = wp.zeros((self.capacity, _COLUMNS), dtype=wp.float32, device=device)
        keep(points=points, count=wp.zeros(1, dtype=wp.int32, device=device))
        keep(_input=borrow_points(points))
        keep(t=wp.zeros(self.capacity if motion else 0, dtype=wp.float32, device=device))
        keep(_standing=wp.zeros(self.capacity, dtype=wp.bool, device=device))
        keep(xyz=select.xyz, intensity=select.intensity, index=select.index, kept=select.count)
        keep(ground=ground.mask, height=ground.height, sensor_height=ground.found_height)
        keep(labels=cluster.labels if cluster else None, cluster_count=cluster.cluster_count if cluster else None)
        keep(boxes=boxes.boxes if boxes else None, pillars=pillars or None)
        keep(channels=channels.grid if channels else None, maps=maps.maps if maps else None)
        keep(counts=wp.zeros(len(COUNTS), dtype=wp.int32, device=device))
        keep(_waves=self._schedule(), _launch=self._launch_directly)
        if device != DEFAULT_DEVICE:
            keep(_staged=wp.zeros((self.capacity, _COLUMNS), dtype=wp.float32, device="cpu", pinned=True))
            keep(_uploaded=wp.Event(device), _forked=wp.Event(device))
            lanes = max(len(wave) for wave in self._waves) - 1
            keep(_side=[(wp.Stream(device), wp.Event(device)) for _ in range(lanes)])
        self._launch_directly()  # compiles and loads what a recording must find loaded
        if self.captured is None:
            keep(captured=device != DEFAULT_DEVICE or is_alone())
        if self.captured:
            keep(_launch=self._recorded())
            self.launch()  # a GPU's graph is made ready at its first launch

    # ---- the stages

    def _schedule(self) -> list[list[Callable[[], None]]]:
        """What runs when: the waves one after the other, the lanes of a wave side by side."""
        waves = [
            [self._filter_points],
            [self._motion and self._undo_motion],
            [self._segment_ground, self.pillars and self._fill_pillars],
            [self._cluster and self._cluster_and_fit, (self._channels or self._bev) and self._draw_maps],
            [self._collect_counts],
        ]
        return [lanes for wave in waves if (lanes := [lane for lane in wave if lane])]

    def _filter_points(self) -> None:
        self._filter.launch(self._input.xyz, self._input.intensity, self.count)

    def _undo_motion(self) -> None:
        self._motion.launch(self.xyz, self.t, self.kept, rows=self.index, moved=self.xyz)

    def _segment_ground(self) -> None:
        self._ground.launch(self.xyz, self.kept)

    def _cluster_and_fit(self) -> None:
        bounds = (self.config.min_height, self.config.max_height)
        select_heights(self.ground, self.height, self.kept, bounds, self._standing)
        self._cluster.launch(self.xyz, self.kept, self._standing)
        if self._boxes:
            self._boxes.launch(self.xyz, self.labels, self.kept)

    def _fill_pillars(self) -> None:
        self.pillars.launch(self.xyz, self.kept, self.intensity)

    def _draw_maps(self) -> None:
        if self._channels:
            self._channels.launch(self.xyz, self.kept, self.sensor_height)
        if self._bev:
            self._bev.launch(self.xyz, self.intensity, self.kept)

    def _collect_counts(self) -> None:
        collect_counts(
            self.counts,
            offered=self.count,
            capacity=self.capacity,
            kept=self.kept,
            filtered=self._filter.dropped,
            sensor_height=self.sensor_height,
            clusters=self.cluster_count,
            max_boxes=self.config.max_boxes,
            unboxed=self._boxes.dropped if self._boxes else None,
            pillars=self.pillars.voxel_count if self.pillars else None,
            unpillared=self.pillars.dropped if self.pillars else None,
        )

    # ---- launching

    def launch(self) -> None:
        """Runs the chain on `points` and `count`; allocates nothing, reads nothing back."""
        self._launch()

    def _launch_directly(self) -> None:
        for wave in self._waves:
            if len(wave) == 1:
                wave[0]()
            elif self.device == DEFAULT_DEVICE:
                run_together(wave)
            else:
                self._run_on_streams(wave)

    def _run_on_streams(self, lanes: list[Callable[[], None]]) -> None:
        """The first lane on the device's stream, each other on one of its own, between a fork and a join."""
        stream = wp.get_stream(self.device)
        stream.record_event(self._forked)
        side = self._side[: len(lanes) - 1]
        for (own, done), lane in zip(side, lanes[1:], strict=True):
            own.wait_event(self._forked)
            with wp.ScopedStream(own, sync_enter=False):
                lane()
            own.record_event(done)
        lanes[0]()
        for _, done in side:
            stream.wait_event(done)

    def _recorded(self) -> Callable[[], Any]:
        """Replays the chain."""
        if self.device == DEFAULT_DEVICE:
            return CpuGraph(self._launch_directly).launch
        with wp.ScopedCapture(self.device) as capture:
            self._launch_directly()
        return partial(wp.capture_launch, capture.graph)

    # ---- in and out

    def upload(
        self, points: Any, *, t: Any = None, poses: np.ndarray | None = None, times: Sequence[float] = ()
    ) -> None:
        """Copies a frame into `points` and `count`, and what is known of the sensor's motion.

        From the host to a GPU through pinned memory; it waits until the copy of the frame before has been made.

        Args:
            points: x y z [m] and, as the fourth column where there is one, intensity, shape (n, 3 or more), floating;
                NumPy, torch, Warp or DLPack, on the host or on the chain's device. Further columns are left out.
            t: Time of each point [s], shape (n,), on the host; 0 is when all shall be seen from. None: they stay where
                they are.
            poses: World from sensor, shape (m, 4, 4), where there is `t`; at most as many as the configuration says.
            times: When the sensor had them, rising, of the clock of `t`, shape (m,) [s].

        Raises:
            TypeError: `points` is not a floating array.
            ValueError: It has another shape, or lies on a third device; or times or poses do not fit.
        """
        self._upload(borrow_points(points))
        if t is not None:
            self._upload_motion(t, poses, times, len(points))
        elif self._motion:
            self._motion.stand_still()

    def _upload_motion(self, t: Any, poses: Any, times: Sequence[float], offered: int) -> None:
        if not self._motion:
            raise ValueError("t makes sense in a chain whose configuration has max_poses, not 0")
        if np.shape(t) != (offered,):
            raise ValueError(f"t must have shape ({offered},), as there are points, not {np.shape(t)}")
        self._motion.set_poses(poses, times, 0.0)
        n = min(offered, self.capacity)
        if self.device == DEFAULT_DEVICE:
            self.t.numpy()[:n] = t[:n]
        elif n:
            self.t[:n].assign(np.ascontiguousarray(t[:n], np.float32))

    def _upload(self, borrowed: Points) -> None:
        offered, columns = borrowed.table.shape
        n, columns = min(offered, self.capacity), min(columns, _COLUMNS)
        if borrowed.device not in (DEFAULT_DEVICE, self.device):
            raise ValueError(f"points must lie on the host or on {self.device}, not on {borrowed.device}")
        if borrowed.device == self.device != DEFAULT_DEVICE:
            if n:
                wp.copy(self.points[:n, :columns], borrowed.table[:n, :columns])
            if n and columns < _COLUMNS:
                self.points[:n, columns].zero_()
            self.count.fill_(offered)
            return
        on_device = self.device != DEFAULT_DEVICE
        if on_device:
            wp.synchronize_event(self._uploaded)
        host = (self._staged if on_device else self.points).numpy()
        host[:n, :columns] = borrowed.table.numpy()[:n, :columns]
        host[:n, columns:] = 0.0
        if on_device and n:
            wp.copy(self.points, self._staged, count=n * _COLUMNS)
            wp.get_stream(self.device).record_event(self._uploaded)
        self.count.fill_(offered)

    def read_counts(self) -> tuple[dict[str, int], float]:
        """The counts of the last launch by the names of `COUNTS`, and the sensor's height [m]: it waits for them."""
        return read_counts(self.counts)

    def result(self, family: Family | None = None, *, copy: bool = True) -> ChainResult:
        """What the last launch found, trimmed by its counts, which are read from the device: it waits for them.

        Args:
            family: Of the arrays; by default NumPy's.
            copy: False gives views of the chain's own arrays where the family can show the device's memory; the next
                launch overwrites them.
        """
        return result_of(self, family or Family("numpy", DEFAULT_DEVICE), copy)

    def __call__(self, points: Any, *, copy: bool = True) -> ChainResult:
        """Runs the chain on a frame.

        Args:
            points: As for `upload`.
            copy: As for `result`.

        Returns:
            What it found, in arrays of the family of `points`; where these lie on the host, so do the results.

        Raises:
            TypeError: `points` is not a floating array.
            ValueError: It has another shape, or lies on a third device.
        """
        self.upload(points)
        self.launch()
        return self.result(family_of(points), copy=copy)
