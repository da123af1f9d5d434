"""Beams and the scenes they are cast into, for device code: where a beam goes, and which face it meets first."""

from __future__ import annotations

import warp as wp

from .device import DEFAULT_DEVICE  # noqa: F401  (starts Warp quietly)

__all__ = [
    "MATERIALS",
    "MAX_PASSES",
    "NO_HIT",
    "POROSITY",
    "STEP",
    "UNIFORM",
    "carried_back",
    "first_hit",
    "ray_of",
    "turn_at",
    "uniform",
    "world_normal",
]

MATERIALS = 256
"""Rows of a table of materials; the low byte of a face's label names its row."""
NO_HIT = wp.constant(-1)
"""The face, instance and label of a beam that meets nothing."""
POROSITY = wp.constant(1)
"""The column of a table of materials that says which share of beams goes through."""

MAX_PASSES = wp.constant(6)
"""Porous faces of one instance that a beam may meet, the last of which it does not pass: panes, leaves, fences."""
STEP = wp.constant(1.0e-3)
"""Beyond a porous face, where the beam goes on [m]."""

_MATERIAL_MASK = wp.constant(MATERIALS - 1)


UNIFORM = """
    unsigned int h = seed ^ (a * 2654435761u) ^ (b * 2246822519u);
    h = (h ^ (h >> 16)) * 2246822507u;
    h = (h ^ (h >> 13)) * 3266489909u;
    h = h ^ (h >> 16);
    return (float)(h >> 8) * (1.0f / 16777216.0f);
"""
"""What `uniform` does, for native code."""


@wp.func_native(UNIFORM)
def uniform(seed: wp.uint32, a: wp.uint32, b: wp.uint32) -> float:
    """A number in [0, 1) from a hash of three integers (the finaliser of MurmurHash3)."""


@wp.func
def turn_at(pose_in: wp.array(dtype=wp.transform), world: int, fraction: float) -> wp.quat:
    """The sensor's attitude within a sweep: between two near quaternions a chord does for the arc."""
    start = wp.transform_get_rotation(pose_in[2 * world])
    return wp.normalize(start + fraction * (wp.transform_get_rotation(pose_in[2 * world + 1]) - start))


@wp.func
def ray_of(
    i: int,
    world: int,
    beams_in: wp.array(dtype=wp.vec3),
    fraction_in: wp.array(dtype=wp.float32),
    pose_in: wp.array(dtype=wp.transform),
) -> tuple[wp.vec3, wp.vec3]:
    """Where a beam starts in its world, and in which direction."""
    f = fraction_in[i]
    start = wp.transform_get_translation(pose_in[2 * world])
    end = wp.transform_get_translation(pose_in[2 * world + 1])
    turn = turn_at(pose_in, world, f)
    return start + f * (end - start), wp.normalize(wp.quat_rotate(turn, beams_in[i]))


@wp.func
def carried_back(v: wp.vec3, angle: float) -> wp.vec3:
    """A vector of an instance's frame that has turned about its z axis by an angle [rad], in the frame unturned."""
    c = wp.cos(angle)
    s = wp.sin(angle)
    return wp.vec3(c * v[0] + s * v[1], c * v[1] - s * v[0], v[2])


@wp.func
def world_normal(n: wp.vec3, r0: wp.vec4, r1: wp.vec4, r2: wp.vec4) -> wp.vec3:
    """The normal of a face in the world, from that in its mesh's frame and the rows of local from world."""
    a0 = wp.vec3(r0[0], r0[1], r0[2])
    a1 = wp.vec3(r1[0], r1[1], r1[2])
    a2 = wp.vec3(r2[0], r2[1], r2[2])
    return wp.normalize(n[0] * a0 + n[1] * a1 + n[2] * a2)


@wp.func
def first_hit(
    i: int,
    origin: wp.vec3,
    direction: wp.vec3,
    fraction: float,
    max_range: float,
    seed: wp.uint32,
    scene: wp.uint64,
    first_item: int,
    mesh_in: wp.array(dtype=wp.uint64),
    first_face_in: wp.array(dtype=wp.int32),
    rows_in: wp.array2d(dtype=wp.vec4),
    motion_in: wp.array(dtype=wp.vec4),
    label_in: wp.array(dtype=wp.int32),
    material_in: wp.array2d(dtype=wp.float32),
) -> tuple[float, int, int, int, wp.vec3]:
    """The first face that a beam does not pass through: its distance, instance, face, label and normal.

    The instances of its world begin at `first_item`; each is where its motion has brought it at the beam's fraction
    of the sweep.
    """
    best = max_range
    best_instance = int(NO_HIT)
    best_face = int(NO_HIT)
    best_label = int(NO_HIT)
    best_normal = wp.vec3(0.0, 0.0, 0.0)
    found = int(0)
    item = int(0)  # the first instance comes first: its hit bounds the search among the others
    more = bool(True)
    query = wp.bvh_query_ray(scene, origin, direction)
    while more:
        at = first_item + item
        r0 = rows_in[at, 0]
        r1 = rows_in[at, 1]
        r2 = rows_in[at, 2]
        motion = motion_in[at]
        gone_by = fraction * wp.vec3(motion[0], motion[1], motion[2])
        turned = fraction * motion[3]
        start = origin - gone_by
        a0 = wp.vec3(r0[0], r0[1], r0[2])
        a1 = wp.vec3(r1[0], r1[1], r1[2])
        a2 = wp.vec3(r2[0], r2[1], r2[2])
        local = wp.vec3(wp.dot(a0, start) + r0[3], wp.dot(a1, start) + r1[3], wp.dot(a2, start) + r2[3])
        along = wp.vec3(wp.dot(a0, direction), wp.dot(a1, direction), wp.dot(a2, direction))
        if turned != 0.0:
            local = carried_back(local, turned)
            along = carried_back(along, turned)
        base = first_face_in[at]
        gone = float(0.0)
        passes = int(0)
        while passes < MAX_PASSES:
            passes += 1
            hit = wp.mesh_query_ray(mesh_in[at], local + gone * along, along, best - gone)
            if not hit.result:
                break
            t = gone + hit.t
            label = label_in[base + hit.face]
            porosity = material_in[label & _MATERIAL_MASK, POROSITY]
            through = porosity > 0.0 and uniform(seed + wp.uint32(item), wp.uint32(i), wp.uint32(hit.face)) < porosity
            if through and passes < MAX_PASSES:
                gone = t + STEP
                if gone >= best:
                    break
            else:
                if t < best or (t == best and item < best_instance):
                    best = t
                    best_instance = item
                    best_face = hit.face
                    best_label = label
                    n = hit.normal
                    if turned != 0.0:
                        n = carried_back(n, -turned)
                    best_normal = world_normal(n, r0, r1, r2)
                break
        more = wp.bvh_query_next(query, found, best)
        item = found + 1
    return wp.where(best_instance >= 0, best, 0.0), best_instance, best_face, best_label, best_normal
