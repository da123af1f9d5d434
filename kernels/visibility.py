"""How much of an instance can be seen from a place: rays to points on it, stopped by what stands before."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from .beams import first_hit

if TYPE_CHECKING:
    from .raycast import LidarCast

__all__ = ["visible_shares"]

_GAP = wp.constant(0.02)  # [m] before an instance, in which nothing hides it: what touches it
_MISSED, _HIDDEN, _SEEN = (wp.constant(i) for i in range(3))


@wp.kernel
def _look(
    # in
    origin: wp.vec3,
    fraction: float,
    max_range: float,
    target_in: wp.array(dtype=wp.vec3),
    owner_in: wp.array(dtype=wp.int32),
    seed_in: wp.array(dtype=wp.uint32),
    # in: scene
    scene_in: wp.array(dtype=wp.uint64),
    world: int,
    max_instances: int,
    mesh_in: wp.array(dtype=wp.uint64),
    first_face_in: wp.array(dtype=wp.int32),
    rows_in: wp.array2d(dtype=wp.vec4),
    motion_in: wp.array(dtype=wp.vec4),
    label_in: wp.array(dtype=wp.int32),
    material_in: wp.array2d(dtype=wp.float32),
    # out
    result_out: wp.array(dtype=wp.int32),
):
    """One ray a thread, from the origin to a point given in its owner's frame."""
    i = wp.tid()
    owner = owner_in[i]
    at = world * max_instances + owner
    r0 = rows_in[at, 0]
    r1 = rows_in[at, 1]
    r2 = rows_in[at, 2]
    motion = motion_in[at]
    gone = fraction * wp.vec3(motion[0], motion[1], motion[2])
    matrix = wp.mat33(r0[0], r0[1], r0[2], r1[0], r1[1], r1[2], r2[0], r2[1], r2[2])
    local = matrix * (origin - gone) + wp.vec3(r0[3], r1[3], r2[3])
    turned = fraction * motion[3]
    c = wp.cos(turned)
    s = wp.sin(turned)
    local = wp.vec3(c * local[0] + s * local[1], c * local[1] - s * local[0], local[2])
    result_out[i] = _MISSED
    hit = wp.mesh_query_ray(mesh_in[at], local, wp.normalize(target_in[i] - local), max_range * 2.0)
    if not hit.result:
        return
    # Scales are uneven, so the distance is that of the world.
    point = local + hit.t * wp.normalize(target_in[i] - local)
    along = wp.vec3(point[0] - local[0], point[1] - local[1], point[2] - local[2])
    along = wp.vec3(c * along[0] - s * along[1], s * along[0] + c * along[1], along[2])
    direction = wp.inverse(matrix) * along
    distance = wp.length(direction)
    if distance > max_range:
        return
    _distance, instance, _face, _label, _normal = first_hit(
        i, origin, direction / distance, fraction, wp.max(distance - _GAP, 0.0), seed_in[world], scene_in[world],
        world * max_instances, mesh_in, first_face_in, rows_in, motion_in, label_in, material_in,
    )  # fmt: skip
    result_out[i] = wp.where(instance < 0 or instance == owner, _SEEN, _HIDDEN)


def visible_shares(
    cast: LidarCast,
    origin: np.ndarray,
    instances: np.ndarray,
    targets: np.ndarray,
    *,
    fraction: float = 0.5,
    world: int = 0,
) -> np.ndarray:
    """The share of each instance, as placed, that nothing hides from a place.

    Panes, leaves and fences let their share of the rays through.

    Args:
        cast: A plan with its scene.
        origin: Where from, in the world [m], shape (3,).
        instances: Their numbers as in `place`, shape (k,).
        targets: Points on each in its own frame [m], shape (k, m, 3).
        fraction: When in the sweep.
        world: Which scene of a plan of several.

    Returns:
        In [0, 1], shape (k,), float32; 0 where none of the rays reaches the instance within the sensor's range.
    """
    k, m = np.shape(targets)[:2]
    if np.shape(instances) != (k,) or np.shape(targets) != (k, m, 3):
        raise ValueError(f"targets must be (k, m, 3) for instances (k,), not {np.shape(targets)}")
    if k * m == 0:
        return np.zeros(k, np.float32)
    device = cast.meshes.device
    result = wp.zeros(k * m, dtype=wp.int32, device=device)
    points = wp.array(np.ascontiguousarray(targets, np.float32).reshape(-1, 3), dtype=wp.vec3, device=device)
    owner = wp.array(np.repeat(np.asarray(instances, np.int32), m), dtype=wp.int32, device=device)
    wp.launch(
        _look,
        k * m,
        inputs=[
            wp.vec3(*(float(v) for v in origin)), float(fraction), cast.max_range, points, owner, *cast.scene(world),
        ],
        outputs=[result],
        device=device,
    )  # fmt: skip
    said = result.numpy().reshape(k, m)
    seen, reached = (said == int(_SEEN)).sum(1), (said != int(_MISSED)).sum(1)
    return (seen / np.maximum(reached, 1)).astype(np.float32)
