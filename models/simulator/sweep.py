"""One sweep of a LiDAR through a world: where everything is while the sensor turns, and the truth of what it saw."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from ...kernels.motion import compensate_motion
from ...kernels.raycast import LidarCast
from ...kernels.visibility import visible_shares
from .frame import SimulatedFrame
from .labels import GROUND_CLASSES, PointClass, material_table
from .library import Library
from .sensors import Lidar
from .world import World, tight_boxes

__all__ = ["START_NS", "caster", "compensated", "observe", "read_frame", "set_scene"]

START_NS = 1_700_000_000_000_000_000
"""Reference time of the first frame of a drive."""

_NO_MATERIAL = 255
_INSTANT = 1e-3  # [s] before and after a time, of the differences that stand for a velocity


def caster(
    library: Library, lidar: Lidar, period: float, *, worlds: int = 1, wetness: float = 0.0, things: int = 4096
) -> LidarCast:
    """The plan that casts the beams of a sensor into worlds of up to so many things each, the ground among them."""
    beams, ring, fraction = lidar.beams
    cast = LidarCast(
        meshes=library.meshes,
        beams=beams,
        ring=ring,
        time=fraction * period,
        period=period,
        worlds=worlds,
        max_instances=things,
        min_range=lidar.min_range,
        max_range=lidar.max_range,
        reach=lidar.reach,
        range_noise=lidar.range_noise,
        drop_out=lidar.drop_out,
        edge_share=lidar.edge_share,
        pulse=lidar.pulse,
        noise_label=_NO_MATERIAL + 256 * int(PointClass.NOISE),
    )
    cast.set_materials(material_table(wetness))
    return cast


def set_scene(
    world: World,
    cast: LidarCast,
    pose_at: Callable[[float], np.ndarray],
    t: float,
    *,
    turn: float,
    seed: int,
    polish: float = 1.0,
    number: int = 0,
) -> None:
    """Places a world and aims the sensor for the sweep about time t that lasts `turn` seconds, 0 for an instant."""
    first, last = t - 0.5 * turn, t + 0.5 * turn
    mesh = np.concatenate([[world.ground_mesh], world.meshes(world.phases(t))])
    before, *after = world.transforms(first, last) if turn else world.transforms(first)
    motion = np.zeros((len(mesh), 4))
    if turn:
        motion[1:] = world.motion_between(before, after[0])
    cast.place(mesh, np.concatenate([np.eye(4)[None], before]), motion, world=number)
    cast.aim(pose_at(first), pose_at(last), seed, world=number)
    cast.set_polish(polish, world=number)


def read_frame(
    world: World,
    cast: LidarCast,
    lidar: Lidar,
    pose_at: Callable[[float], np.ndarray],
    t: float,
    *,
    turn: float,
    index: int,
    version: int,
    visibility: bool,
    number: int = 0,
) -> SimulatedFrame:
    """The frame of a sweep that was cast as `set_scene` placed it."""
    n = int(cast.count.numpy()[number])
    first = number * len(cast.beams)
    own = slice(first, first + n)
    pose, phases = pose_at(t), world.phases(t)
    transforms, later, earlier = world.transforms(t, t + _INSTANT, t - _INSTANT)
    velocity = (later[:, :3, 3] - earlier[:, :3, 3]) / (2 * _INSTANT)  # central differences of exact paths
    # Echoes of rain have no instance, those of the ground have instance 0: both belong to nothing, and come first.
    owner = cast.point_instance.numpy()[own] + 1
    instance = np.concatenate([[-1, -1], world.ids])[owner]
    point_class = cast.point_class.numpy()[own].copy()
    times = cast.point_time.numpy()[own] - np.float32(0.5 * turn) if turn else np.zeros(n, np.float32)
    which = world.objects
    apart = np.linalg.norm(transforms[which, :2, 3] - pose[:2, 3], axis=1)
    which = which[apart < lidar.max_range]
    counts = np.bincount(owner, minlength=2 + len(world))[2 + which]
    seen_at = np.bincount(owner, times, minlength=2 + len(world))[2 + which] / np.maximum(counts, 1)
    ahead = pose_at(t + _INSTANT)[:3, 3] - pose_at(t - _INSTANT)[:3, 3]
    visible = None
    if visibility:
        surface = np.array([world.prototype(int(k), phases).surface for k in which]).reshape(len(which), -1, 3)
        visible = visible_shares(cast, pose[:3, 3], which + 1, surface, world=number)
    return SimulatedFrame(
        version=version,
        index=index,
        points=cast.points.numpy()[own].copy(),
        ring=cast.point_ring.numpy()[own].copy(),
        t=times,
        point_class=point_class,
        instance=instance,
        ground=point_class <= max(GROUND_CLASSES),
        boxes=tight_boxes(world, which, transforms, phases, pose),
        classes=world.classes[which],
        ids=world.ids[which],
        velocities=(velocity[which] @ pose[:3, :3])[:, :2].astype(np.float32),
        counts=counts.astype(np.int32),
        seen_at=seen_at.astype(np.float32),
        visible=visible,
        pose=pose,
        poses=np.stack([pose_at(t - 0.5 * turn), pose, pose_at(t + 0.5 * turn)]),
        pose_times=np.array([-0.5, 0.0, 0.5]) * turn,
        speed=float(np.linalg.norm(ahead) / (2 * _INSTANT)),
        lidar=lidar.name,
    )


def observe(
    world: World,
    cast: LidarCast,
    lidar: Lidar,
    pose_at: Callable[[float], np.ndarray],
    t: float,
    *,
    turn: float,
    seed: int,
    index: int,
    version: int,
    visibility: bool,
    polish: float = 1.0,
) -> SimulatedFrame:
    """Casts one sweep into the world about time t and gathers what is true of it.

    Args:
        world: What stands and moves.
        cast: From `caster`.
        lidar: The sensor.
        pose_at: World from sensor at a time [s].
        t: Reference time [s].
        turn: How long the sensor takes for a turn [s]; 0 for a sweep in an instant.
        seed: Of noise and loss.
        index: Number of the frame.
        version: Its stamp [ns].
        visibility: Whether to tell how much of each object can be seen, which costs a few thousand rays.
        polish: How far paint and glass mirror grazing beams away, 1 as on KITTI's cars on the whole.
    """
    pose_at = cache(pose_at)  # begin and end are asked for twice
    set_scene(world, cast, pose_at, t, turn=turn, seed=seed, polish=polish)
    cast.launch()
    return read_frame(
        world, cast, lidar, pose_at, t, turn=turn, index=index, version=version, visibility=visibility
    )  # fmt: skip


def compensated(frame: SimulatedFrame) -> np.ndarray:
    """The points of a frame as if all had been taken at its reference time, by the true motion of the ego vehicle.

    Things that move are as far from their box as they went between the reference time and their points' own.

    Returns:
        As `SimulatedFrame.points`.
    """
    if frame.pose_times[-1] == frame.pose_times[0]:
        return frame.points
    return compensate_motion(frame.points, frame.t, frame.poses, frame.pose_times.tolist(), 0.0)
