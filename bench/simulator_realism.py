"""How like real scans simulated ones are: python -m warploom.bench.simulator_realism DATA.

DATA holds `kitti_object/velodyne`, `kitti_tracking/velodyne_packed/0000` and `semantic_kitti`. Streets of the simulator
are seen by its HDL-64E at 1.73 m, as the real ones were. Where ranges, heights and pillars differ, a head that learnt
from the one has something to unlearn on the other: the table says where, and by which factor.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from ..components.evaluation.detection_frames import evaluation_frames
from ..components.evaluation.kitti_objects import unpack_scan
from ..models.classes import VEHICLE
from ..models.simulator import PointClass, sample_scene

_SENSOR_HEIGHT = 1.73
_REACH = 40.0  # [m] of heights and pillars
_CELL = 0.25  # [m]
_RANGES = (0.0, 5.0, 10.0, 20.0, 30.0, 50.0, 80.0, 200.0)
_HEIGHTS = (-1.0, -0.3, 0.3, 1.0, 2.0, 3.0, 30.0)
_SEMANTIC = {  # class of SemanticKITTI's training ids (0 none) → of the simulator
    "vehicle": (1, 4, 5), "two-wheeler or clutter": (2, 3), "person or rider": (6, 7, 8), "road": (9, 10),
    "sidewalk": (11, 12), "building": (13,), "fence": (14,), "vegetation": (15, 16), "terrain": (17,), "pole": (18, 19),
}  # fmt: skip
_SIMULATED = {
    "vehicle": (PointClass.VEHICLE,), "two-wheeler or clutter": (PointClass.OTHER, PointClass.CONE, PointClass.BARRIER),
    "person or rider": (PointClass.PEDESTRIAN, PointClass.CYCLIST), "road": (PointClass.ROAD,),
    "sidewalk": (PointClass.SIDEWALK,), "building": (PointClass.BUILDING,), "fence": (PointClass.FENCE,),
    "vegetation": (PointClass.VEGETATION,), "terrain": (PointClass.TERRAIN,), "pole": (PointClass.POLE,),
}  # fmt: skip


def scan_statistics(points: np.ndarray) -> dict[str, float]:
    """What can be said of one scan without labels; points [m], shape (n, 3)."""
    distance = np.linalg.norm(points, axis=1)
    said = {"points": float(len(points))}
    for low, high in itertools.pairwise(_RANGES):
        said[f"range {low:.0f} to {high:.0f} m"] = float(np.mean((distance >= low) & (distance < high)))
    near = np.hypot(points[:, 0], points[:, 1]) < _REACH
    height = points[near, 2] + _SENSOR_HEIGHT
    for low, high in itertools.pairwise(_HEIGHTS):
        said[f"height {low:.1f} to {high:.1f} m"] = float(np.mean((height >= low) & (height < high)))
    cells = np.floor(points[near, :2] / _CELL).astype(np.int64)
    _, pillar, size = np.unique(cells[:, 0] * 100_003 + cells[:, 1], return_inverse=True, return_counts=True)
    top, bottom = np.full(len(size), -np.inf), np.full(len(size), np.inf)
    np.maximum.at(top, pillar, height)
    np.minimum.at(bottom, pillar, height)
    said["pillars"] = float(len(size))
    said["points a pillar"] = float(size.mean())
    said["pillars above 0.5 m"] = float((top > 0.5).sum())
    said["tall pillars (above 1.5 m)"] = float((top > 1.5).sum())
    said["pillars that hover (from above 1 m)"] = float((bottom > 1.0).sum())
    return said


def far_ends(points: np.ndarray, boxes: np.ndarray) -> list[float]:
    """How far before the end of its box the last points of each car lie whose flank is seen at 75 to 82° [m].

    Of cars of 3.2 to 5 m with 100 points or more, the last being the one that 0.7 % lie beyond.
    """
    ends = []
    for box in boxes.astype(np.float64):
        c, s = np.cos(box[6]), np.sin(box[6])
        sensor = np.array([-(box[0] * c + box[1] * s), box[0] * s - box[1] * c])
        half = 0.5 * box[3:5]
        slant = np.degrees(np.arctan2(abs(sensor[0]) + half[0], abs(sensor[1]) - half[1]))
        clear = abs(sensor[1]) > half[1] + 1.0 and abs(sensor[0]) > half[0] + 1.5
        if not clear or not 75.0 <= slant < 82.0 or not 3.2 < box[3] < 5.0 or box[5] > 1.75:
            continue
        apart = points[:, :2] - box[:2]
        along = np.stack([apart[:, 0] * c + apart[:, 1] * s, apart[:, 1] * c - apart[:, 0] * s], 1) * np.sign(sensor)
        up = points[:, 2] - box[2] + 0.5 * box[5]
        own = (np.abs(along) < half + np.array([0.3, 0.15])).all(1) & (up > 0.3) & (up < box[5] + 0.1)
        if own.sum() >= 100:
            ends.append(float(np.percentile(along[own, 0], 0.7) + half[0]))
    return ends


def _labelled_cars(data: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for source in (f"kitti:{data}/kitti_object", f"kitti:{data}/kitti_tracking?sequence=0000"):
        for frame in evaluation_frames(source):
            cars = np.array([kind == "Car" for kind in frame.types], bool) & (frame.counts >= 150)
            yield frame.points, frame.boxes[cars]


def _mean(rows: Iterable[dict[str, float]]) -> dict[str, float]:
    table = list(rows)
    return {name: float(np.mean([row[name] for row in table])) for name in table[0]}


def _real(data: Path) -> Iterator[np.ndarray]:
    for path in sorted((data / "kitti_object" / "velodyne").glob("*.bin")):
        yield np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]
    for path in sorted((data / "kitti_tracking" / "velodyne_packed" / "0000").glob("*.npz"))[::10]:
        yield unpack_scan(path)[:, :3]
    for path in sorted((data / "semantic_kitti" / "full").glob("*.bin"))[::3]:
        yield np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]


def _real_classes(data: Path) -> Iterator[dict[str, float]]:
    for path in sorted((data / "semantic_kitti" / "range_64x1024").glob("*.npz")):
        with np.load(path) as image:
            seen = image["label"][(image["depth"] > 0) & (image["label"] > 0)]
        yield {name: float(np.isin(seen, ids).mean()) for name, ids in _SEMANTIC.items()}


def main(
    data: Annotated[Path, typer.Argument(help="Folder with kitti_object, kitti_tracking and semantic_kitti.")],
    scenes: Annotated[int, typer.Option(help="Simulated scenes.")] = 40,
) -> None:
    """Prints each statistic of real and simulated scans, and the one over the other."""
    frames = [sample_scene(seed, lidar="hdl64", mounting_height=_SENSOR_HEIGHT) for seed in range(scenes)]
    real, simulated = (
        _mean(map(scan_statistics, _real(data))),
        _mean(scan_statistics(frame.points[:, :3]) for frame in frames),
    )
    real |= _mean(_real_classes(data))
    simulated |= _mean({n: float(np.isin(f.point_class, c).mean()) for n, c in _SIMULATED.items()} for f in frames)
    typer.echo(f"{'':38s}{'real':>10s}{'simulated':>12s}{'real / sim':>12s}")
    for name, value in real.items():
        other = simulated[name]
        shown = f"{value:10.0f}{other:12.0f}" if value > 50 else f"{value:10.3f}{other:12.3f}"
        typer.echo(f"{name:38s}{shown}{value / max(other, 1e-9):12.2f}")
    seen = [(f.points, f.boxes[(f.classes == VEHICLE) & (f.counts >= 150)]) for f in frames]
    for name, scans in (("KITTI", _labelled_cars(data)), ("simulated", seen)):
        ends = [end for points, boxes in scans for end in far_ends(points, boxes)]
        quantiles = ", ".join(f"{q:.2f}" for q in np.quantile(ends, [0.1, 0.25, 0.5, 0.75, 0.9]))
        typer.echo(f"far ends of {len(ends)} cars, {name}: {quantiles} m before the box's (10, 25, 50, 75, 90 %)")


if __name__ == "__main__":
    typer.run(main)
