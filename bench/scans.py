"""The clouds that are timed: a simulated street in several sizes, and real scans where they lie beside the checkout."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..models.evaluation.ground import RANGE_IMAGE_32, SEMANTIC_KITTI, SEMANTIC_KITTI_TRAIN, GroundLabels
from ..models.geometry import KittiCalibration, kitti_poses

if TYPE_CHECKING:
    from ..models.simulator import SimulatedFrame, Simulator

__all__ = ["CITY", "REAL", "SCANS", "SIZES", "LabelledScan", "Scans", "terrain_mesh"]

REAL, CITY = "KITTI", "KITTI 00"
"""The scans that are real, full sweeps of an HDL-64E, 123 and 125 thousand points: an open crossing, and a street
between houses (the first scans of SemanticKITTI's sequences 08 and 00)."""
SCANS = ("street 10k", "street 120k", "street 500k", REAL)
"""The clouds: every twelfth point of a simulated sweep of an HDL-64E, a whole one, four of them; a real one."""
SIZES = ("street 10k", "street 120k", "street 500k", "street 2M", REAL, CITY)
"""The same, two million points of seventeen sweeps, and the other real one: for the kernels that have goals."""

_SEED = 7


@dataclass(frozen=True, eq=False)
class LabelledScan:
    """A scan whose ground is known."""

    name: str
    """Of its file."""
    points: np.ndarray
    """x y z [m] and intensity, shape (n, 4), float32."""
    ground: np.ndarray
    """True where a point is ground, shape (n,), bool."""
    scored: np.ndarray
    """True where a point counts for the score, shape (n,), bool."""


class Scans:
    """Makes and reads each cloud once."""

    def __init__(self, data: Path | None):
        """Says where the real scans are.

        Args:
            data: The folder of real data; None where there is none.
        """
        self._data = data
        self._kept: dict[str, np.ndarray] = {}
        self._drives: dict[str, tuple[list[np.ndarray], np.ndarray]] = {}

    @functools.cached_property
    def street(self) -> list[SimulatedFrame]:
        """Twenty sweeps of an HDL-64E that is driven along a simulated street, 10 a second."""
        return [self._first_of_street, *(self._simulator.frame(index) for index in range(1, len(self._simulator)))]

    @functools.cached_property
    def _simulator(self) -> Simulator:
        from ..models.simulator import Simulator

        return Simulator(seed=_SEED, duration=2.0, turning=False)

    @functools.cached_property
    def _first_of_street(self) -> SimulatedFrame:
        return self._simulator.frame(0)

    def cloud(self, name: str) -> np.ndarray:
        """The cloud of this name, one of `SIZES`; shape (n, 4), float32.

        Raises:
            FileNotFoundError: It is the real one, and the real scans are not here.
        """
        if name not in self._kept:
            self._kept[name] = np.ascontiguousarray(self._make(name), np.float32)
        return self._kept[name]

    def _make(self, name: str) -> np.ndarray:
        if name in (REAL, CITY):
            sequence = "08" if name == REAL else "00"
            return _read_bin(self._folder("semantic_kitti/full") / f"{sequence}_000000.bin")
        first = self._first_of_street
        if name == "street 10k":
            return first.points[::12]
        if name == "street 120k":
            return first.points
        # Half or a tenth of a second of driving apart, all seen from the first sweep's sensor.
        if name == "street 500k":
            return np.concatenate([_seen_from(frame, first) for frame in self.street[::5]])
        if name == "street 2M":
            return np.concatenate([_seen_from(frame, first) for frame in self.street[:17]])[:2_000_000]
        raise ValueError(f"name must be one of {', '.join(SIZES)}, not {name!r}")

    def _folder(self, name: str) -> Path:
        if self._data is None or not (self._data / name).is_dir():
            raise FileNotFoundError(f"the real scans (../shared/data/{name}) are not here")
        return self._data / name

    def drive(self, name: str) -> tuple[list[np.ndarray], np.ndarray]:
        """The scans of a drive, each of shape (n, 4), float32, and its poses, first scan from each, shape (n, 4, 4).

        Args:
            name: `street`, the simulated one; or `KITTI`, ten seconds, with the poses of its GPS and IMU.

        Raises:
            FileNotFoundError: It is the real one, and the real scans are not here.
        """
        if name not in self._drives:
            self._drives[name] = self._street_drive() if name == "street" else self._kitti_drive()
        return self._drives[name]

    def _street_drive(self) -> tuple[list[np.ndarray], np.ndarray]:
        poses = np.stack([frame.pose for frame in self.street])
        return [frame.points for frame in self.street], np.linalg.inv(poses[0]) @ poses

    def _kitti_drive(self) -> tuple[list[np.ndarray], np.ndarray]:
        folder = self._folder("kitti_tracking")
        lidar_from_imu = KittiCalibration.read(folder / "calib" / "0000.txt").lidar_from_imu
        poses = kitti_poses(np.loadtxt(folder / "oxts" / "0000.txt"), lidar_from_imu)
        return [_unpack(path) for path in sorted((folder / "velodyne_packed" / "0000").glob("*.npz"))], poses

    def pair(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Two real scans half a metre apart, source and target, shape (n, 4), and target from source, shape (4, 4).

        Raises:
            FileNotFoundError: The real scans are not here.
        """
        folder = self._folder("registration_pair")
        clouds = [_read_ply(folder / f"{name}.ply") for name in ("source", "target")]
        return clouds[0], clouds[1], np.loadtxt(folder / "T_target_source.txt")

    @functools.cached_property
    def labelled(self) -> dict[str, list[LabelledScan]]:
        """The scans whose ground is labelled, by sensor and set.

        Raises:
            FileNotFoundError: The real scans are not here.
        """
        full = []
        for path in sorted(self._folder("semantic_kitti/full").glob("*.bin")):
            whole, partial = path.with_suffix(".label"), path.with_suffix(".partial_label_u8")
            if whole.exists():
                labels, meaning = np.fromfile(whole, np.uint32) & 0xFFFF, SEMANTIC_KITTI
            else:
                labels, meaning = np.fromfile(partial, np.uint8), SEMANTIC_KITTI_TRAIN
            full.append(_labelled(path.stem, _read_bin(path), labels, meaning))
        return {
            "KITTI, 64 beams, full scans": full,
            "KITTI, 64 beams, range images": self._range_images("semantic_kitti/range_64x1024", SEMANTIC_KITTI_TRAIN),
            "nuScenes, 32 beams, range images": self._range_images("nuscenes_range_32x1024", RANGE_IMAGE_32),
            "VLP-32, range images": self._range_images("ika_vlp32_range_32x240", RANGE_IMAGE_32),
        }

    def _range_images(self, folder: str, meaning: GroundLabels) -> list[LabelledScan]:
        scans = []
        for path in sorted(self._folder(folder).glob("*.npz")):
            image = np.load(path)
            seen = image["depth"].ravel() > 0
            points = np.column_stack([image["xyz"].reshape(-1, 3), image["intensity"].ravel()])[seen]
            scans.append(_labelled(path.stem, points, image["label"].ravel()[seen], meaning))
        return scans

    def elevations(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Tilted scans of 100,000 points and the ground beneath them: a smooth estimate from labelled points (GndNet).

        Returns:
            For each scan its points, shape (n, 4), and z of the ground [m] in squares of 1 m, row = x and column = y,
            both from −50 m, shape (100, 100), float32.

        Raises:
            FileNotFoundError: The real scans are not here.
        """
        scans = sorted(self._folder("gndnet/reduced_velo").glob("*.npy"))
        # Its rows are y: so the lowest points of the squares are near it, and not otherwise.
        return [
            (np.load(scan), np.load(scan.parent.parent / "gnd_labels" / scan.name).T.astype(np.float32))
            for scan in scans
        ]


def _read_bin(path: Path) -> np.ndarray:
    return np.fromfile(path, np.float32).reshape(-1, 4)


def _read_ply(path: Path) -> np.ndarray:
    raw = path.read_bytes()
    return np.frombuffer(raw[raw.index(b"end_header\n") + 11 :], np.float32).reshape(-1, 4).copy()


def _unpack(path: Path) -> np.ndarray:
    """The points of a losslessly packed scan, shape (n, 4), float32."""
    file = np.load(path)
    low, middle, high = file["planes"].astype(np.int64)
    zigzag = low | middle << 8 | high << 16
    xyz = np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1).T / 1000
    return np.column_stack([xyz, file["intensity_x100"] / 100]).astype(np.float32)


def _labelled(name: str, points: np.ndarray, labels: np.ndarray, meaning: GroundLabels) -> LabelledScan:
    return LabelledScan(name, np.ascontiguousarray(points, np.float32), *meaning.masks(labels))


def _seen_from(frame: SimulatedFrame, other: SimulatedFrame) -> np.ndarray:
    """The points of one frame in the sensor's frame of another, shape (n, 4)."""
    pose = np.linalg.inv(other.pose) @ frame.pose
    points = frame.points.copy()
    points[:, :3] = points[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    return points


def terrain_mesh(seed: int = _SEED) -> tuple[np.ndarray, np.ndarray]:
    """A hilly ground with blocks of houses and cars on it: vertices [m], shape (v, 3), and faces, shape (f, 3)."""
    random = np.random.default_rng(seed)
    side, extent = 200, 100.0
    steps = np.linspace(-extent, extent, side + 1)
    x, y = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    z = 0.3 * np.sin(x / 9.0) * np.cos(y / 13.0) - 1.73
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    quads = np.stack([corner, corner + side + 1, corner + side + 2, corner + 1], 1)
    vertices, faces = [np.stack([x, y, z], 1)], [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    cube = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)])
    cube_faces = np.array([
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ])  # fmt: skip
    count = sum(len(v) for v in vertices)
    for _ in range(600):
        radius, angle = random.uniform(6.0, extent), random.uniform(0, 2 * np.pi)
        size = random.uniform((0.5, 0.5, 1.0), (6.0, 6.0, 6.0))
        centre = np.array([radius * np.cos(angle), radius * np.sin(angle), size[2] / 2 - 1.7])
        vertices.append(cube * size + centre)
        faces.append(cube_faces + count)
        count += len(cube)
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32)
