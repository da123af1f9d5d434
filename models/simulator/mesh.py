"""Triangle shapes and the primitives that the simulated things are put together from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Shape", "box", "ellipsoid", "join", "leaves", "loft", "quad", "relief", "tube"]


@dataclass(frozen=True, eq=False)
class Shape:
    """A triangle mesh in its own frame: x forward, y left, z up, z = 0 on the ground."""

    vertices: np.ndarray
    """[m], shape (v, 3), float64."""
    faces: np.ndarray
    """Corners of each triangle, shape (f, 3), int32."""
    labels: np.ndarray
    """Material + 256 × class of each face, shape (f,), int32."""
    boxed: np.ndarray
    """Whether a vertex counts for the bounding box (a mirror does not), shape (v,), bool."""

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Shape:
        """The same, elsewhere [m]."""
        return Shape(self.vertices + np.array([x, y, z]), self.faces, self.labels, self.boxed)

    def turned(self, yaw: float) -> Shape:
        """The same, turned about z [rad]."""
        c, s = np.cos(yaw), np.sin(yaw)
        return Shape(
            self.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]), self.faces, self.labels, self.boxed
        )

    def tilted(self, pitch: float) -> Shape:
        """The same, turned about y [rad]; positive lowers the front."""
        c, s = np.cos(pitch), np.sin(pitch)
        return Shape(
            self.vertices @ np.array([[c, 0, -s], [0, 1.0, 0], [s, 0, c]]), self.faces, self.labels, self.boxed
        )

    def unboxed(self) -> Shape:
        """The same, not counting for the bounding box."""
        return Shape(self.vertices, self.faces, self.labels, np.zeros(len(self.vertices), bool))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of what counts for the bounding box."""
        vertices = self.vertices[self.boxed]
        return vertices.min(0), vertices.max(0)

    def centred(self) -> Shape:
        """The same, its bounding box centred over the origin and standing on z = 0."""
        low, high = self.bounds()
        return self.moved(-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2])


def _shape(vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray | int) -> Shape:
    faces = np.asarray(faces, np.int32).reshape(-1, 3)
    vertices = np.asarray(vertices, np.float64)
    if not isinstance(labels, np.ndarray):
        labels = np.full(len(faces), labels, np.int32)
    return Shape(vertices, faces, labels.astype(np.int32), np.ones(len(vertices), bool))


def join(*shapes: Shape) -> Shape:
    """All of them as one."""
    starts = np.cumsum([0, *(len(shape.vertices) for shape in shapes)])
    return Shape(
        np.concatenate([shape.vertices for shape in shapes]),
        np.concatenate([shape.faces + start for shape, start in zip(shapes, starts, strict=False)]).astype(np.int32),
        np.concatenate([shape.labels for shape in shapes]),
        np.concatenate([shape.boxed for shape in shapes]),
    )


def loft(sections: np.ndarray, labels: np.ndarray | int, *, closed: bool = False, caps: int | None = None) -> Shape:
    """The surface through a row of sections.

    Args:
        sections: Points of each section, shape (n, m, 3).
        labels: Of each cell between sections i, i+1 and points j, j+1: shape (n − 1, m − 1), one more column where
            `closed`; or one label for all.
        closed: Whether the last point of a section joins the first.
        caps: Label of the fans that close the first and the last section; None leaves them open.
    """
    n, m = sections.shape[:2]
    index = np.arange(n * m).reshape(n, m)
    if closed:
        index = np.concatenate([index, index[:, :1]], 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)
    cells = np.broadcast_to(np.asarray(labels, np.int32), a.shape)
    shape = _shape(sections.reshape(-1, 3), faces, np.repeat(cells.ravel(), 2))
    if caps is None:
        return shape
    rim = np.arange(m)
    fan = np.stack([np.full(m, n * m), rim, (rim + 1) % m], 1)
    far = np.stack([np.full(m, n * m + 1), (n - 1) * m + rim, (n - 1) * m + (rim + 1) % m], 1)
    middles = sections[[0, -1]].sum(1) / m
    return _shape(
        np.concatenate([shape.vertices, middles]),
        np.concatenate([shape.faces, fan, far]),
        np.concatenate([shape.labels, np.full(2 * m, caps)]),
    )


def quad(corners: np.ndarray, label: int) -> Shape:
    """A flat patch of four corners in turn, shape (4, 3)."""
    return _shape(corners, np.array([[0, 1, 2], [0, 2, 3]]), label)


_BOX_FACES = np.array(
    [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
     [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]]
)  # fmt: skip


def box(low: tuple[float, float, float], high: tuple[float, float, float], label: int) -> Shape:
    """A box along the axes between two corners."""
    x, y, z = (np.array([low[i], high[i]]) for i in range(3))
    vertices = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).transpose(2, 1, 0, 3).reshape(-1, 3)
    return _shape(vertices, _BOX_FACES, label)


_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])  # the indices of a cross product


def tube(path: np.ndarray, radius: np.ndarray | float, label: int, sides: int = 6, *, caps: bool = True) -> Shape:
    """A round bar along a path of n points, shape (n, 3), of one radius or one at each point [m]."""
    path = np.asarray(path, np.float64)
    along = np.empty_like(path)
    along[1:-1] = path[2:] - path[:-2]
    along[0], along[-1] = path[1] - path[0], path[-1] - path[-2]
    along /= np.sqrt((along * along).sum(1, keepdims=True)) + 1e-12
    # Any direction across the path does; the axis least along it is never parallel to it.
    axis = int(np.abs(along).max(0).argmin())
    u = np.zeros_like(along)
    u[:, (axis + 1) % 3], u[:, (axis + 2) % 3] = along[:, (axis + 2) % 3], -along[:, (axis + 1) % 3]
    u /= np.sqrt((u * u).sum(1, keepdims=True)) + 1e-12
    v = along[:, _NEXT] * u[:, _LAST] - along[:, _LAST] * u[:, _NEXT]
    angle = np.arange(sides) * (2 * np.pi / sides)
    ring = np.cos(angle)[None, :, None] * u[:, None] + np.sin(angle)[None, :, None] * v[:, None]
    radii = np.broadcast_to(np.asarray(radius, np.float64), len(path))[:, None, None]
    return loft(path[:, None] + radii * ring, label, closed=True, caps=label if caps else None)


def ellipsoid(
    centre: tuple[float, float, float], radii: tuple[float, float, float], label: int, rings: int = 5
) -> Shape:
    """An ellipsoid of `rings` belts and twice less two sides."""
    polar = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    sides = max(6, 2 * rings - 2)
    angle = np.arange(sides) * (2 * np.pi / sides)
    level = np.maximum(np.cos(polar), 1e-3)
    unit = np.stack(
        [level[:, None] * np.cos(angle), level[:, None] * np.sin(angle), np.repeat(np.sin(polar)[:, None], sides, 1)],
        -1,
    )
    return loft(np.asarray(centre) + unit * np.asarray(radii), label, closed=True)


def relief(u: np.ndarray, v: np.ndarray, depth: np.ndarray, labels: np.ndarray, reveal: int) -> Shape:
    """A wall with niches and ledges: a grid of rectangles, each at its own depth behind the plane y = 0.

    Args:
        u: Grid lines along x, ascending, shape (n,) [m].
        v: Grid lines along z, ascending, shape (m,) [m].
        depth: Of each cell along +y, negative where it stands out, shape (n − 1, m − 1) [m].
        labels: Of each cell, same shape.
        reveal: Label of the faces across, between cells of different depth.
    """
    i, j = np.meshgrid(np.arange(len(u) - 1), np.arange(len(v) - 1), indexing="ij")
    i, j, d = i.ravel(), j.ravel(), depth.ravel()
    corners = [np.stack([np.stack([u[i + a], d, v[j + b]], -1) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))], 1)]
    names = [np.asarray(labels).ravel()]
    left, right = depth[:-1], depth[1:]
    k, m = np.nonzero(left != right)
    corners.append(
        np.stack(
            [np.stack([u[k + 1], w[k, m], v[m + b]], -1) for w, b in ((left, 0), (right, 0), (right, 1), (left, 1))], 1
        )
    )
    names.append(np.full(len(k), reveal))
    low, high = depth[:, :-1], depth[:, 1:]
    k, m = np.nonzero(low != high)
    corners.append(
        np.stack(
            [np.stack([u[k + a], w[k, m], v[m + 1]], -1) for w, a in ((low, 0), (low, 1), (high, 1), (high, 0))], 1
        )
    )
    names.append(np.full(len(k), reveal))
    quads = np.concatenate(corners)
    first = 4 * np.arange(len(quads))[:, None, None]
    faces = first + np.array([[0, 1, 2], [0, 2, 3]])
    return _shape(quads.reshape(-1, 3), faces, np.repeat(np.concatenate(names), 2))


def leaves(centres: np.ndarray, size: float, label: int, random: np.random.Generator) -> Shape:
    """Loose triangles of about `size` [m] at random angles around each centre, shape (n, 3)."""
    n = len(centres)
    corners = random.normal(size=(n, 3, 3))
    corners *= size * random.uniform(0.5, 1.0, (n, 1, 1)) / np.linalg.norm(corners, axis=2, keepdims=True)
    return _shape((centres[:, None] + corners).reshape(-1, 3), np.arange(3 * n).reshape(n, 3), label)
