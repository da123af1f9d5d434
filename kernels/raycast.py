"""LiDAR ray casting: beams against instanced triangle meshes, and what a sensor makes of the echoes.

Two levels of bounding volumes: one over the instances of a scene, rebuilt whenever they move, and one a mesh, built
once. A ray is carried into the frame of each instance it may hit, so a thousand parked cars cost as little memory as
one. Every face has a label: its material in the low byte, its class above. A GPU casts each ray on its own, a CPU near
ones together, eight at once.

All that looks like chance (glass that lets a beam through, noise, lost echoes) is a hash of seed and beam, so the
same scene gives the same bytes again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .beams import MATERIALS, NO_HIT, first_hit, ray_of, turn_at, uniform
from .device import DEFAULT_DEVICE
from .interop import borrow, family_of, give
from .meshes import MeshSet
from .ray_packets import cast_packets, hit_packets
from .threads import launch_parts, run_together, thread_count

__all__ = ["MATERIALS", "LidarCast", "RayHits", "raycast"]

_MATERIAL_MASK = wp.constant(MATERIALS - 1)
_CLASS_SHIFT = wp.constant(8)
_REFLECTIVITY, _POROSITY, _LOSS, _GLOSS, _ROUGHNESS = (wp.constant(i) for i in range(5))
_NOWHERE = 1.0e9  # [m]
_BLOCK = wp.constant(256)  # beams of a part's turn


def _launch_in_parts(kernel: wp.Kernel, parts: int, n: int, device: str, inputs: list, outputs: list) -> None:
    """One beam a thread on a GPU; on a CPU parts, which take turns by blocks of beams."""
    if parts == 1 or wp.get_device(device).is_capturing:
        wp.launch(kernel, n, inputs=[0, 1, *inputs], outputs=outputs, device=device)
        return
    dim = -(-n // (int(_BLOCK) * parts)) * int(_BLOCK)
    launches = [
        wp.launch(kernel, dim, inputs=[part, parts, *inputs], outputs=outputs, device=device, record_cmd=True)
        for part in range(parts)
    ]
    run_together([launch.launch for launch in launches])


@wp.func
def _gauss(seed: wp.uint32, a: wp.uint32, b: wp.uint32) -> float:
    """A nearly normal number, within ± 3.5: the sum of four uniform ones, which needs no logarithm and no cosine."""
    u = uniform(seed, a, b) + uniform(seed + wp.uint32(1), a, b)
    v = uniform(seed + wp.uint32(2), a, b) + uniform(seed + wp.uint32(3), a, b)
    return (u + v - 2.0) * 1.7320508


@wp.kernel
def _cast(
    # in: beams
    beams_in: wp.array(dtype=wp.vec3),
    fraction_in: wp.array(dtype=wp.float32),
    pose_in: wp.array(dtype=wp.transform),
    max_range: float,
    seed_in: wp.array(dtype=wp.uint32),
    # in: scene
    scene_in: wp.array(dtype=wp.uint64),
    mesh_in: wp.array(dtype=wp.uint64),
    first_face_in: wp.array(dtype=wp.int32),
    rows_in: wp.array2d(dtype=wp.vec4),
    label_in: wp.array(dtype=wp.int32),
    material_in: wp.array2d(dtype=wp.float32),
    # out
    distance_out: wp.array(dtype=wp.float32),
    instance_out: wp.array(dtype=wp.int32),
    face_out: wp.array(dtype=wp.int32),
    hit_label_out: wp.array(dtype=wp.int32),
    normal_out: wp.array(dtype=wp.vec3),
):
    """Finds the first face that each beam does not pass through."""
    i = wp.tid()
    origin, direction = ray_of(i, beams_in, fraction_in, pose_in)
    distance, instance, face, label, normal = first_hit(
        i, origin, direction, max_range, seed_in[0], scene_in[0], mesh_in, first_face_in, rows_in, label_in,
        material_in,
    )  # fmt: skip
    distance_out[i] = distance
    instance_out[i] = instance
    face_out[i] = face
    hit_label_out[i] = label
    normal_out[i] = normal


@wp.kernel
def _sense(
    part: int,
    parts: int,
    # in: hits
    beams_in: wp.array(dtype=wp.vec3),
    fraction_in: wp.array(dtype=wp.float32),
    pose_in: wp.array(dtype=wp.transform),
    distance_in: wp.array(dtype=wp.float32),
    hit_label_in: wp.array(dtype=wp.int32),
    normal_in: wp.array(dtype=wp.vec3),
    material_in: wp.array2d(dtype=wp.float32),
    seed_in: wp.array(dtype=wp.uint32),
    # in: sensor
    min_range: float,
    reach: float,
    range_noise: float,
    drop_out: float,
    # out
    kept_out: wp.array(dtype=wp.int32),
    range_out: wp.array(dtype=wp.float32),
    intensity_out: wp.array(dtype=wp.float32),
):
    """Makes an echo of each hit: its noisy range and its intensity, or none where it is too weak."""
    i = (wp.tid() // _BLOCK * parts + part) * _BLOCK + wp.tid() % _BLOCK
    if i >= beams_in.shape[0]:
        return
    kept_out[i] = 0
    d = distance_in[i]
    if d < min_range or hit_label_in[i] < 0:
        return
    turn = turn_at(pose_in, fraction_in[i])
    cosine = wp.abs(wp.dot(wp.quat_rotate(turn, beams_in[i]), normal_in[i]))
    material = hit_label_in[i] & _MATERIAL_MASK
    seed = seed_in[0] ^ wp.uint32(0x5BD1E995)
    k = wp.uint32(i)
    reflectivity = material_in[material, _REFLECTIVITY]
    gloss = material_in[material, _GLOSS]
    # Rough surfaces send back more at a grazing angle than Lambert's law says; glossy paint has a lobe as well.
    texture = 1.0 + 0.2 * _gauss(seed, k, wp.uint32(1))
    root = wp.sqrt(cosine)
    slant = root * wp.sqrt(root)
    square = cosine * cosine
    lobe = gloss * square * square * square * square
    echo = reflectivity * texture * ((1.0 - gloss) * slant + lobe)
    # The signal falls with the square of the range: it is 1 at `reach` for a tenth of full reflectivity, face on,
    # and there half of the echoes are seen.
    signal = echo / (d * d) * (reach * reach) * 10.0
    cube = signal * signal * signal
    seen = cube / (1.0 + cube)
    chance = uniform(seed, k, wp.uint32(3))
    if chance > seen * (1.0 - drop_out) * (1.0 - material_in[material, _LOSS]):
        return
    kept_out[i] = 1
    roughness = material_in[material, _ROUGHNESS]
    spread = wp.sqrt(range_noise * range_noise + roughness * roughness)
    range_out[i] = wp.max(d + spread * _gauss(seed, k, wp.uint32(7)), min_range)
    # What is reported is compensated for range and in part for the angle, as sensors do.
    reported = reflectivity * texture * ((1.0 - gloss) * (0.5 + 0.5 * cosine) + lobe)
    intensity_out[i] = wp.clamp(reported, 0.0, 1.0)


@wp.kernel
def _compact(
    # in
    beams_in: wp.array(dtype=wp.vec3),
    kept_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    range_in: wp.array(dtype=wp.float32),
    intensity_in: wp.array(dtype=wp.float32),
    hit_label_in: wp.array(dtype=wp.int32),
    hit_instance_in: wp.array(dtype=wp.int32),
    beam_ring_in: wp.array(dtype=wp.uint16),
    beam_time_in: wp.array(dtype=wp.float32),
    # out
    points_out: wp.array(dtype=wp.vec4),
    ring_out: wp.array(dtype=wp.uint16),
    t_out: wp.array(dtype=wp.float32),
    point_class_out: wp.array(dtype=wp.int32),
    instance_out: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
):
    """Writes the echoes one after the other, in the order of the beams."""
    i = wp.tid()
    if i == kept_in.shape[0] - 1:
        count_out[0] = rank_in[i] + kept_in[i]
    if kept_in[i] == 0:
        return
    k = rank_in[i]
    p = range_in[i] * beams_in[i]
    points_out[k] = wp.vec4(p[0], p[1], p[2], intensity_in[i])
    ring_out[k] = beam_ring_in[i]
    t_out[k] = beam_time_in[i]
    point_class_out[k] = hit_label_in[i] >> _CLASS_SHIFT
    instance_out[k] = hit_instance_in[i]


@dataclass(frozen=True, kw_only=True)
class LidarCast:
    """A plan: casts the beams of one LiDAR sweep into a scene and makes points of the echoes.

    `place` takes the scene of the next sweeps from the host; `launch` allocates nothing and reads nothing back.
    """

    meshes: MeshSet
    """The meshes that instances may have."""
    beams: Any
    """Unit directions in the sensor's frame, in the order of firing; NumPy, shape (n, 3)."""
    ring: Any
    """Laser of each beam, NumPy, shape (n,), uint16."""
    time: Any
    """Time of each beam after the start of the sweep [s], NumPy, shape (n,)."""
    period: float = 0.1
    """Duration of a sweep [s]."""
    max_instances: int = 4096
    """Instances that a scene can have."""
    min_range: float = 0.9
    """No echo comes from nearer [m]."""
    max_range: float = 120.0
    """No echo comes from farther [m]."""
    reach: float = 60.0
    """Where a Lambertian target of 10 % reflectivity, face on, is seen half of the time [m]."""
    range_noise: float = 0.015
    """Standard deviation of a range [m]."""
    drop_out: float = 0.01
    """Share of the echoes that are lost for no reason."""
    method: str = "auto"
    """`packets` (eight rays at once, for a CPU), `single` (one a thread), or `auto`: `packets` on a CPU, else
    `single`."""

    def __post_init__(self):
        device, n = self.meshes.device, len(self.beams)
        if n == 0 or len(self.ring) != n or len(self.time) != n:
            raise ValueError(
                f"beams, ring and time must have one length > 0, not {n}, {len(self.ring)}, {len(self.time)}"
            )

        if self.method not in ("auto", "packets", "single"):
            raise ValueError(f"method must be 'auto', 'packets' or 'single', not {self.method!r}")
        if self.method == "packets" and device != DEFAULT_DEVICE:
            raise ValueError(f"method 'packets' is for the CPU, not for {device}")

        def hold(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def upload(values: Any, dtype: type, numpy_type: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values, numpy_type), dtype=dtype, device=device)

        time = np.asarray(self.time, np.float32)
        hold("_beams", upload(self.beams, wp.vec3, np.float32))
        hold("_ring", upload(self.ring, wp.uint16, np.uint16))
        hold("_time", upload(time, wp.float32, np.float32))
        hold("_fraction", upload(time / self.period, wp.float32, np.float32))
        hold("_pose", wp.zeros(2, dtype=wp.transform, device=device))
        hold("_seed", wp.zeros(1, dtype=wp.uint32, device=device))
        hold("_material", wp.zeros((MATERIALS, 5), dtype=wp.float32, device=device))
        hold("_scene", [])
        hold("_scene_id", wp.zeros(1, dtype=wp.uint64, device=device))
        hold("_mesh", wp.zeros(self.max_instances, dtype=wp.uint64, device=device))
        hold("_first_face", wp.zeros(self.max_instances, dtype=wp.int32, device=device))
        hold("_rows", wp.zeros((self.max_instances, 3), dtype=wp.vec4, device=device))
        for name, dtype in (
            ("distance", wp.float32), ("hit_instance", wp.int32), ("hit_face", wp.int32), ("hit_label", wp.int32),
            ("hit_normal", wp.vec3), ("_kept", wp.int32), ("_rank", wp.int32), ("_range", wp.float32),
            ("_intensity", wp.float32), ("points", wp.vec4), ("point_ring", wp.uint16), ("point_time", wp.float32),
            ("point_class", wp.int32), ("point_instance", wp.int32),
        ):  # fmt: skip
            hold(name, wp.zeros(n, dtype=dtype, device=device))
        hold("count", wp.zeros(1, dtype=wp.int32, device=device))
        hold("_parts", 1)
        hold("_packets", device == DEFAULT_DEVICE and self.method != "single")
        if self._packets:
            hold("_parts", min(thread_count(), -(-n // int(_BLOCK))))
            hold("_order", upload(_order_of(self.beams), wp.int32, np.int32))
            hold("_ray_origin", wp.zeros(n, dtype=wp.vec3, device=device))
            hold("_ray_direction", wp.zeros(n, dtype=wp.vec3, device=device))

    def set_materials(self, table: np.ndarray) -> None:
        """Sets the table of materials, shape (256, 5).

        Reflectivity, share of beams that pass, share of echoes that are lost, share of the echo that is a mirror's,
        all in [0, 1], and the depth over which the surface spreads its echoes, as leaves do [m].
        """
        if np.shape(table) != (MATERIALS, 5):
            raise ValueError(f"table must have shape ({MATERIALS}, 5), not {np.shape(table)}")
        self._material.assign(np.ascontiguousarray(table, np.float32))

    def place(self, mesh: np.ndarray, transforms: np.ndarray) -> None:
        """Sets the instances of the scene.

        Each beam tries the first instance first, so let that be the ground, which most beams hit.

        Args:
            mesh: Number of each instance's mesh in `meshes`, shape (k,).
            transforms: World from local, affine, shape (k, 4, 4).

        Raises:
            ValueError: There are none, or more than `max_instances`.
        """
        k = len(mesh)
        if not 0 < k <= self.max_instances or np.shape(transforms) != (k, 4, 4):
            raise ValueError(
                f"mesh must name 1 to {self.max_instances} instances and transforms be (k, 4, 4), "
                f"not {k} and {np.shape(transforms)}"
            )
        device = self.meshes.device
        host = self.meshes.instances(np.asarray(mesh), np.asarray(transforms, np.float64))
        # The first instance is tried before the tree is searched, so it is not in the tree.
        bounds = [host["lower"][1:], host["upper"][1:]]
        if k == 1:  # a tree needs something to hold: a point that no beam comes near
            bounds = [np.full((1, 3), _NOWHERE, np.float32)] * 2
        lower, upper = (wp.array(corners, dtype=wp.vec3, device=device) for corners in bounds)
        self._scene[:] = [wp.Bvh(lower, upper), lower, upper]
        self._scene_id.assign(np.array([self._scene[0].id], np.uint64))
        wp.copy(self._mesh, wp.array(host["mesh"], dtype=wp.uint64, device=device), count=k)
        wp.copy(self._first_face, wp.array(host["first_face"], dtype=wp.int32, device=device), count=k)
        wp.copy(self._rows, wp.array(host["rows"].reshape(k, 3, 4), dtype=wp.vec4, device=device), count=3 * k)

    def aim(self, start: np.ndarray, end: np.ndarray | None = None, seed: int = 0) -> None:
        """Sets the sensor's pose at start and end of the sweep, and the seed of its noise.

        Args:
            start: World from sensor, rigid, shape (4, 4).
            end: The same one period later; None for a sensor at rest.
            seed: Any integer.
        """
        rows: list[np.ndarray] = []
        for pose in (start, start if end is None else end):
            quaternion = wp.quat_from_matrix(wp.mat33(*np.asarray(pose, np.float64)[:3, :3].ravel()))
            row = np.array([*np.asarray(pose)[:3, 3], *quaternion])
            if rows and np.dot(rows[0][3:], row[3:]) < 0:
                row[3:] *= -1.0  # the same attitude, on the near side
            rows.append(row)
        self._pose.assign(np.array(rows, np.float32))
        self._seed.assign(np.array([seed & 0xFFFFFFFF], np.uint32))

    def launch(self) -> None:
        """Casts all beams; fills `points` (x y z in the sensor's frame, intensity) and its siblings, and `count`."""
        device, n = self.meshes.device, self._beams.shape[0]
        beams = [self._beams, self._fraction, self._pose, self.max_range, self._seed]
        scene = [self._scene_id, self._mesh, self._first_face, self._rows, self.meshes.labels, self._material]
        hits = [self.distance, self.hit_instance, self.hit_face, self.hit_label, self.hit_normal]
        if self._packets:
            rays = [self._ray_origin, self._ray_direction]
            launch_parts(cast_packets, self._parts, [self._order, *beams, *scene], [*rays, *hits])
        else:
            wp.launch(_cast, n, inputs=[*beams, *scene], outputs=hits, device=device)
        _launch_in_parts(
            _sense,
            self._parts,
            n,
            device,
            [
                self._beams, self._fraction, self._pose, self.distance, self.hit_label, self.hit_normal,
                self._material, self._seed, self.min_range, self.reach, self.range_noise, self.drop_out,
            ],
            [self._kept, self._range, self._intensity],
        )  # fmt: skip
        wp.utils.array_scan(self._kept, self._rank, inclusive=False)
        wp.launch(
            _compact,
            dim=n,
            inputs=[
                self._beams, self._kept, self._rank, self._range, self._intensity, self.hit_label,
                self.hit_instance, self._ring, self._time,
            ],
            outputs=[
                self.points, self.point_ring, self.point_time, self.point_class, self.point_instance, self.count,
            ],
            device=device,
        )  # fmt: skip


def _order_of(beams: Any) -> np.ndarray:
    """Beams in an order in which near ones follow each other: along a curve of Morton over azimuth and elevation."""
    x, y, z = np.asarray(beams, np.float64).T
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    cells = np.stack([azimuth + np.pi, elevation + 0.5 * np.pi]) / (2.0 * np.pi) * 65535.0
    key = cells.astype(np.uint32)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        key = (key | (key << np.uint32(shift))) & np.uint32(mask)
    return np.argsort(key[0] | (key[1] << np.uint32(1)), kind="stable")


@wp.kernel
def _first_hit(
    # in
    mesh: wp.uint64,
    origins_in: wp.array(dtype=wp.vec3),
    directions_in: wp.array(dtype=wp.vec3),
    max_distance: float,
    # out
    distance_out: wp.array(dtype=wp.float32),
    face_out: wp.array(dtype=wp.int32),
    normal_out: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    direction = wp.normalize(directions_in[i])
    hit = wp.mesh_query_ray(mesh, origins_in[i], direction, max_distance)
    if hit.result:
        distance_out[i] = hit.t
        face_out[i] = hit.face
        normal_out[i] = hit.normal
    else:
        distance_out[i] = wp.inf
        face_out[i] = NO_HIT
        normal_out[i] = wp.vec3(0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class RayHits:
    """What n rays hit, as arrays of the rays' own family."""

    distance: Any
    """Along the ray [m], inf where it hits nothing; shape (n,), float32."""
    face: Any
    """The face hit, −1 where none is; shape (n,), int32."""
    normal: Any
    """Of the face hit, zero where none is; shape (n, 3), float32."""


def raycast(vertices: Any, faces: Any, origins: Any, directions: Any, *, max_distance: float = 1.0e6) -> RayHits:
    """The first triangle that each ray hits.

    Args:
        vertices: Of the mesh [m], shape (v, 3).
        faces: Corners of each triangle, integers, shape (f, 3).
        origins: Of the rays [m], shape (n, 3).
        directions: Of the rays, of any length but zero, shape (n, 3).
        max_distance: Hits beyond are none [m].

    Raises:
        TypeError: Not arrays, or faces not of an integer type.
        ValueError: Other shapes, or lengths that differ.
    """
    family = family_of(origins, "origins")
    points, keep_points = borrow(vertices, wp.float32, (None, 3), "vertices")
    corners, keep_corners = borrow(faces, wp.int32, (None, 3), "faces")
    starts, keep_starts = borrow(origins, wp.float32, (None, 3), "origins")
    along, keep_along = borrow(directions, wp.float32, (None, 3), "directions")
    n = starts.shape[0]
    if along.shape[0] != n:
        raise ValueError(f"directions must be as many as origins, {n}, not {along.shape[0]}")
    if not corners.shape[0]:
        raise ValueError("faces must have at least one triangle")
    if not max_distance > 0:
        raise ValueError(f"max_distance must be > 0 m, not {max_distance}")
    device = starts.device
    distance = wp.empty(n, dtype=wp.float32, device=device)
    face = wp.empty(n, dtype=wp.int32, device=device)
    normal = wp.empty(n, dtype=wp.vec3, device=device)
    # The tree serves one call only: the quickest to build is the best.
    quick = {"bvh_constructor": "cubql", "bvh_leaf_size": 4} if str(device) == DEFAULT_DEVICE else {}
    mesh = wp.Mesh(points=points.view(wp.vec3).flatten(), indices=corners.flatten(), **quick)
    if n:
        inputs = [mesh.id, starts.view(wp.vec3).flatten(), along.view(wp.vec3).flatten(), float(max_distance)]
        outputs = [distance, face, normal]
        if str(device) == DEFAULT_DEVICE:
            launch_parts(hit_packets, min(thread_count(), -(-n // int(_BLOCK))), inputs, outputs)
        else:
            wp.launch(_first_hit, n, inputs=inputs, outputs=outputs, device=device)
    hits = RayHits(give(distance, family), give(face, family), give(normal, family))
    del keep_points, keep_corners, keep_starts, keep_along
    return hits
