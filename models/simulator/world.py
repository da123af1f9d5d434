"""A furnished street as the ray caster needs it: where everything is at a time, and the true boxes of objects."""

from __future__ import annotations

import numpy as np

from .library import Library, Prototype, object_class, prototype
from .street import Street, phase_of, travelled
from .terrain import Ground

__all__ = ["World", "place", "tight_boxes"]

# Things that stand upright whatever the slope; the others lie on the ground with all wheels.
_UPRIGHT = {"pedestrian", "stander", "tree", "facade", "lamp_post", "sign", "bollard", "bus_stop", "hydrant"}
_ANIMATED = ("pedestrian", "cyclist")


class World:
    """Everything on a street, by number; number k is instance k + 1 of the ray caster, whose first is the ground."""

    def __init__(self, street: Street, library: Library, ground: int = 0):
        things = street.things
        self.ground = street.ground
        self.library = library
        self.kind = things.kind
        self.variant = np.array(things.variant, np.int64)
        self.pose = np.array(things.pose, np.float64).reshape(-1, 4)
        self.scale = np.array(things.scale, np.float64).reshape(-1, 3)
        self.motion = np.array(things.motion, np.float64).reshape(-1, 4)
        self.classes = np.array([object_class(kind) for kind in things.kind], np.int32)
        self.upright = np.array([kind in _UPRIGHT for kind in things.kind], bool)
        self.objects = np.flatnonzero(self.classes >= 0)
        self.ids = np.full(len(self.kind), -1, np.int64)
        self.ids[self.objects] = 1 + np.arange(len(self.objects))
        self.start = street.random.random(len(self.kind))
        self.moves = np.flatnonzero(self.motion[:, 0] != 0)
        self.animated = np.flatnonzero([kind in _ANIMATED for kind in self.kind])
        self.ground_mesh = library.grounds[ground]
        library.meshes.replace(self.ground_mesh, *self.ground.mesh())
        self._mesh = np.array(
            [library.number(k, int(v)) for k, v in zip(self.kind, self.variant, strict=True)], np.int64
        )
        self._still = self._transforms(np.arange(len(self.kind)), 0.0)

    def __len__(self) -> int:
        return len(self.kind)

    def street_pose(self, which: np.ndarray, t: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """s, d and yaw against the street of things at time t."""
        gone = travelled(self.motion[which], t)
        s, d, yaw, _ = self.pose[which].T
        return s + gone * np.cos(yaw), d + gone * np.sin(yaw), yaw

    def _transforms(self, which: np.ndarray, t: float | np.ndarray) -> np.ndarray:
        s, d, yaw = self.street_pose(which, t)
        return place(self.ground, s, d, yaw, self.pose[which, 3], self.scale[which], self.upright[which])

    def transforms(self, *times: float) -> np.ndarray:
        """World from local of everything at each of some times, shape (times, k, 4, 4)."""
        transforms = np.tile(self._still, (len(times), 1, 1, 1))
        if len(self.moves):
            which, t = np.tile(self.moves, len(times)), np.repeat(times, len(self.moves))
            transforms[:, self.moves] = self._transforms(which, t).reshape(len(times), -1, 4, 4)
        return transforms

    def phases(self, t: float) -> np.ndarray:
        """The pose of each thing's limbs at time t, shape (k,)."""
        phases = np.zeros(len(self.kind), np.int64)
        gone = travelled(self.motion, t)
        for k in self.animated:
            phases[k] = phase_of(self.kind[k], gone[k], self.start[k])
        return phases

    def meshes(self, phases: np.ndarray) -> np.ndarray:
        """The number of each thing's mesh in the library."""
        mesh = self._mesh.copy()
        for k in self.animated:
            mesh[k] = self.library.number(self.kind[k], int(self.variant[k]), int(phases[k]))
        return mesh

    def prototype(self, k: int, phases: np.ndarray) -> Prototype:
        """What thing k is made from."""
        return prototype(self.kind[k], int(self.variant[k]), int(phases[k]))

    def motion_between(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """How far everything goes [m] and turns about its up axis [rad] between two transforms of it, shape (k, 4)."""
        motion = np.zeros((len(before), 4))
        motion[:, :3] = after[:, :3, 3] - before[:, :3, 3]
        moving = self.moves
        yaw = np.arctan2(after[moving, 1, 0], after[moving, 0, 0]) - np.arctan2(
            before[moving, 1, 0], before[moving, 0, 0]
        )
        motion[moving, 3] = (yaw + np.pi) % (2 * np.pi) - np.pi
        return motion


def place(
    ground: Ground,
    s: np.ndarray,
    d: np.ndarray,
    yaw: np.ndarray,
    lift: np.ndarray,
    scale: np.ndarray,
    upright: np.ndarray,
) -> np.ndarray:
    """World from local of things on the ground, shape (k, 4, 4); those not upright follow its slope."""
    x, y, bend = ground.to_world(s, d)
    z = ground.height(s, d) + lift
    along, across = ground.slope(s, d)
    along, across = np.where(upright, 0.0, along), np.where(upright, 0.0, across)
    return on_slope(x, y, z, yaw + bend, bend, along, across, scale)


def on_slope(
    x: np.ndarray,
    y: np.ndarray,
    z: np.ndarray,
    heading: np.ndarray,
    bend: np.ndarray,
    along: np.ndarray,
    across: np.ndarray,
    scale: np.ndarray,
) -> np.ndarray:
    """World from local of things with a heading on ground that rises along and across the street, shape (k, 4, 4)."""
    c, sn = np.cos(heading), np.sin(heading)
    # Rise along and across the street, as rise along the world's axes.
    gx = along * np.cos(bend) - across * np.sin(bend)
    gy = along * np.sin(bend) + across * np.cos(bend)
    forward = np.stack([c, sn, gx * c + gy * sn], 1)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up = np.stack([-gx, -gy, np.ones_like(gx)], 1)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    ux, uy, uz, fx, fy, fz = *up.T, *forward.T
    left = np.stack([uy * fz - uz * fy, uz * fx - ux * fz, ux * fy - uy * fx], 1)
    transforms = np.zeros((len(x), 4, 4))
    transforms[:, :3, :3] = np.stack([forward, left, up], 2) * scale[:, None, :]
    transforms[:, :3, 3] = np.stack([x, y, z], 1)
    transforms[:, 3, 3] = 1.0
    return transforms


def tight_boxes(
    world: World, which: np.ndarray, transforms: np.ndarray, phases: np.ndarray, pose: np.ndarray
) -> np.ndarray:
    """The tight upright box of each object in the sensor's frame, shape (k, 7), float32.

    Args:
        world: Where the objects are.
        which: Their numbers, shape (k,).
        transforms: World from local of everything.
        phases: Of everything.
        pose: World from sensor, shape (4, 4).
    """
    if not len(which):
        return np.empty((0, 7), np.float32)
    local = np.linalg.inv(pose) @ transforms[which]
    yaw = np.arctan2(local[:, 1, 0], local[:, 0, 0])
    hulls = [world.prototype(int(k), phases).hull for k in which]
    counts = np.array([len(hull) for hull in hulls])
    owner, first = np.repeat(np.arange(len(which)), counts), np.cumsum(counts) - counts
    hull = np.einsum("nij,nj->ni", local[owner, :3, :3], np.concatenate(hulls)) + local[owner, :3, 3]
    c, s = np.cos(yaw), np.sin(yaw)
    turned = np.stack(
        [hull[:, 0] * c[owner] + hull[:, 1] * s[owner], hull[:, 1] * c[owner] - hull[:, 0] * s[owner], hull[:, 2]], 1
    )
    low, high = np.minimum.reduceat(turned, first), np.maximum.reduceat(turned, first)
    x, y, z = (0.5 * (low + high)).T
    return np.column_stack([x * c - y * s, x * s + y * c, z, high - low, yaw]).astype(np.float32)
