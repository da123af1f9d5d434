"""Pictures of evaluations."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping

import numpy as np

from ...models.evaluation.tracking import AverageMot

__all__ = ["draw_recall"]

_WIDTH, _HEIGHT, _MARGIN = 760, 460, 60
_COLOURS = ((196, 98, 11), (12, 65, 194), (61, 128, 21), (160, 60, 160))  # blue green red
_INK, _FAINT = (40, 40, 40), (220, 220, 220)


def draw_recall(path: pathlib.Path, title: str, averages: Mapping[float, AverageMot]) -> None:
    """Writes a picture of scaled MOTA over recall, a curve for each overlap."""
    import cv2

    image = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
    right, bottom = _WIDTH - _MARGIN, _HEIGHT - _MARGIN

    def place(recall: float, smota: float) -> tuple[int, int]:
        return round(_MARGIN + recall * (right - _MARGIN)), round(bottom - smota * (bottom - _MARGIN))

    def write(text: str, at: tuple[int, int], colour: tuple[int, int, int] = _INK) -> None:
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)

    for tick in np.linspace(0.0, 1.0, 6):
        cv2.line(image, place(tick, 0.0), place(tick, 1.0), _FAINT)
        cv2.line(image, place(0.0, tick), place(1.0, tick), _FAINT)
        write(f"{tick:.1f}", (place(tick, 0.0)[0] - 10, bottom + 20))
        write(f"{tick:.1f}", (_MARGIN - 34, place(0.0, tick)[1] + 5))
    write(f"{title}: sMOTA over recall", (_MARGIN, _MARGIN - 22))
    for number, (overlap, average) in enumerate(averages.items()):
        colour = _COLOURS[number % len(_COLOURS)]
        points = [place(r, s) for r, s in zip(average.recalls, average.smotas, strict=True)]
        if points:
            cv2.polylines(image, [np.array(points, np.int32)], False, colour, 2, cv2.LINE_AA)
        write(
            f"3D overlap {overlap:g}: sAMOTA {100 * average.samota:.2f}",
            (_MARGIN + 14, bottom - 14 - 20 * number),
            colour,
        )
    cv2.imwrite(str(path), image)
