"""Scans with truth for the evaluation of a detection head, from data sets as they lie on disk and from the simulator.

A URI names each: `kitti:DIR?sequence=0000&every=5` (object or tracking set; scans in `velodyne` or, losslessly packed,
in `velodyne_packed`), `sim:street?seed=3&every=10` (a drive; `seeds=500-559`: one for each),
`sim:scenes?seeds=500-529&lidar=hdl64` (one scan of each random scene; people's boxes as labels have them, see
`models.training.frames.labelled_boxes`), `nuscenes:DIR` (key frames with an mmdetection3d `info.json`),
`range:DIR?labels=semantic_kitti` (range images with a class for each pixel). Every one takes `height`, the sensor's
above the ground [m].
"""

from __future__ import annotations

import json
import math
import pathlib
import urllib.parse
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ...errors import ConfigError, SourceError
from ...models.classes import BARRIER, CONE, CYCLIST, PEDESTRIAN, UNKNOWN, VEHICLE
from ...models.geometry import wrap_angle
from ...models.simulator import LIDARS, lidar_model
from ..sources.kitti_labels import KITTI_CLASSES
from ..sources.scan_files import read_scan
from .kitti_objects import KittiLabels, label_files, unpack_scan

__all__ = ["KINDS", "EvaluationFrame", "PointLabels", "evaluation_frames"]

KINDS = ("kitti", "sim", "nuscenes", "range")
"""What can stand before the colon of a URI."""

_KITTI_HEIGHT = 1.73
_NUSCENES_HEIGHT = 1.84
_NUSCENES_CLASSES = {
    "car": VEHICLE,
    "truck": VEHICLE,
    "trailer": VEHICLE,
    "bus": VEHICLE,
    "construction_vehicle": VEHICLE,
    "bicycle": CYCLIST,
    "motorcycle": CYCLIST,
    "pedestrian": PEDESTRIAN,
    "traffic_cone": CONE,
    "barrier": BARRIER,
}
_RANGE_LABELS = {  # name: cars, all vehicles, no label, height of the sensor [m]
    "semantic_kitti": ((1,), (1, 4, 5), 0, _KITTI_HEIGHT),
    "nuscenes": ((7,), (7, 8, 9), 10, _NUSCENES_HEIGHT),
}
_HELD_OUT = 1_000_000
"""Simulator seeds from here on are trained on."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PointLabels:
    """What each point of a scan is on, where there are no boxes."""

    car: np.ndarray
    """Shape (n,), bool."""
    vehicle: np.ndarray
    """Cars, trucks, buses; shape (n,), bool."""
    known: np.ndarray
    """Points that have a label at all: what is far is often left without; shape (n,), bool."""


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluationFrame:
    """One scan with what is true of it, in the sensor's frame: x forward, y left, z up."""

    name: str
    """Data set and number, unique in an evaluation."""
    kind: str
    """One of `KINDS`."""
    sensor: str
    """What took the scan, as far as the data tell; frames of several sensors are not scored together."""
    points: np.ndarray
    """Shape (n, 3 or more), float32."""
    sensor_height: float
    """Above the ground [m]."""
    boxes: np.ndarray
    """True objects, shape (m, 7), float64."""
    classes: np.ndarray
    """Indices into `models.classes.CLASSES`, shape (m,)."""
    types: tuple[str, ...]
    """As the data set has them."""
    counts: np.ndarray
    """Points on each object, shape (m,)."""
    velocities: np.ndarray
    """[m/s], NaN where unknown, shape (m, 2)."""
    kitti: KittiLabels | None = None
    """The rows of KITTI's label file, which are of the camera's view alone."""
    image: pathlib.Path | None = None
    """The left colour camera's."""
    point_labels: PointLabels | None = None
    visible: np.ndarray | None = None
    """How much of each object can be seen, 0 to 1, shape (m,); None where nothing tells."""


def evaluation_frames(uri: str) -> Iterator[EvaluationFrame]:
    """The frames of one data set.

    Raises:
        ConfigError: No such kind or key, a value that is not of its type, or no such data there; while iterating too.
        SourceError: A damaged file, while iterating.
    """
    kind, colon, rest = uri.partition(":")
    if not colon or kind not in KINDS:
        raise ConfigError(f"{uri}: expected one of {', '.join(f'{k}:…' for k in KINDS)}")
    place, _, query = rest.partition("?")
    keys = dict(urllib.parse.parse_qsl(query, keep_blank_values=True))
    if not place:
        raise ConfigError(f"{uri}: nothing after {kind}:")
    return {"kitti": _kitti, "sim": _simulated, "nuscenes": _nuscenes, "range": _range_images}[kind](uri, place, keys)


class _Keys:
    """The keys of a URI, each taken once and turned into its type."""

    def __init__(self, uri: str, keys: dict[str, str], known: tuple[str, ...]):
        unknown = sorted(set(keys) - set(known))
        if unknown:
            raise ConfigError(f"{uri}: unknown key {unknown[0]!r}; there are: {', '.join(known)}")
        self._uri, self._keys = uri, keys

    def get(self, name: str, kind: Callable, default):
        """A key's value, or the default where it is not given."""
        if name not in self._keys:
            return default
        try:
            return kind(self._keys[name])
        except ValueError:
            raise ConfigError(f"{self._uri}: {name} is {self._keys[name]!r}; expected {_EXPECTED[kind]}") from None


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError
    return value


def _every(text: str) -> int:
    step = int(text)
    if step < 1:
        raise ValueError
    return step


def _seeds(text: str) -> range:
    first, _, last = text.partition("-")
    seeds = range(int(first), int(last or first) + 1)
    if not seeds or seeds.start < 0:
        raise ValueError
    return seeds


_EXPECTED: dict[Callable, str] = {
    int: "a whole number",
    _number: "a number",
    _every: "a whole number from 1 on: each so manieth scan",
    _seeds: "a seed, or the first and the last of several, such as 500-529",
    lidar_model: f"one of {', '.join(LIDARS)}",
}


def _folder(uri: str, place: str, holds: str) -> pathlib.Path:
    """The folder that a URI names.

    Raises:
        ConfigError: There is none; the message says what it should hold.
    """
    root = pathlib.Path(place).expanduser()
    if not root.is_dir():
        what = "is no folder" if root.exists() else "is not there"
        raise ConfigError(f"{uri}: {root} {what}; expected a folder with {holds}")
    return root


def _kitti(uri: str, place: str, keys: dict[str, str]) -> Iterator[EvaluationFrame]:
    options = _Keys(uri, keys, ("sequence", "every", "height"))
    root = _folder(uri, place, "velodyne/ and label_2/ or label_02/, as KITTI's sets have them")
    height, step = options.get("height", _number, _KITTI_HEIGHT), options.get("every", _every, 1)
    for path, labels, image in label_files(root, options.get("sequence", str, None))[::step]:
        points = unpack_scan(path) if path.suffix == ".npz" else read_scan(path).points
        found = labels()
        there = np.array([kind in KITTI_CLASSES for kind in found.types], bool)
        types = tuple(kind for kind in found.types if kind in KITTI_CLASSES)
        boxes = found.calibration.boxes_from_camera(found.camera_boxes[there])
        yield EvaluationFrame(
            name="/".join([root.resolve().name, *path.relative_to(root).parts[1:-1], path.stem]),
            kind="kitti",
            sensor="hdl64",
            points=points,
            sensor_height=height,
            boxes=boxes,
            classes=np.array([KITTI_CLASSES[kind] for kind in types], np.int32),
            types=types,
            counts=found.points_in(points)[there],
            velocities=np.full((len(boxes), 2), np.nan),
            kitti=found,
            image=image,
        )


def _simulated(uri: str, place: str, keys: dict[str, str]) -> Iterator[EvaluationFrame]:
    from ...models.simulator import Simulator, sample_scene
    from ...models.training.frames import height_over_ground, labelled_boxes
    from .tracking_objects import drive_uris

    if place != "scenes" and "seeds" in keys:
        drives = drive_uris(uri)
        if drives == [uri]:
            raise ConfigError(f"{uri}: seeds is {keys['seeds']!r}; write it as 500-559")
        for drive in drives:
            yield from evaluation_frames(drive)
        return
    if place == "scenes":
        options = _Keys(uri, keys, ("seeds", "lidar", "height"))
        seeds = options.get("seeds", _seeds, range(500, 530))
        lidar = options.get("lidar", lidar_model, None)
        if seeds.stop > _HELD_OUT:
            raise ConfigError(f"{uri}: seeds from {_HELD_OUT} on are trained on; take lower ones")
        sensor = "drawn by seed" if lidar is None else lidar.name
        named = ((f"scene {seed}", sample_scene(seed, lidar=lidar, visibility=True)) for seed in seeds)
    else:
        options = _Keys(uri, keys, ("seed", "lidar", "duration", "rate", "every", "height", "mounting_height"))
        given = {"seed": int, "lidar": lidar_model, "duration": _number, "rate": _number, "mounting_height": _number}
        arguments = {name: options.get(name, kind, None) for name, kind in given.items() if name in keys}
        try:
            drive = Simulator(scenario=place, turning=False, visibility=True, **arguments)
        except ValueError as error:
            raise ConfigError(f"{uri}: {error}") from None
        sensor = drive.lidar.name
        steps = range(0, len(drive), options.get("every", _every, 1))
        named = ((f"{place} {drive.seed}, frame {index}", drive.frame(index)) for index in steps)
    height = options.get("height", _number, None)
    for name, frame in named:
        yield EvaluationFrame(
            name=name,
            kind="sim",
            sensor=sensor,
            points=frame.points,
            sensor_height=height_over_ground(frame.points, frame.ground) if height is None else height,
            boxes=labelled_boxes(np.asarray(frame.boxes, np.float64), frame.classes),
            classes=frame.classes,
            types=tuple("object" for _ in frame.classes),
            counts=frame.counts,
            velocities=np.asarray(frame.velocities, np.float64),
            visible=frame.visible,
        )


def _nuscenes(uri: str, place: str, keys: dict[str, str]) -> Iterator[EvaluationFrame]:
    options = _Keys(uri, keys, ("height", "info"))
    root = _folder(uri, place, "key frames of nuScenes and their info.json, as mmdetection3d writes it")
    path = root / options.get("info", str, "info.json")
    if not path.is_file():
        raise ConfigError(f"{uri}: {path} is not there; name mmdetection3d's info file with ?info=NAME")
    height = options.get("height", _number, _NUSCENES_HEIGHT)
    try:
        content = json.loads(path.read_text())
        names = {number: name for name, number in content["metainfo"]["categories"].items()}
        frames = [(each["lidar_points"]["lidar_path"], each["instances"]) for each in content["data_list"]]
        read = [(scan, [_instance(each, names) for each in objects]) for scan, objects in frames]
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{path}: not an mmdetection3d info file: {error!r}") from error
    for scan, objects in read:
        file = root / pathlib.Path(scan).name
        points = read_scan(file).points
        boxes = np.array([each[0] for each in objects], np.float64).reshape(-1, 7)
        yield EvaluationFrame(
            name=f"nuscenes/{file.name.split('__')[-1].split('.')[0]}",
            kind="nuscenes",
            sensor="hdl32",
            points=points,
            sensor_height=height,
            boxes=boxes,
            classes=np.array([_NUSCENES_CLASSES.get(each[1], UNKNOWN) for each in objects], np.int32),
            types=tuple(each[1] for each in objects),
            counts=np.array([each[2] for each in objects], np.int64),
            velocities=np.array([each[3] for each in objects], np.float64).reshape(-1, 2),
        )


def _instance(row: dict, names: dict[int, str]) -> tuple[list[float], str, int, list[float]]:
    """Box, type, points and velocity, turned so that x is forward."""
    x, y, z, length, width, height, yaw = (float(v) for v in row["bbox_3d"])
    vx, vy = (float(v) for v in row.get("velocity", (np.nan, np.nan)))
    box = [y, -x, z, length, width, height, float(wrap_angle(yaw - 0.5 * np.pi))]
    return box, names.get(row["bbox_label_3d"], "unknown"), int(row["num_lidar_pts"]), [vy, -vx]


def _range_images(uri: str, place: str, keys: dict[str, str]) -> Iterator[EvaluationFrame]:
    options = _Keys(uri, keys, ("labels", "height"))
    name = options.get("labels", str, "semantic_kitti")
    if name not in _RANGE_LABELS:
        raise ConfigError(f"{uri}: labels must be one of {', '.join(_RANGE_LABELS)}, not {name!r}")
    cars, vehicles, nothing, usual = _RANGE_LABELS[name]
    root = _folder(uri, place, "range images (.npz)")
    paths = sorted(root.glob("*.npz"))
    if not paths:
        raise ConfigError(f"{uri}: no range images (.npz) in {root}")
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as image:
                hit = image["depth"] > 0
                points, labels = np.ascontiguousarray(image["xyz"][hit], np.float32), image["label"][hit]
        except (OSError, KeyError, ValueError, IndexError) as error:
            raise SourceError(f"{path}: not a range image with xyz, depth and label: {error}") from error
        yield EvaluationFrame(
            name=f"{root.name}/{path.stem}",
            kind="range",
            sensor="x".join(map(str, hit.shape)),
            points=points,
            sensor_height=options.get("height", _number, usual),
            boxes=np.empty((0, 7)),
            classes=np.empty(0, np.int32),
            types=(),
            counts=np.empty(0, np.int64),
            velocities=np.empty((0, 2)),
            point_labels=PointLabels(
                car=np.isin(labels, cars), vehicle=np.isin(labels, vehicles), known=labels != nothing
            ),
        )
