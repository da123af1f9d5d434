"""A perceived frame as a picture: the scene from behind and above, and the map beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import SinkError
from ...models.classes import CLASSES
from ...models.geometry import box_corners
from ..pipeline import PerceptionFrame

__all__ = ["CLASS_COLOURS", "draw_frame", "write_png"]

CLASS_COLOURS = {
    "vehicle": (255, 176, 59),
    "pedestrian": (255, 92, 138),
    "cyclist": (120, 220, 120),
    "cone": (255, 120, 30),
    "barrier": (220, 200, 90),
    "unknown": (84, 94, 112),
}
"""Red, green, blue of each class."""

_BACKDROP = np.array([16, 20, 28], np.uint8)
_GROUND_NEAR, _GROUND_FAR = np.array([88, 100, 118.0]), np.array([52, 62, 78.0])
_EYE, _TARGET = np.array([-22.0, 0.0, 14.0]), np.array([14.0, 0.0, -2.0])
_FOCAL = 0.9  # of the width
_NEAR = 1.0
_MAP_RANGE = 50.0
_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))


def draw_frame(frame: PerceptionFrame, width: int = 1600, height: int = 900) -> np.ndarray:
    """Draws points, boxes, tracks and velocities.

    Args:
        frame: What was perceived.
        width: Of the picture in pixels.
        height: Likewise.

    Returns:
        Red, green, blue, shape (height, width, 3), uint8.
    """
    canvas = np.broadcast_to(_BACKDROP, (height, width, 3)).copy()
    xyz = frame.points[:, :3].astype(np.float64)
    finite = np.isfinite(xyz).all(axis=1)
    xyz, colours = xyz[finite], _point_colours(frame)[finite]
    _draw_scene(canvas, frame, xyz, colours)
    side = min(height, width) * 2 // 5
    margin = height // 45
    inset = _draw_map(frame, xyz, colours, side)
    canvas[margin : margin + side, width - margin - side : width - margin] = inset
    foreground = int((~frame.objects.background).sum())
    _text(
        canvas,
        f"frame {frame.index}   {len(frame.points):,} points   {foreground} objects   "
        f"{int(frame.objects.background.sum())} background   {frame.latency.total_ms:.0f} ms",
        (margin, height - margin),
        (200, 208, 220),
        0.7,
    )
    return canvas


def write_png(path: Path, picture: np.ndarray) -> None:
    """Writes a picture of red, green, blue as PNG.

    Raises:
        SinkError: The file cannot be written.
    """
    import cv2

    done, data = cv2.imencode(".png", picture[:, :, ::-1])
    try:
        if not done:
            raise OSError("the picture cannot be encoded")
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise SinkError(f"{path}: cannot be written: {error}") from error


def _point_colours(frame: PerceptionFrame) -> np.ndarray:
    """Ground grey, obstacles by their height, the points of known objects in the colour of their class."""
    import cv2

    distance = np.clip(np.hypot(frame.points[:, 0], frame.points[:, 1]) / 60.0, 0.0, 1.0)[:, None]
    colours = _GROUND_NEAR + (_GROUND_FAR - _GROUND_NEAR) * np.nan_to_num(distance)
    height = np.clip(np.nan_to_num(frame.height) / 5.0, 0.0, 1.0)
    ramp = cv2.applyColorMap((90 + 150 * height).astype(np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    standing = ~frame.ground
    colours[standing] = ramp[standing]
    objects = frame.objects
    for box, class_index in zip(objects.boxes[~objects.background], objects.classes[~objects.background], strict=True):
        x, y = frame.points[:, 0] - box[0], frame.points[:, 1] - box[1]
        along, across = x * np.cos(box[6]) + y * np.sin(box[6]), y * np.cos(box[6]) - x * np.sin(box[6])
        inside = (np.abs(along) < box[3] / 2 + 0.1) & (np.abs(across) < box[4] / 2 + 0.1) & standing
        colours[inside] = CLASS_COLOURS[CLASSES[class_index]]
    return colours.astype(np.uint8)


def _camera() -> tuple[np.ndarray, np.ndarray]:
    """Rotation into the camera's axes (right, down, forward), and its place."""
    forward = (_TARGET - _EYE) / np.linalg.norm(_TARGET - _EYE)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward]), _EYE


def _draw_scene(canvas: np.ndarray, frame: PerceptionFrame, xyz: np.ndarray, colours: np.ndarray) -> None:
    import cv2

    height, width = canvas.shape[:2]
    rotation, eye = _camera()
    focal, centre = _FOCAL * width, np.array([width * 0.42, height * 0.5])

    def project(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen = (points - eye) @ rotation.T
        return centre + focal * seen[:, :2] / np.maximum(seen[:, 2:], _NEAR), seen[:, 2]

    pixels, depth = project(xyz)
    order = np.argsort(-depth)
    order = order[depth[order] > _NEAR]
    u, v = np.floor(pixels[order]).astype(np.int64).T
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        near = (depth[order] < 70.0) | (dx + dy == 0)
        kept = near & (u + dx >= 0) & (u + dx < width) & (v + dy >= 0) & (v + dy < height)
        canvas[v[kept] + dy, u[kept] + dx] = colours[order][kept]
    objects = frame.objects
    for i in np.argsort(objects.background)[::-1]:
        colour = CLASS_COLOURS[CLASSES[objects.classes[i]]]
        corners, depths = project(box_corners(objects.boxes[i : i + 1].astype(np.float64))[0])
        if depths.min() < 2 * _NEAR:
            continue
        thickness = 1 if objects.background[i] else 2
        for a, b in _EDGES:
            start, end = (tuple(int(value) for value in np.clip(corners[c], -10_000, 10_000)) for c in (a, b))
            cv2.line(canvas, start, end, colour, thickness, cv2.LINE_AA)
        if objects.background[i]:
            continue
        speed = float(np.hypot(*objects.velocities[i]))
        top = corners[np.argmin(corners[:, 1])]
        if 0 < top[0] < width and 0 < top[1] < height and depths.min() < 60.0:
            label = f"{CLASSES[objects.classes[i]]} {objects.ids[i]}" + (f"  {speed:.0f} m/s" if speed > 0.5 else "")
            _text(canvas, label, (int(top[0]) - 30, int(top[1]) - 6), colour, 0.45)


def _draw_map(frame: PerceptionFrame, xyz: np.ndarray, colours: np.ndarray, side: int) -> np.ndarray:
    """The scene from above, x up and y left."""
    import cv2

    canvas = np.broadcast_to(_BACKDROP // 2, (side, side, 3)).copy()
    scale = side / (2 * _MAP_RANGE)

    def pixel(points: np.ndarray) -> np.ndarray:
        return np.stack([side / 2 - points[:, 1] * scale, side / 2 - points[:, 0] * scale], axis=1)

    u, v = np.floor(pixel(xyz)).astype(np.int64).T
    kept = (u >= 0) & (u < side) & (v >= 0) & (v < side)
    order = np.argsort(xyz[kept, 2], kind="stable")
    canvas[v[kept][order], u[kept][order]] = colours[kept][order]
    objects = frame.objects
    for i in np.argsort(objects.background)[::-1]:
        colour = CLASS_COLOURS[CLASSES[objects.classes[i]]]
        corners = box_corners(objects.boxes[i : i + 1].astype(np.float64))[0]
        outline = pixel(corners[:4]).astype(np.int32)
        cv2.polylines(canvas, [outline], True, colour, 1, cv2.LINE_AA)
        if not objects.background[i]:
            ends = np.stack([objects.boxes[i, :2], objects.boxes[i, :2] + objects.velocities[i]]).astype(np.float64)
            start, end = (tuple(int(value) for value in point) for point in pixel(ends))
            cv2.line(canvas, start, end, (255, 255, 255), 1, cv2.LINE_AA)
    cv2.drawMarker(canvas, (side // 2, side // 2), (255, 255, 255), cv2.MARKER_TRIANGLE_UP, 10, 1)
    cv2.rectangle(canvas, (0, 0), (side - 1, side - 1), (70, 80, 96), 1)
    return canvas


def _text(canvas: np.ndarray, text: str, place: tuple[int, int], colour: tuple[int, int, int], size: float) -> None:
    import cv2

    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
