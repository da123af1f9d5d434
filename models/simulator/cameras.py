"""Pinhole cameras in the simulated world: flat-shaded images by ray casting, and the truth of the objects in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ...kernels.raycast import LidarCast
from ...kernels.visibility import visible_shares
from .arguments import check_numbers, check_pose, check_whole
from .labels import Material, PointClass, material_table
from .library import Library
from .sweep import set_scene
from .world import World

__all__ = ["Camera", "CameraFrame", "CameraView"]

_BODY_FROM_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
_SUN = np.array([0.35, 0.5, 0.8]) / np.linalg.norm([0.35, 0.5, 0.8])
_SKY, _HORIZON, _HAZE = np.array([105.0, 150, 215]), np.array([205.0, 215, 225]), 250.0  # [m] of the haze
_COLOURS = np.full((256, 3), 128.0)
for _material, _colour in {
    Material.ASPHALT: (72, 72, 76), Material.MARKING: (225, 225, 220), Material.PAVING: (140, 136, 130),
    Material.GRASS: (84, 128, 60), Material.BRICK: (150, 86, 70), Material.PLASTER: (214, 204, 184),
    Material.CONCRETE: (160, 160, 156), Material.WOOD: (132, 100, 66), Material.WINDOW: (70, 88, 104),
    Material.GLASS: (52, 64, 76), Material.TYRE: (28, 28, 30), Material.LAMP: (240, 230, 200),
    Material.PLATE: (235, 235, 235), Material.INTERIOR: (48, 46, 46), Material.BARK: (92, 74, 58),
    Material.LEAVES: (66, 112, 48), Material.METAL: (148, 152, 156), Material.SIGN: (200, 60, 50),
    Material.SKIN: (214, 170, 142), Material.SPOKES: (90, 90, 94), Material.MESH: (120, 124, 126),
    Material.PLASTIC: (232, 112, 36), Material.SOIL: (120, 98, 72), Material.CLOTH: (96, 110, 150),
    Material.DARK_CLOTH: (46, 48, 58), Material.DARK_PAINT: (44, 46, 52), Material.PAINT: (110, 116, 124),
    Material.BRIGHT_PAINT: (214, 214, 210),
}.items():  # fmt: skip
    _COLOURS[_material] = _colour
# Paint and clothes have a tint of the object's own.
_TINTED = (Material.PAINT, Material.DARK_PAINT, Material.BRIGHT_PAINT, Material.CLOTH, Material.DARK_CLOTH)


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """A pinhole camera without distortion; pixels are OpenCV's, integers at their centres."""

    name: str = "front"
    width: int = 640
    height: int = 360
    """[pixels]."""
    field_of_view: float = 70.0
    """Of the width [deg]."""
    lidar_from_body: np.ndarray = field(default_factory=lambda: np.eye(4))
    """Where the camera is: its body looks along x, with y to the left and z up; shape (4, 4)."""
    max_range: float = 150.0
    """Nothing is drawn beyond [m]."""

    def __post_init__(self):
        check_whole(self.width, "width", 1)
        check_whole(self.height, "height", 1)
        check_numbers(self, above_0=("field_of_view", "max_range"))
        if self.field_of_view >= 180:
            raise ValueError(f"field_of_view must be above 0 and below 180 degrees, not {self.field_of_view}")
        check_pose(self.lidar_from_body, "lidar_from_body")

    @property
    def intrinsics(self) -> np.ndarray:
        """Pixels from optical coordinates (x right, y down, z forward), shape (3, 3)."""
        focal = 0.5 * self.width / np.tan(np.deg2rad(0.5 * self.field_of_view))
        return np.array([[focal, 0, 0.5 * (self.width - 1)], [0, focal, 0.5 * (self.height - 1)], [0, 0, 1.0]])

    @property
    def lidar_from_camera(self) -> np.ndarray:
        """LiDAR's frame from optical coordinates, shape (4, 4)."""
        optical = np.eye(4)
        optical[:3, :3] = _BODY_FROM_OPTICAL
        return self.lidar_from_body @ optical

    @property
    def projection(self) -> np.ndarray:
        """Homogeneous pixels from the LiDAR's frame, shape (3, 4)."""
        return self.intrinsics @ np.linalg.inv(self.lidar_from_camera)[:3]

    @property
    def directions(self) -> np.ndarray:
        """Unit direction of each pixel's centre, row by row, in the body's frame, shape (height · width, 3)."""
        row, column = np.divmod(np.arange(self.width * self.height), self.width)
        rays = np.stack([column, row, np.ones(len(row))], 1) @ np.linalg.inv(self.intrinsics).T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return rays @ _BODY_FROM_OPTICAL.T


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraFrame:
    """One image and what is true of it."""

    version: int
    """Time of the exposure [ns]."""
    camera: Camera
    image: np.ndarray
    """Red, green, blue, shape (height, width, 3), uint8."""
    depth: np.ndarray
    """Along the optical axis [m], inf where there is sky; shape (height, width), float32."""
    instance: np.ndarray
    """Id of the object that a pixel shows, −1 for background; shape (height, width), int64."""
    point_class: np.ndarray
    """`PointClass` of each pixel, −1 for sky; shape (height, width), int32."""
    boxes: np.ndarray
    """Left, top, right, bottom of the pixels that show each object [pixels], shape (k, 4), float32."""
    ids: np.ndarray
    """Of the objects with at least one pixel, as in `SimulatedFrame`, shape (k,), int64."""
    classes: np.ndarray
    """Indices into `models.classes.CLASSES`, shape (k,), int32."""
    pixels: np.ndarray
    """How many pixels show each object, shape (k,), int32."""
    visible: np.ndarray
    """Share of each object that nothing hides from the camera, in or out of the image; shape (k,), float32."""
    pose: np.ndarray
    """World from the LiDAR's frame at the time of the exposure, shape (4, 4)."""


class CameraView:
    """Draws what a camera sees of a world; one plan for each camera."""

    def __init__(self, library: Library, camera: Camera):
        self.camera = camera
        n = camera.width * camera.height
        self._cast = LidarCast(
            meshes=library.meshes, beams=camera.directions, ring=np.zeros(n), time=np.zeros(n), min_range=0.1,
            max_range=camera.max_range,
        )  # fmt: skip
        self._cast.set_materials(material_table())
        upright = camera.directions @ camera.lidar_from_body[:3, :3].T
        share = np.clip(upright[:, 2:] * 2.5, 0.0, 1.0)
        self._background = _HORIZON + share * (_SKY - _HORIZON)

    def look(
        self, world: World, pose_at: Callable[[float], np.ndarray], t: float, *, version: int, seed: int = 0
    ) -> CameraFrame:
        """The image of a world at time t.

        Args:
            world: What stands and moves.
            pose_at: World from the LiDAR's frame at a time [s].
            t: Of the exposure [s].
            version: Its stamp [ns].
            seed: Of the grain of the image, and of what is seen through leaves.
        """
        camera, cast = self.camera, self._cast
        shape = (camera.height, camera.width)
        set_scene(world, cast, lambda at: pose_at(at) @ camera.lidar_from_body, t, turn=0.0, seed=seed)
        cast.cast()
        hit_label, normal = cast.hit_label.numpy(), cast.hit_normal.numpy()
        hit = hit_label >= 0
        owner = np.where(hit, cast.hit_instance.numpy() - 1, -1)
        point_class = np.where(hit, hit_label >> 8, -1).astype(np.int32)
        distance = cast.distance.numpy()
        forward = camera.directions[:, 0]

        image = self._background.copy()
        image[hit] = self._shaded(hit_label[hit], owner[hit], point_class[hit], normal[hit], distance[hit])
        image += np.random.default_rng([seed & 0x7FFFFFFF, 17]).normal(0, 2.0, (len(image), 1))

        instance = np.where(owner >= 0, world.ids[np.maximum(owner, 0)], -1).reshape(shape)
        rows, columns = np.divmod(np.flatnonzero(instance.ravel() >= 0), camera.width)
        ids, which, pixels = np.unique(instance[rows, columns], return_inverse=True, return_counts=True)
        low, high = np.full((len(ids), 2), np.inf), np.full((len(ids), 2), -np.inf)
        np.minimum.at(low, which, np.stack([columns, rows], 1))
        np.maximum.at(high, which, np.stack([columns, rows], 1))
        things = world.objects[ids - 1]
        phases, eye = world.phases(t), (pose_at(t) @ camera.lidar_from_body)[:3, 3]
        surface = np.array([world.prototype(int(k), phases).surface for k in things]).reshape(len(things), -1, 3)
        return CameraFrame(
            version=version,
            camera=camera,
            image=np.clip(image, 0, 255).astype(np.uint8).reshape(*shape, 3),
            depth=np.where(hit, distance * forward, np.inf).astype(np.float32).reshape(shape),
            instance=instance,
            point_class=point_class.reshape(shape),
            boxes=np.concatenate([low - 0.5, high + 0.5], 1).astype(np.float32),
            ids=ids,
            classes=world.classes[things],
            pixels=pixels.astype(np.int32),
            visible=visible_shares(cast, eye, things + 1, surface),
            pose=pose_at(t),
        )

    @staticmethod
    def _shaded(
        label: np.ndarray, owner: np.ndarray, point_class: np.ndarray, normal: np.ndarray, distance: np.ndarray
    ) -> np.ndarray:
        """Lambert's law under sun and sky, and haze with the distance."""
        material = label & 255
        colour = _COLOURS[material]
        hue = (owner[:, None] * np.array([0.618, 0.381, 0.236]) + np.array([0.0, 0.33, 0.67])) % 1.0
        own = np.isin(material, _TINTED) & (point_class != PointClass.BUILDING)
        colour = np.where(own[:, None], 0.55 * colour + 110.0 * hue, colour)
        # A face has two sides, of which the one seen is lit; the sky lights what looks up, the sun what faces it.
        light = 0.55 + 0.15 * np.abs(normal[:, 2]) + 0.4 * np.abs(normal @ _SUN)
        clear = np.exp(-distance / _HAZE)[:, None]
        return clear * colour * light[:, None] + (1 - clear) * _HORIZON
