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

from .beams import MATERIALS, NO_HIT, first_hit, ray_of
from .device import DEFAULT_DEVICE
from .echo_parts import ECHO_BLOCK, echo_part, pack_echoes
from .echoes import compact_echoes, make_echoes
from .interop import borrow, family_of, give
from .meshes import MeshSet
from .ray_packets import cast_packets, hit_packets
from .threads import launch_parts, thread_count

__all__ = ["MATERIALS", "LidarCast", "RayHits", "raycast"]

_NOWHERE = 1.0e9  # [m]
_BLOCK = int(ECHO_BLOCK)
# Of rain of 1 mm/h: what it takes of a signal both ways [1/m] (Goodin et al. 2019), and the share of beams that a drop
# sends back, a metre [1/m]: a judgement, 2 % of the beams within the first ten metres at 10 mm/h.
_RAIN_LOSS, _RAIN_ECHOES, _MOST_ECHOES = 0.02, 5.0e-4, 0.02


@wp.kernel
def _cast(
    # in: beams
    beams_in: wp.array(dtype=wp.vec3),
    fraction_in: wp.array(dtype=wp.float32),
    pose_in: wp.array(dtype=wp.transform),
    max_range: float,
    seed_in: wp.array(dtype=wp.uint32),
    # in: scenes
    max_instances: int,
    scene_in: wp.array(dtype=wp.uint64),
    mesh_in: wp.array(dtype=wp.uint64),
    first_face_in: wp.array(dtype=wp.int32),
    rows_in: wp.array2d(dtype=wp.vec4),
    motion_in: wp.array(dtype=wp.vec4),
    label_in: wp.array(dtype=wp.int32),
    material_in: wp.array2d(dtype=wp.float32),
    # out
    distance_out: wp.array(dtype=wp.float32),
    instance_out: wp.array(dtype=wp.int32),
    face_out: wp.array(dtype=wp.int32),
    hit_label_out: wp.array(dtype=wp.int32),
    normal_out: wp.array(dtype=wp.vec3),
):
    """Finds the first face that each beam does not pass through; the beams of one world after those of another."""
    k = wp.tid()
    n = beams_in.shape[0]
    world = k // n
    i = k - world * n
    origin, direction = ray_of(i, world, beams_in, fraction_in, pose_in)
    distance, instance, face, label, normal = first_hit(
        i, origin, direction, fraction_in[i], max_range, seed_in[world], scene_in[world], world * max_instances,
        mesh_in, first_face_in, rows_in, motion_in, label_in, material_in,
    )  # fmt: skip
    distance_out[k] = distance
    instance_out[k] = instance
    face_out[k] = face
    hit_label_out[k] = label
    normal_out[k] = normal


@dataclass(frozen=True, kw_only=True)
class LidarCast:
    """A plan: casts the beams of one LiDAR sweep into a scene and makes points of the echoes.

    `place` takes the scene of the next sweeps from the host; `launch` allocates nothing and reads nothing back.
    A plan of several `worlds` casts the same sensor's beams into each of them in one launch. What is documented as of
    shape (n,) then has worlds × n rows, those of world w from w × n on; `count` has one number a world.
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
    worlds: int = 1
    """Scenes that one launch casts into."""
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
    edge_share: float = 0.0
    """Share of the beams whose footprint reaches the next beam's surface: divergence over azimuth step, 0 to 1. The
    beam before and the one after, of the same ring, are its neighbours."""
    pulse: float = 1.0
    """Surfaces that are nearer to each other along a beam give one echo [m]."""
    noise_label: int = 0
    """Label of echoes that are of no face, as those of drops of rain."""
    method: str = "auto"
    """`packets` (eight rays at once, for a CPU), `single` (one a thread), or `auto`: `packets` on a CPU, else
    `single`."""

    def __post_init__(self):
        device, n = self.meshes.device, len(self.beams)
        if n == 0 or len(self.ring) != n or len(self.time) != n:
            raise ValueError(
                f"beams, ring and time must have one length > 0, not {n}, {len(self.ring)}, {len(self.time)}"
            )

        if self.worlds < 1:
            raise ValueError(f"worlds must be at least 1, not {self.worlds}")
        if not 0 <= self.edge_share <= 1:
            raise ValueError(f"edge_share must be 0 to 1, not {self.edge_share}")
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
        worlds, rooms = self.worlds, self.worlds * self.max_instances
        hold("_pose", wp.zeros(2 * worlds, dtype=wp.transform, device=device))
        hold("_seed", wp.zeros(worlds, dtype=wp.uint32, device=device))
        hold("_rain", wp.zeros(worlds, dtype=wp.vec2, device=device))
        hold("_polish", wp.full(worlds, 1.0, dtype=wp.float32, device=device))
        hold("_material", wp.zeros((MATERIALS, 6), dtype=wp.float32, device=device))
        hold("_scene", [None] * worlds)
        hold("_scene_id", wp.zeros(worlds, dtype=wp.uint64, device=device))
        hold("_mesh", wp.zeros(rooms, dtype=wp.uint64, device=device))
        hold("_first_face", wp.zeros(rooms, dtype=wp.int32, device=device))
        hold("_rows", wp.zeros((rooms, 3), dtype=wp.vec4, device=device))
        hold("_motion", wp.zeros(rooms, dtype=wp.vec4, device=device))
        for name, dtype in (
            ("distance", wp.float32), ("hit_instance", wp.int32), ("hit_face", wp.int32), ("hit_label", wp.int32),
            ("hit_normal", wp.vec3), ("_kept", wp.int32), ("_rank", wp.int32), ("_range", wp.float32),
            ("_intensity", wp.float32), ("_label", wp.int32), ("_instance", wp.int32), ("points", wp.vec4),
            ("point_ring", wp.uint16), ("point_time", wp.float32), ("point_class", wp.int32),
            ("point_instance", wp.int32),
        ):  # fmt: skip
            hold(name, wp.zeros(worlds * n, dtype=dtype, device=device))
        hold("count", wp.zeros(worlds, dtype=wp.int32, device=device))
        hold("_parts", 1)
        hold("_packets", device == DEFAULT_DEVICE and self.method != "single")
        if self._packets:
            hold("_parts", min(thread_count(), -(-n // _BLOCK)))
            hold("_order", upload(_order_of(self.beams), wp.int32, np.int32))
            hold("_ray_origin", wp.zeros(n, dtype=wp.vec3, device=device))
            hold("_ray_direction", wp.zeros(n, dtype=wp.vec3, device=device))

    def set_materials(self, table: np.ndarray) -> None:
        """Sets the table of materials, shape (256, 6).

        Reflectivity, share of beams that pass, share of echoes that are lost, share of the echo that is a mirror's,
        all in [0, 1], the depth over which the surface spreads its echoes, as leaves do [m], and the cosine of
        incidence at which the best polished thing sends half of the echoes elsewhere.
        """
        if np.shape(table) != (MATERIALS, 6):
            raise ValueError(f"table must have shape ({MATERIALS}, 6), not {np.shape(table)}")
        self._material.assign(np.ascontiguousarray(table, np.float32))

    def place(
        self, mesh: np.ndarray, transforms: np.ndarray, motion: np.ndarray | None = None, *, world: int = 0
    ) -> None:
        """Sets the instances of the scene.

        Each beam tries the first instance first, so let that be the ground, which most beams hit.

        Args:
            mesh: Number of each instance's mesh in `meshes`, shape (k,).
            transforms: World from local at the start of the sweep, affine, shape (k, 4, 4).
            motion: How far each instance goes along x, y, z [m] during the sweep, and by which angle it turns about
                its own z axis [rad], shape (k, 4); None: all stand still. One that turns is scaled evenly in plan.
            world: Which scene of a plan of several.

        Raises:
            ValueError: There are none, or more than `max_instances`, or no such world.
        """
        k = len(mesh)
        if not 0 < k <= self.max_instances or np.shape(transforms) != (k, 4, 4):
            raise ValueError(
                f"mesh must name 1 to {self.max_instances} instances and transforms be (k, 4, 4), "
                f"not {k} and {np.shape(transforms)}"
            )
        if motion is not None and np.shape(motion) != (k, 4):
            raise ValueError(f"motion must have shape ({k}, 4), not {np.shape(motion)}")
        self._check_world(world)
        device = self.meshes.device
        host = self.meshes.instances(np.asarray(mesh), np.asarray(transforms, np.float64), motion)
        # The first instance is tried before the tree is searched, so it is not in the tree.
        bounds = [host["lower"][1:], host["upper"][1:]]
        if k == 1:  # a tree needs something to hold: a point that no beam comes near
            bounds = [np.full((1, 3), _NOWHERE, np.float32)] * 2
        lower, upper = (wp.array(corners, dtype=wp.vec3, device=device) for corners in bounds)
        self._scene[world] = [wp.Bvh(lower, upper), lower, upper]
        self._scene_id[world : world + 1].assign(np.array([self._scene[world][0].id], np.uint64))
        first = world * self.max_instances
        for room, name, dtype in (
            (self._mesh, "mesh", wp.uint64), (self._first_face, "first_face", wp.int32),
            (self._motion, "motion", wp.vec4),
        ):  # fmt: skip
            wp.copy(room, wp.array(host[name], dtype=dtype, device=device), dest_offset=first, count=k)
        rows = wp.array(host["rows"].reshape(k, 3, 4), dtype=wp.vec4, device=device)
        wp.copy(self._rows, rows, dest_offset=3 * first, count=3 * k)

    def aim(self, start: np.ndarray, end: np.ndarray | None = None, seed: int = 0, *, world: int = 0) -> None:
        """Sets the sensor's pose at start and end of the sweep, and the seed of its noise.

        Args:
            start: World from sensor, rigid, shape (4, 4).
            end: The same one period later; None for a sensor at rest.
            seed: Any integer.
            world: Which scene of a plan of several.

        Raises:
            ValueError: There is no such world.
        """
        self._check_world(world)
        rows: list[np.ndarray] = []
        for pose in (start, start if end is None else end):
            quaternion = wp.quat_from_matrix(wp.mat33(*np.asarray(pose, np.float64)[:3, :3].ravel()))
            row = np.array([*np.asarray(pose)[:3, 3], *quaternion])
            if rows and np.dot(rows[0][3:], row[3:]) < 0:
                row[3:] *= -1.0  # the same attitude, on the near side
            rows.append(row)
        self._pose[2 * world : 2 * world + 2].assign(np.array(rows, np.float32))
        self._seed[world : world + 1].assign(np.array([seed & 0xFFFFFFFF], np.uint32))

    def set_rain(self, rate: float, *, world: int = 0) -> None:
        """Sets how hard it rains in a world [mm/h]; 0 is dry.

        Raises:
            ValueError: A rate that is negative or not finite, or no such world.
        """
        self._check_world(world)
        if not 0 <= rate < np.inf:
            raise ValueError(f"rate must be a number of mm/h from 0, not {rate}")
        density = rate**0.6
        row = [_RAIN_LOSS * density, min(_RAIN_ECHOES * density, _MOST_ECHOES)]
        self._rain[world : world + 1].assign(np.array([row], np.float32))

    def set_polish(self, polish: float, *, world: int = 0) -> None:
        """Sets how polished the glossy materials of a world are: a factor on the table's last column, 1 at first.

        Raises:
            ValueError: A factor that is negative or not finite, or no such world.
        """
        self._check_world(world)
        if not 0 <= polish < np.inf:
            raise ValueError(f"polish must be a number from 0, not {polish}")
        self._polish[world : world + 1].assign(np.array([polish], np.float32))

    def _check_world(self, world: int) -> None:
        if not 0 <= world < self.worlds:
            raise ValueError(f"world must be 0 to {self.worlds - 1}, not {world}")

    def scene(self, world: int = 0) -> list[Any]:
        """What device code needs to cast rays of its own into a world: seeds, trees, the world, and its instances."""
        self._check_world(world)
        return [
            self._seed, self._scene_id, world, self.max_instances, self._mesh, self._first_face, self._rows,
            self._motion, self.meshes.labels, self._material,
        ]  # fmt: skip

    def cast(self) -> None:
        """Finds what each beam hits: fills `distance`, `hit_instance`, `hit_face`, `hit_label` and `hit_normal`."""
        n = self._beams.shape[0]
        if self._packets:
            rays = [self._ray_origin, self._ray_direction]
            for world in range(self.worlds):
                rooms = slice(world * self.max_instances, (world + 1) * self.max_instances)
                here, own = slice(world, world + 1), slice(world * n, (world + 1) * n)
                inputs = [
                    self._order, self._beams, self._fraction, self._pose[2 * world : 2 * world + 2], self.max_range,
                    self._seed[here], self._scene_id[here], self._mesh[rooms], self._first_face[rooms],
                    self._rows[rooms], self._motion[rooms], self.meshes.labels, self._material,
                ]  # fmt: skip
                hits = [self.distance, self.hit_instance, self.hit_face, self.hit_label, self.hit_normal]
                launch_parts(cast_packets, self._parts, inputs, [*rays, *(array[own] for array in hits)])
            return
        wp.launch(
            _cast,
            self.worlds * n,
            inputs=[
                self._beams, self._fraction, self._pose, self.max_range, self._seed, self.max_instances,
                self._scene_id, self._mesh, self._first_face, self._rows, self._motion, self.meshes.labels,
                self._material,
            ],
            outputs=[self.distance, self.hit_instance, self.hit_face, self.hit_label, self.hit_normal],
            device=self.meshes.device,
        )  # fmt: skip

    def launch(self) -> None:
        """Casts all beams; fills `points` (x y z in the sensor's frame, intensity) and its siblings, and `count`.

        A point is where its beam met the thing, in the sensor's frame of that moment.
        """
        device, n = self.meshes.device, self.worlds * self._beams.shape[0]
        self.cast()
        given = [
            self._beams, self._fraction, self._ring, self._pose, self.distance, self.hit_label, self.hit_instance,
            self.hit_normal, self._material, self._seed, self._rain, self._polish, self.min_range, self.max_range,
            self.reach, self.range_noise, self.drop_out, self.edge_share, self.pulse, self.noise_label,
        ]  # fmt: skip
        echoes = [self._kept, self._range, self._intensity, self._label, self._instance]
        sensor = [self._ring, self._time]
        points = [self.points, self.point_ring, self.point_time, self.point_class, self.point_instance, self.count]
        if self._packets:
            launch_parts(echo_part, self._parts, given, echoes)
            wp.launch(pack_echoes, self.worlds, inputs=[self._beams, *echoes, *sensor], outputs=points, device=device)
            return
        wp.launch(make_echoes, n, inputs=given, outputs=echoes, device=device)
        wp.utils.array_scan(self._kept, self._rank, inclusive=False)
        wp.launch(
            compact_echoes,
            n,
            inputs=[self._beams, self._kept, self._rank, *echoes[1:], *sensor],
            outputs=points,
            device=device,
        )


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
            launch_parts(hit_packets, min(thread_count(), -(-n // _BLOCK)), inputs, outputs)
        else:
            wp.launch(_first_hit, n, inputs=inputs, outputs=outputs, device=device)
    hits = RayHits(give(distance, family), give(face, family), give(normal, family))
    del keep_points, keep_corners, keep_starts, keep_along
    return hits
