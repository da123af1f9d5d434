"""The report of an evaluation of detections: a page with the figures, and a picture of each scan from above."""

from __future__ import annotations

import html
import pathlib

import numpy as np

from ...models.classes import CLASSES, VEHICLE
from ...models.geometry import box_corners_bev
from .detection import DetectionEvaluation, lines_of
from .detection_outcomes import FrameOutcome

__all__ = ["draw_false", "draw_frame", "write_report"]

_HIT, _MISS, _FALSE = (60, 200, 60), (60, 60, 255), (0, 170, 255)  # blue green red
_FOUND, _EXCUSED, _DONT_CARE = (220, 190, 60), (200, 120, 220), (140, 140, 140)
_SCALE = 8.0  # pixels a metre
_CROP, _CROP_SCALE = 12.0, 20.0
_LEGEND = (
    "true objects: green found, red missed (at least 5 points); found boxes: cyan, false vehicles orange, "
    "real by review violet, in a DontCare area grey"
)


class _Map:
    """A picture from above, x up and y to the left."""

    def __init__(self, low: tuple[float, float], high: tuple[float, float], scale: float):
        size = (np.asarray(high) - low) * scale
        self.image = np.full((round(size[0]), round(size[1]), 3), 16, np.uint8)
        self._high, self._scale = np.asarray(high, float), scale

    def _pixels(self, xy: np.ndarray) -> np.ndarray:
        return ((self._high - xy) * self._scale)[:, ::-1]

    def points(self, xyz: np.ndarray) -> None:
        """Draws points, the higher the brighter."""
        pixels = np.floor(self._pixels(xyz[:, :2])).astype(np.int64)
        inside = ((pixels >= 0) & (pixels < self.image.shape[1::-1])).all(axis=1)
        pixels, z = pixels[inside], xyz[inside, 2]
        shade = np.clip(70 + 45 * (z - np.median(z) if len(z) else z), 50, 190).astype(np.uint8)
        order = np.argsort(shade, kind="stable")
        self.image[pixels[order, 1], pixels[order, 0]] = shade[order, None]

    def boxes(self, boxes: np.ndarray, colour: tuple[int, int, int], thickness: int = 1) -> None:
        """Draws outlines with a line from the centre to the front."""
        import cv2

        for box, corners in zip(boxes, box_corners_bev(boxes), strict=True):
            outline = np.rint(self._pixels(corners)).astype(np.int32)
            front = np.array([box[:2], box[:2] + 0.5 * box[3] * np.array([np.cos(box[6]), np.sin(box[6])])])
            start, end = np.rint(self._pixels(front)).astype(int).tolist()
            cv2.polylines(self.image, [outline], True, colour, thickness, cv2.LINE_AA)
            cv2.line(self.image, start, end, colour, thickness, cv2.LINE_AA)

    def text(self, lines: list[str]) -> None:
        """Writes lines at the top."""
        import cv2

        for row, line in enumerate(lines):
            cv2.putText(self.image, line, (8, 18 + 18 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (230, 230, 230), 1)

    def save(self, path: pathlib.Path) -> None:
        """Writes the picture."""
        import cv2

        cv2.imwrite(str(path), self.image)


def draw_frame(path: pathlib.Path, outcome: FrameOutcome, score: float) -> None:
    """Writes a picture of one scan from above: points, true objects found and missed, and what was found.

    Args:
        path: Of the picture, `.png`.
        outcome: The scan.
        score: Detections below are not drawn.
    """
    frame, found = outcome.frame, outcome.found
    ahead_only = frame.kind == "kitti"
    drawing = _Map(
        (-5.0, -40.0) if ahead_only else (-60.0, -60.0), (70.0, 40.0) if ahead_only else (60.0, 60.0), _SCALE
    )
    drawing.points(np.asarray(frame.points)[:, :3])
    sure = (found.scores >= score) & outcome.seen
    drawing.boxes(found.boxes[sure], _FOUND)
    hits = outcome.hits(score)
    known = np.array([CLASSES[index] != "unknown" for index in frame.classes], bool)
    drawing.boxes(frame.boxes[hits], _HIT, 2)
    drawing.boxes(frame.boxes[~hits & known & (frame.counts >= 5)], _MISS, 2)
    drawing.boxes(found.boxes[outcome.in_dont_care], _DONT_CARE, 2)
    drawing.boxes(found.boxes[outcome.false], _FALSE, 2)
    drawing.boxes(found.boxes[outcome.excused], _EXCUSED, 2)
    drawing.text([f"{frame.name}, score {score:g}: {int(hits.sum())} found, {len(outcome.false)} false vehicles"])
    drawing.save(path)


def draw_false(path: pathlib.Path, outcome: FrameOutcome, index: int) -> None:
    """Writes a picture of one detection: from above with all boxes round it, and from the camera where there is one.

    Args:
        path: Of the picture, `.png`.
        outcome: The scan.
        index: Of the detection.
    """
    import cv2

    frame, box = outcome.frame, outcome.found.boxes[index]
    low, high = box[:2] - 0.5 * _CROP, box[:2] + 0.5 * _CROP
    drawing = _Map((low[0], low[1]), (high[0], high[1]), _CROP_SCALE)
    points = np.asarray(frame.points)[:, :3]
    drawing.points(points[(np.abs(points[:, :2] - box[:2]) < 0.5 * _CROP).all(axis=1)])
    drawing.boxes(frame.boxes, _HIT)
    drawing.boxes(box[None], _FALSE, 2)
    drawing.text([frame.name, f"x {box[0]:.1f} y {box[1]:.1f}, score {outcome.found.scores[index]:.2f}"])
    image = cv2.imread(str(frame.image)) if frame.image is not None and frame.kitti is not None else None
    if image is not None and frame.kitti is not None:
        left, top, right, bottom = (round(float(v)) for v in frame.kitti.in_image(box[None])[0])
        cv2.rectangle(image, (left, top), (right, bottom), _FALSE, 1)
        margin = 40 + (right - left) // 2
        crop = image[max(top - margin, 0) : bottom + margin, max(left - margin, 0) : right + margin]
        height = drawing.image.shape[0]
        crop = cv2.resize(crop, (max(1, round(crop.shape[1] * height / crop.shape[0])), height))
        drawing.image = np.concatenate([drawing.image, crop], axis=1)
    drawing.save(path)


def write_report(result: DetectionEvaluation, out: pathlib.Path, *, pictures: int = 60) -> pathlib.Path:
    """Writes `report.html` with the figures, a picture of each scan and one of each false vehicle, into a folder.

    Args:
        result: Of the evaluation.
        out: The folder, made where it is not there.
        pictures: Most scans, and most false vehicles, to draw; the scans with most misses and false ones come first.

    Returns:
        The page.
    """
    folder = out / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    score = result.score
    outcomes = sorted(result.outcomes, key=lambda each: -_faults(each, score))
    parts = [
        "<!doctype html><meta charset='utf-8'><title>Detection</title>",
        "<style>body{font:14px sans-serif;margin:2em;max-width:110em}img{max-width:100%}figure{display:inline-block;"
        "margin:.5em;vertical-align:top}</style>",
        f"<h1>{html.escape(str(result.head['name']))} from score {score:g}</h1>",
        f"<pre>{html.escape(chr(10).join(lines_of(result)))}</pre><h2>False vehicles</h2>",
        "<p>For each: is it a real vehicle that the labels lack? Then note its frame and place in a review file.</p>",
    ]
    drawn = 0
    for outcome in result.outcomes:
        for index in outcome.false[: max(0, pictures - drawn)]:
            drawn += 1
            name = f"false_{drawn:03d}.png"
            draw_false(folder / name, outcome, int(index))
            x, y = outcome.found.boxes[index, :2]
            note = f"{{frame: {outcome.frame.name}, at: [{x:.1f}, {y:.1f}]}}"
            parts.append(_figure(name, note))
    parts += ["<h2>Scans</h2>", f"<p>{html.escape(_LEGEND)}</p>"]
    for number, outcome in enumerate(outcomes[:pictures], 1):
        name = f"scan_{number:03d}.png"
        draw_frame(folder / name, outcome, score)
        parts.append(_figure(name, outcome.frame.name))
    page = out / "report.html"
    page.write_text("\n".join(parts) + "\n", encoding="utf-8")
    return page


def _figure(name: str, caption: str) -> str:
    return f"<figure><img src='pictures/{name}' loading='lazy'><figcaption>{html.escape(caption)}</figcaption></figure>"


def _faults(outcome: FrameOutcome, score: float) -> int:
    """Vehicles missed that have 20 points, and false ones."""
    frame = outcome.frame
    missed = ~outcome.hits(score) & (frame.classes == VEHICLE) & (frame.counts >= 20)
    return int(missed.sum()) + len(outcome.false)
