"""How well the detection head does on real scans that it never saw: python -m warploom.bench.real_scans DATA.

DATA holds `kitti_object` (velodyne, calib, label_2), `kitti_tracking` (velodyne_packed/0000, calib, label_02) and
`semantic_kitti/range_64x1024`. Nothing here is trained on, and no threshold is chosen here.

KITTI: cars with 20 returns within 40 m are found within 1 m, vans within 1.5 m, pedestrians and cyclists (10 returns,
30 m) within 0.5 m. False is a vehicle in the camera's view and within 70 m that is farther than 2 m from every labelled
vehicle; real ones without a label count as false too. SemanticKITTI: the share of points on cars within 60 m that lie
in boxes of vehicles, grown by 0.1 m; false is a box with fewer than 3 points of any vehicle.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from ..models.classes import CYCLIST, PEDESTRIAN, VEHICLE
from ..models.detections import Detections
from ..models.geometry import KittiCalibration, points_in_boxes
from ..models.head import DetectionHead

_SENSOR_HEIGHT = 1.73
_IMAGE_WIDTH = 1242
_TASKS = {  # name: types of the labels, class, least returns, farthest [m], distance of centres [m]
    "cars": (("Car",), VEHICLE, 20, 40.0, 1.0),
    "cars within 0.5 m": (("Car",), VEHICLE, 20, 40.0, 0.5),
    "vans": (("Van",), VEHICLE, 20, 40.0, 1.5),
    "pedestrians": (("Pedestrian", "Person_sitting"), PEDESTRIAN, 10, 30.0, 0.5),
    "cyclists": (("Cyclist",), CYCLIST, 10, 30.0, 0.5),
}
_VEHICLES = ("Car", "Van", "Truck", "Tram", "Misc")
_SEMANTIC_CAR, _SEMANTIC_VEHICLES = 1, (1, 4, 5)

Scan = tuple[np.ndarray, dict[str, np.ndarray], KittiCalibration]


def unpack(path: Path) -> np.ndarray:
    """The points of a losslessly packed scan [m], shape (n, 3), float32."""
    low, middle, high = np.load(path)["planes"].astype(np.int64)
    zigzag = low | middle << 8 | high << 16
    return (np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1).T / 1000).astype(np.float32)


def kitti_scans(data: Path) -> Iterator[Scan]:
    """The object scans, and every fifth of tracking sequence 0000: points, boxes by type, calibration."""
    for path in sorted((data / "kitti_object" / "velodyne").glob("*.bin")):
        points = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]
        lines = (data / "kitti_object" / "label_2" / f"{path.stem}.txt").read_text().splitlines()
        calibration = KittiCalibration.read(data / "kitti_object" / "calib" / f"{path.stem}.txt")
        yield points, _boxes([line.split() for line in lines], calibration), calibration
    tracking = data / "kitti_tracking"
    rows = [line.split() for line in (tracking / "label_02" / "0000.txt").read_text().splitlines()]
    calibration = KittiCalibration.read(tracking / "calib" / "0000.txt")
    for path in sorted((tracking / "velodyne_packed" / "0000").glob("*.npz"))[::5]:
        labels = [row[2:] for row in rows if int(row[0]) == int(path.stem)]
        yield unpack(path), _boxes(labels, calibration), calibration


def _boxes(rows: list[list[str]], calibration: KittiCalibration) -> dict[str, np.ndarray]:
    """Labelled boxes in the LiDAR's frame, by type."""
    by_type: dict[str, list[list[float]]] = {}
    for row in rows:
        by_type.setdefault(row[0], []).append([float(value) for value in row[8:15]])
    return {kind: calibration.boxes_from_camera(np.array(some)) for kind, some in by_type.items() if kind != "DontCare"}


def _of(boxes: dict[str, np.ndarray], types: tuple[str, ...]) -> np.ndarray:
    return np.concatenate([np.empty((0, 7)), *(boxes[kind] for kind in types if kind in boxes)])


def _nearest(of: np.ndarray, to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each box's centre on the ground to the nearest of others, and which that is."""
    if len(of) == 0 or len(to) == 0:
        return np.full(len(of), np.inf), np.zeros(len(of), int)
    apart = np.linalg.norm(of[:, None, :2] - to[None, :, :2], axis=2)
    return apart.min(axis=1), apart.argmin(axis=1)


def score_kitti(scans: list[Scan], found: list[Detections], score: float) -> dict[str, str]:
    """The figures of the KITTI scans at one score, as texts by name."""
    hits, totals = Counter[str](), Counter[str]()
    false = 0
    yaw, size = [], []
    for (points, labelled, calibration), all_found in zip(scans, found, strict=True):
        sure = all_found.select(all_found.scores >= score)
        for task, (types, kind, returns, farthest, distance) in _TASKS.items():
            truth = _of(labelled, types)
            seen = points_in_boxes(points, truth).sum(axis=1) >= returns
            truth = truth[seen & (np.hypot(truth[:, 0], truth[:, 1]) < farthest)]
            boxes = sure.boxes[sure.classes == kind]
            apart, which = _nearest(truth, boxes)
            totals[task] += len(truth)
            hits[task] += int((apart < distance).sum())
            if task == "cars":
                right = apart < distance
                turn = boxes[which[right], 6] - truth[right, 6] if right.any() else np.empty(0)
                yaw += np.degrees(np.abs((turn + np.pi / 2) % np.pi - np.pi / 2)).tolist()
                size += (boxes[which[right], 3:6] - truth[right, 3:6]).tolist() if right.any() else []
        vehicles = sure.boxes[sure.classes == VEHICLE]
        pixels, depth = calibration.project(vehicles)
        in_view = (depth > 0) & (depth < 70) & (pixels[:, 0] > 0) & (pixels[:, 0] < _IMAGE_WIDTH)
        false += int((_nearest(vehicles[in_view], _of(labelled, _VEHICLES))[0] > 2.0).sum())
    figures = {task: f"{hits[task]}/{totals[task]}" for task in _TASKS}
    figures["false vehicles a scan"] = f"{false / len(scans):.2f}"
    if yaw:
        figures["yaw median, p90 [deg]"] = f"{np.median(yaw):.1f}, {np.percentile(yaw, 90):.1f}"
        figures["size error l w h [m]"] = ", ".join(f"{value:+.2f}" for value in np.mean(size, axis=0))
    return figures


def score_semantic(data: Path, head: DetectionHead, scores: list[float]) -> dict[float, dict[str, str]]:
    """The figures of the SemanticKITTI range images, by score."""
    inside, total, false, images = Counter[float](), 0, Counter[float](), 0
    for path in sorted((data / "semantic_kitti" / "range_64x1024").glob("*.npz")):
        image = np.load(path)
        hit = image["depth"] > 0
        points, labels = np.ascontiguousarray(image["xyz"][hit]), image["label"][hit]
        found = head.detect_points(points, _SENSOR_HEIGHT)
        images += 1
        car = (labels == _SEMANTIC_CAR) & (np.hypot(points[:, 0], points[:, 1]) < 60)
        vehicle = np.isin(labels, _SEMANTIC_VEHICLES)
        total += int(car.sum())
        for score in scores:
            boxes = found.boxes[(found.scores >= score) & (found.classes == VEHICLE)]
            within = points_in_boxes(points, boxes, margin=0.1)
            inside[score] += int((within.any(axis=0) & car).sum())
            false[score] += int(((within & vehicle).sum(axis=1) < 3).sum())
    return {
        score: {
            "car points in boxes": f"{100 * inside[score] / total:.1f} %",
            "false vehicles a scan": f"{false[score] / images:.2f}",
        }
        for score in scores
    }


def main(
    data: Annotated[Path, typer.Argument(help="Folder with kitti_object, kitti_tracking, semantic_kitti.")],
    head: Annotated[Path | None, typer.Option(help="A head's card; by default the one that ships.")] = None,
    scores: Annotated[
        list[float], typer.Option("--score", help="Scores to count from; may be given more than once.")
    ] = [0.3, 0.4, 0.5],  # noqa: B006
) -> None:
    """Prints a head's figures on real scans."""
    detector = DetectionHead(head, score_threshold=min(scores))
    scans = list(kitti_scans(data))
    found = [detector.detect_points(points, _SENSOR_HEIGHT) for points, _, _ in scans]
    semantic = score_semantic(data, detector, scores)
    for score in scores:
        typer.echo(f"score {score}: {len(scans)} KITTI scans")
        for name, figure in score_kitti(scans, found, score).items():
            typer.echo(f"  {name:<24} {figure}")
        typer.echo(f"score {score}: SemanticKITTI range images")
        for name, figure in semantic[score].items():
            typer.echo(f"  {name:<24} {figure}")


if __name__ == "__main__":
    typer.run(main)
