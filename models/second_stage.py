"""The second stage of a head: a small network looks at the points of each candidate and says what it is and where.

A first stage sees cells of a quarter of a metre; a person's shape, or what a wall lacks of a car, is in the points. The
candidates' points are gathered by our kernel where ONNX Runtime reads them, and another makes boxes of what it says.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import warp as wp

from ..errors import ModelError
from ..kernels.box_points import BOX_CHANNELS, POINT_CHANNELS, BoxPoints
from ..kernels.box_rescore import RESIDUALS, BoxRescore
from ..kernels.decode import CenterDecode
from ..kernels.nms import RotatedNms
from ..kernels.threads import run_together
from .card import HeadCard, SecondSpec
from .network import Network

__all__ = ["SecondStage"]

_AT_ONCE = 8  # candidates in a run on a CPU: what is between the layers stays in its cache


class _Look:
    """The kernels of one cloud of a batch, and its rows of what the network reads and writes."""

    def __init__(self, card: HeadCard, spec: SecondSpec, capacity: int, arrays: Sequence[wp.array], device: str):
        low, high = card.input.point_range[:2], card.input.point_range[3:5]
        self.arrays = arrays
        self.gather = BoxPoints(
            capacity=capacity,
            boxes=spec.max_boxes,
            points_of_box=spec.points_of_box,
            classes=len(card.classes),
            around=spec.around,
            over_bottom=spec.over_bottom,
            over_top=spec.over_top,
            origin=low,
            size=(high[0] - low[0], high[1] - low[1]),
            points=arrays[0],
            described=arrays[1],
            device=device,
        )
        self.rescore = BoxRescore(
            boxes=spec.max_boxes,
            candidates=card.decode.max_objects,
            moved=tuple(name in spec.moved for name in card.classes),
            size_shares=tuple(spec.size_shares.get(name, 1.0) for name in card.classes),
            powers=tuple(spec.powers.get(name, 1.0) for name in card.classes),
            weights=spec.weights,
            device=device,
        )
        self.nms = RotatedNms(
            capacity=spec.max_boxes,
            threshold=card.decode.nms_iou,
            max_output=min(spec.max_boxes, card.decode.max_objects),
            device=device,
        )


class SecondStage:
    """The second stage of a card, loaded and bound to its buffers.

    Args:
        card: With `second`.
        folder: Where the card is.
        device: Where the kernels run.
        threads: CPU threads that the network's candidates are shared out among.
        precision: As of `network.Network`.
        providers: As of `network.Network`.
        capacity: Most points of a cloud.
        batch: Clouds at once.

    Raises:
        ModelError: The network does not fit the card.
    """

    def __init__(
        self,
        card: HeadCard,
        folder: Path,
        *,
        device: str,
        threads: int,
        precision: str,
        providers: Sequence[str] | None,
        capacity: int,
        batch: int,
    ):
        assert card.second is not None
        self._spec = spec = card.second
        model, rows = folder / spec.file, spec.max_boxes
        inputs = {
            "points": (spec.points_of_box, len(POINT_CHANNELS)),
            "boxes": (len(BOX_CHANNELS) + len(card.classes),),
        }
        outputs = {"said": (2 + len(card.classes) + len(RESIDUALS),)}
        # On a CPU it is known how many candidates there are, and the network looks at no more: some of them on each
        # thread, for within so small a network there is nothing to share.
        self._counted = device == "cpu"
        self._networks = [
            Network(
                model,
                {name: (None, *shape) for name, shape in inputs.items()},
                {name: (None, *shape) for name, shape in outputs.items()},
                device=device,
                threads=1,
                precision=precision,
                providers=providers,
                classes=card.classes,
            )
            for _ in range(min(threads, -(-rows // _AT_ONCE)) if self._counted else 1)
        ]
        self.provider, self.fallback = self._networks[0].provider, self._networks[0].fallback
        self._whole = {
            name: wp.zeros((batch * rows, *shape), dtype=wp.float32, device=device)
            for name, shape in (inputs | outputs).items()
        }
        self._looks = [
            _Look(card, spec, capacity, [a[k * rows : (k + 1) * rows] for a in self._whole.values()], device)
            for k in range(batch)
        ]
        for network in self._networks:
            self._bind(network, list(self._whole.values()))
            try:
                network.run()
            except Exception as error:  # ONNX Runtime has a family of exceptions of its own, not all of them public
                raise ModelError(f"{model}: it does not take {batch * rows} candidates at once: {error}") from error

    def look(self, row: int) -> _Look:
        """The kernels of a cloud of the batch: its boxes are in `rescore`, of which those that stay are in `nms`."""
        return self._looks[row]

    @staticmethod
    def _bind(network: Network, arrays: Sequence[wp.array]) -> None:
        network.bind_input("points", arrays[0])
        network.bind_input("boxes", arrays[1])
        network.bind_output("said", arrays[2])

    def _look_at(self, look: _Look, count: int) -> None:
        """Lets the networks look at the first so many candidates of a cloud, each at every so manieth lot of them."""
        lanes = len(self._networks)

        def run(lane: int) -> None:
            for first in range(lane * _AT_ONCE, count, lanes * _AT_ONCE):
                self._bind(self._networks[lane], [rows[first : min(first + _AT_ONCE, count)] for rows in look.arrays])
                self._networks[lane].run()

        run_together([partial(run, lane) for lane in range(min(lanes, -(-count // _AT_ONCE)))])

    def launch(
        self,
        clouds: Sequence[tuple[wp.array, wp.array, float | wp.array]],
        found: Sequence[tuple[CenterDecode, RotatedNms]],
        score_threshold: float,
    ) -> None:
        """Looks at the candidates of one or more clouds.

        Args:
            clouds: Positions, their number and the sensor's height, as in `DetectionHead.detect`.
            found: Candidates of each, and which of them stay.
            score_threshold: Least score of an object.
        """
        for look, cloud, (decode, nms) in zip(self._looks, clouds, found, strict=False):
            first = (decode.scores, decode.classes_found)
            look.rescore.choose(*first, nms.keep, nms.keep_count, score_threshold)
            chosen = (look.rescore.chosen, look.rescore.chosen_count)
            look.gather.launch(cloud[0], cloud[1], decode.boxes, *first, *chosen, cloud[2])
            if self._counted:
                self._look_at(look, min(int(chosen[1].numpy()[0]), self._spec.max_boxes))
        if not self._counted:
            self._networks[0].run()
        for look, (decode, _) in zip(self._looks, found, strict=False):
            chosen = (look.rescore.chosen, look.rescore.chosen_count)
            look.rescore.launch(decode.boxes, decode.scores, *chosen, look.arrays[2], score_threshold)
            look.nms.launch(look.rescore.boxes_out, look.rescore.scores, look.rescore.count)
