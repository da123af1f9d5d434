"""Sets of triangle meshes on a device, each with its tree of bounding volumes, as the ray caster takes them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from .device import resolve_device

__all__ = ["MeshSet"]


class MeshSet:
    """Triangle meshes with a label for each face; a mesh is added once and then named by its number."""

    def __init__(self, device: str = "cpu", max_faces: int = 1 << 20):
        self.device = resolve_device(device)
        self.labels = wp.zeros(max_faces, dtype=wp.int32, device=self.device)
        self._meshes: list[wp.Mesh | None] = []
        self._first_face: list[int] = []
        self._room: list[int] = []
        self._bounds: list[np.ndarray] = []
        self._faces = 0
        # Packets of rays test a few faces a leaf in less time than it takes to go down to single ones.
        self._tree: dict[str, Any] = {"bvh_constructor": "sah", "bvh_leaf_size": 4} if self.device == "cpu" else {}

    def __len__(self) -> int:
        return len(self._meshes)

    def reserve(self, faces: int) -> int:
        """Keeps room for a mesh of up to `faces` triangles that `replace` will bring, and returns its number."""
        return self._append(None, faces, np.zeros((2, 3)))

    def replace(self, number: int, vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray) -> None:
        """Puts a mesh into a reserved place, instead of what was there.

        Raises:
            ValueError: Shapes do not fit, a corner does not exist, or there is no room for so many faces.
        """
        mesh, bounds = self._build(vertices, faces, labels)
        if len(faces) > self._room[number]:
            raise ValueError(f"faces must be at most {self._room[number]}, as reserved, not {len(faces)}")
        self._meshes[number], self._bounds[number] = mesh, bounds
        self._label(self._first_face[number], labels)

    def add(self, vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray) -> int:
        """Adds a mesh, builds its tree, and returns its number.

        Args:
            vertices: Shape (v, 3) [m].
            faces: Corners of each triangle, shape (f, 3).
            labels: Material + 256 × class of each face, shape (f,).

        Raises:
            ValueError: Shapes do not fit, a corner does not exist, or the set is full.
        """
        mesh, bounds = self._build(vertices, faces, labels)
        number = self._append(mesh, len(faces), bounds)
        self._label(self._first_face[number], labels)
        return number

    def _append(self, mesh: wp.Mesh | None, faces: int, bounds: np.ndarray) -> int:
        if self._faces + faces > self.labels.shape[0]:
            raise ValueError(f"max_faces must be at least {self._faces + faces}, not {self.labels.shape[0]}")
        self._meshes.append(mesh)
        self._first_face.append(self._faces)
        self._room.append(faces)
        self._bounds.append(bounds)
        self._faces += faces
        return len(self._meshes) - 1

    def _label(self, first: int, labels: np.ndarray) -> None:
        source = wp.array(np.ascontiguousarray(labels, np.int32), dtype=wp.int32, device=self.device)
        wp.copy(self.labels, source, dest_offset=first, count=len(labels))

    def _build(self, vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray) -> tuple[wp.Mesh, np.ndarray]:
        """The mesh with its tree, and its lowest and highest corner."""
        vertices = np.ascontiguousarray(vertices, np.float32)
        faces = np.ascontiguousarray(faces, np.int32)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise ValueError(f"vertices must be (v, 3), faces (f, 3), f > 0, not {vertices.shape} and {faces.shape}")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError(f"faces must name vertices 0 to {len(vertices) - 1}, not {faces.min()} to {faces.max()}")
        if np.shape(labels) != (len(faces),):
            raise ValueError(f"labels must have shape ({len(faces)},), not {np.shape(labels)}")
        mesh = wp.Mesh(
            points=wp.array(vertices, dtype=wp.vec3, device=self.device),
            indices=wp.array(faces.ravel(), dtype=wp.int32, device=self.device),
            **self._tree,
        )
        return mesh, np.stack([vertices.min(0), vertices.max(0)])

    def instances(
        self, mesh: np.ndarray, transforms: np.ndarray, motion: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        """What the ray caster needs to know of instances, as host arrays.

        Args:
            mesh: Number of each instance's mesh, shape (k,).
            transforms: World from local, affine (turned, scaled, moved), shape (k, 4, 4).
            motion: How far each goes [m] and turns about its z axis [rad], shape (k, 4); None: not at all. The bounds
                then hold the whole way.
        """
        if motion is None:
            motion = np.zeros((len(mesh), 4))
        bounds = np.array([self._bounds[m] for m in mesh], np.float64).reshape(-1, 2, 3)
        centre, half = bounds.mean(1), 0.5 * (bounds[:, 1] - bounds[:, 0])
        world = np.einsum("kij,kj->ki", transforms[:, :3, :3], centre) + transforms[:, :3, 3]
        reach = np.einsum("kij,kj->ki", np.abs(transforms[:, :3, :3]), half) + 1e-3
        # A corner that turns goes no farther than its distance from the axis times the angle.
        reach += np.linalg.norm(np.abs(world - transforms[:, :3, 3]) + reach, axis=1, keepdims=True) * np.abs(
            motion[:, 3:]
        )
        way = np.asarray(motion, np.float64)[:, :3]
        inverse = np.linalg.inv(transforms)[:, :3]
        return {
            "lower": (world - reach + np.minimum(way, 0.0)).astype(np.float32),
            "upper": (world + reach + np.maximum(way, 0.0)).astype(np.float32),
            "motion": np.asarray(motion, np.float32),
            "rows": inverse.astype(np.float32),
            "mesh": np.array([self._meshes[m].id for m in mesh], np.uint64),
            "first_face": np.array([self._first_face[m] for m in mesh], np.int32),
        }
