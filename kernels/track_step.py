"""One frame of tracking, compiled: prediction, costs, assignment, correction, birth and death of all tracks.

Four launches: every track and detection is made ready by itself; every track looks for the detections that may be its
own; one thread assigns them and says who stays; every track and newcomer is written where it belongs. Tracks are the
rows of two tables, written from one into the other in turn, oldest first.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .device import DEFAULT_DEVICE, resolve_device
from .track_assignment import MOST_CANDIDATES, Pairs, Search, assign_stage, offer
from .track_overlap import giou
from .track_stages import begin_track, correct_track, predict_track, tell, use_detection
from .track_table import (
    AGE,
    BIRTH_HITS,
    BIRTH_SCORE,
    BORN,
    COAST,
    CONFIRMED,
    COST,
    COUNTS,
    CUT,
    DETECTIONS,
    EVIDENCE,
    FRAME,
    GIVEN,
    GROUP,
    HITS,
    ID,
    KEPT,
    KIND,
    LARGEST,
    LEAST_SIZE,
    LIMIT,
    MOST,
    MOVES,
    NEAR,
    NEAR_LIMIT,
    NEXT_ID,
    NOW,
    OVER,
    PARAMETERS,
    PLACE,
    REPORT,
    REPORT_REAL,
    REPORT_WHOLE,
    SEEN,
    SHOWN,
    SIZE_WEIGHT,
    SORTED,
    TENTATIVE,
    TRACKS,
    USED,
    VARIANCE,
    WHOLE,
    WIDER,
    Z_SCORE,
    Z_SIZES,
    Frame,
    box_of,
    combine,
)

__all__ = ["TrackStep"]

wp.set_module_options({"fuse_fp": False, "max_unroll": 1})

_DIAGONAL = wp.constant(wp.float64(2.0**0.5))
# Pairs of a frame that are looked at closely, and of a track at least: time is bounded however many are in one place.
_LOOKS, _LEAST_LOOKS = wp.constant(wp.int32(2_000_000)), wp.constant(wp.int32(256))


@wp.kernel
def _make_ready(
    # in out
    frame: Frame,
    real: wp.array2d(dtype=wp.float64),
    whole: wp.array2d(dtype=wp.int64),
    search: Search,
):
    """Moves each track forward to now, and checks each detection."""
    i = wp.tid()
    if i < int(frame.whole[TRACKS]):
        search.of_track[i] = -1
        predict_track(i, frame, real, whole)
    if i < int(frame.whole[DETECTIONS]):
        search.of_detection[i] = -1
        search.detection_price[i] = wp.float64(0.0)
        search.reached[i] = 0
        use_detection(i, frame)


@wp.func
def _first_from(frame: Frame, m: int, x: wp.float64) -> int:
    """Of the detections in order of x, the first that is not below."""
    low = int(0)
    high = int(m)
    while low < high:
        middle = (low + high) / 2
        if frame.used[frame.order[middle], 0] < x:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel
def _find_pairs(
    # in
    frame: Frame,
    real: wp.array2d(dtype=wp.float64),
    whole: wp.array2d(dtype=wp.int64),
    # out
    pairs: Pairs,
):
    """For each track the detections that may be its own, and how far off they are, in shares of the gate."""
    i = wp.tid()
    if i >= int(frame.whole[TRACKS]):
        return
    pairs.count[i] = 0
    m = int(frame.whole[DETECTIONS])
    kind = int(whole[i, KIND])
    cost = int(frame.parameters[kind, COST])
    group = frame.parameters[kind, GROUP]
    limit = frame.parameters[kind, LIMIT]
    wider = frame.real[WIDER]
    sx = wp.float64(1.0)
    sy = wp.float64(1.0)
    sz = wp.float64(1.0)
    reach = limit
    volume = wp.float64(0.0)
    slim = wp.float64(1.0)
    sizes = wp.vec3d()
    for k in range(3):
        sizes[k] = wp.log(wp.max(real[i, 3 + k], LEAST_SIZE))
    if cost == 0:
        most = frame.parameters[kind, NEAR_LIMIT] * wider * wider
        near = frame.parameters[kind, NEAR]
        sx = wp.min(real[i, PLACE], most) + near
        sy = wp.min(real[i, PLACE + 1], most) + near
        sz = wp.min(real[i, VARIANCE], most) + near
        reach = limit * wp.sqrt(sx)
    elif cost == 1:
        volume = real[i, 3] * real[i, 4] * real[i, 5]
        slim = wp.min(real[i, 3], real[i, 4]) * real[i, 5]
        # The enclosing box is at least as large as one box drawn as far as the other one is away.
        reach = _DIAGONAL * (volume + frame.real[LARGEST]) / ((wp.float64(1.0) + limit) * slim)
    else:
        limit = limit * wider
        reach = limit
    x = real[i, 0]
    y = real[i, 1]
    first = int(0)
    last = int(m)
    in_order = frame.whole[SORTED] != wp.int64(0)
    if in_order:
        first = _first_from(frame, m, x - reach)
        last = _first_from(frame, m, x + reach)
        # Among thousands in one place those nearest along x must do.
        most_looked_at = wp.max(_LOOKS / int(frame.whole[TRACKS]), _LEAST_LOOKS)
        if last - first > most_looked_at:
            frame.counts[CUT] = wp.int64(1)
            middle = _first_from(frame, m, x)
            first = wp.max(first, middle - most_looked_at / 2)
            last = wp.min(last, middle + most_looked_at / 2)
    for k in range(first, last):
        j = int(k)
        if in_order:
            j = frame.order[k]
        dx = frame.used[j, 0] - x
        if frame.stage[j] != 0 and frame.parameters[frame.kind[j], GROUP] == group:
            dy = frame.used[j, 1] - y
            price = wp.float64(1.0)
            if cost == 0:
                square = dx * dx / sx + dy * dy / sy
                if square < limit * limit:
                    dz = frame.used[j, 2] - real[i, 2]
                    square += dz * dz / sz
                    if square < limit * limit:
                        apart = wp.float64(0.0)
                        for size in range(3):
                            ratio = frame.used[j, Z_SIZES + size] - sizes[size]
                            apart += ratio * ratio
                        square += frame.parameters[kind, SIZE_WEIGHT] * apart
                        price = wp.sqrt(square) / limit
            elif cost == 2:
                price = wp.sqrt(dx * dx + dy * dy) / limit
            else:
                other = frame.used[j, 3] * frame.used[j, 4] * frame.used[j, 5]
                far = wp.max(wp.abs(dx), wp.abs(dy)) * slim
                if far * (wp.float64(1.0) + limit) <= _DIAGONAL * (volume + other):
                    overlap = giou(box_of(real, i), box_of(frame.used, j))
                    price = (wp.float64(1.0) - overlap) / (wp.float64(1.0) - limit)
            if price < wp.float64(1.0):
                offer(pairs, i, j, price)


@wp.func
def _best_of_born(frame: Frame, m: int, born: int, room: int) -> int:
    """Leaves of those to be born as many as there is room for, the best ones."""
    for _n in range(room):
        best = int(-1)
        for j in range(m):
            if frame.birth_place[j] == 0 and (best < 0 or frame.used[j, Z_SCORE] > frame.used[best, Z_SCORE]):
                best = j
        frame.birth_place[best] = 1
    for j in range(m):
        frame.birth_place[j] = wp.where(frame.birth_place[j] == 1, 0, -1)
    frame.counts[OVER] = frame.counts[OVER] + wp.int64(born - room)
    return room


@wp.kernel
def _decide(
    # in
    frame: Frame,
    whole: wp.array2d(dtype=wp.int64),
    pairs: Pairs,
    # out
    search: Search,
):
    """One thread: assigns, and gives everyone that stays or is born a row of the new table and of the report."""
    n = int(frame.whole[TRACKS])
    m = int(frame.whole[DETECTIONS])
    search.work[0] = 0
    search.work[1] = 0
    assign_stage(pairs, search, frame.stage, 1, n, 1)
    assign_stage(pairs, search, frame.stage, 2, n, 1 + n)
    if search.work[1] != 0:
        frame.counts[CUT] = wp.int64(1)
    kept = int(0)
    shown = int(0)
    for i in range(n):
        kind = int(whole[i, KIND])
        unseen = wp.float64(frame.whole[NOW] - whole[i, SEEN])
        confirmed = whole[i, CONFIRMED] != wp.int64(0)
        limit = frame.parameters[kind, TENTATIVE]
        if confirmed:
            limit = frame.parameters[kind, COAST]
        stays = unseen <= limit
        reported = confirmed and unseen <= frame.parameters[kind, REPORT]
        if search.of_track[i] >= 0:
            stays = True
            reported = confirmed or wp.float64(whole[i, HITS] + wp.int64(1)) >= frame.parameters[kind, BIRTH_HITS]
        frame.track_place[i] = -1
        frame.track_report[i] = -1
        if stays:
            frame.track_place[i] = kept
            kept += 1
            if reported:
                frame.track_report[i] = shown
                shown += 1
    born = int(0)
    for j in range(m):
        frame.birth_place[j] = -1
        frame.birth_report[j] = -1
        free = frame.stage[j] != 0 and search.of_detection[j] < 0
        if free and frame.used[j, Z_SCORE] >= frame.parameters[frame.kind[j], BIRTH_SCORE]:
            frame.birth_place[j] = 0
            born += 1
    room = wp.max(int(frame.whole[MOST]) - kept, 0)
    if born > room:
        born = _best_of_born(frame, m, born, room)
    for j in range(m):
        if frame.birth_place[j] == 0:
            frame.birth_place[j] = kept
            kept += 1
            # At the beginning there is nothing to wait for: what is there is there.
            first = frame.whole[FRAME] == wp.int64(1)
            if first or frame.parameters[frame.kind[j], BIRTH_HITS] <= wp.float64(1.0):
                frame.birth_report[j] = shown
                shown += 1
    frame.counts[KEPT] = wp.int64(kept)
    frame.counts[SHOWN] = wp.int64(shown)
    frame.counts[BORN] = wp.int64(born)


@wp.kernel
def _write(
    # in
    frame: Frame,
    real: wp.array2d(dtype=wp.float64),
    whole: wp.array2d(dtype=wp.int64),
    search: Search,
    # out
    real_out: wp.array2d(dtype=wp.float64),
    whole_out: wp.array2d(dtype=wp.int64),
):
    """Writes each track that stays and each that is born into the new table, and what is to be told of it."""
    i = wp.tid()
    if i < int(frame.whole[TRACKS]) and frame.track_place[i] >= 0:
        to = frame.track_place[i]
        motion = int(whole[i, MOVES])
        for k in range(real.shape[1]):
            real_out[to, k] = real[i, k]
        for k in range(whole.shape[1]):
            whole_out[to, k] = whole[i, k]
        whole_out[to, AGE] = whole_out[to, AGE] + wp.int64(1)
        detection = search.of_track[i]
        if detection >= 0:
            correct_track(frame, real_out, whole_out, to, detection, motion)
            combine(real_out, to, motion)
        if frame.track_report[i] >= 0:
            tell(frame, real_out, whole_out, to, frame.track_report[i], detection)
    if i < int(frame.whole[DETECTIONS]) and frame.birth_place[i] >= 0:
        to = frame.birth_place[i]
        begin_track(frame, real_out, whole_out, i, to)
        # Ids rise in the order of the detections, as rows do.
        first = int(frame.counts[KEPT] - frame.counts[BORN])
        whole_out[to, ID] = frame.whole[NEXT_ID] + wp.int64(to - first)
        if frame.birth_report[i] >= 0:
            tell(frame, real_out, whole_out, to, frame.birth_report[i], i)


@dataclass(frozen=True, kw_only=True)
class TrackStep:
    """A plan: the tables of up to `tracks` tracks, and what takes them through a frame of up to `detections`.

    Whoever drives it writes `parameters`, `frame_real`, `frame_whole`, `given` and `given_whole` on the host, calls
    `launch`, and reads `counts`, `report` and `report_whole`.
    """

    tracks: int
    """Rows of the tables."""
    detections: int
    """Detections of a frame at most."""
    kinds: int
    """Classes and the background, the last one."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    parameters: np.ndarray = field(init=False, repr=False, compare=False)
    """In: `PARAMETERS` of each kind, shape (kinds, 28), float64."""
    frame_real: np.ndarray = field(init=False, repr=False, compare=False)
    """In: seconds since the last frame; factor on the gates; on scores of the unseen; on evidence; least weight of a
    score; the largest volume of a detection where `order` is to be used; world from sensor, 3 × 4 by rows; shape (18,),
    float64."""
    frame_whole: np.ndarray = field(init=False, repr=False, compare=False)
    """In: now [ns]; tracks; detections; the next id; number of the frame from 1; whether `order` is to be used; the
    most tracks; shape (7,), int64."""
    given: np.ndarray = field(init=False, repr=False, compare=False)
    """In: x y z l w h yaw, score, vx vy, then of a speed along a direction the direction x y, the speed and its
    standard deviation, NaN where not measured; shape (detections, 14), float64."""
    given_whole: np.ndarray = field(init=False, repr=False, compare=False)
    """In: class, and 1 for background; shape (detections, 2), int32."""
    order: np.ndarray = field(init=False, repr=False, compare=False)
    """In: rows of the detections in the order of x among the tracks, shape (detections,), int32."""
    counts: np.ndarray = field(init=False, repr=False, compare=False)
    """Out: `COUNTS`, shape (8,), int64; from the fourth on they go on rising until they are set to zero."""
    report: np.ndarray = field(init=False, repr=False, compare=False)
    """Out: box, vx vy, turn rate, score, covariance of x y vx vy; shape (tracks, 27), float64."""
    report_whole: np.ndarray = field(init=False, repr=False, compare=False)
    """Out: id, class, background, age, hits, coasted, detection; shape (tracks, 7), int64."""

    def __post_init__(self):
        for name, least in (("tracks", 1), ("detections", 1), ("kinds", 2)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, not {getattr(self, name)}")
        device = resolve_device(self.device)
        n, m = self.tracks, self.detections

        def zeros(shape: int | tuple[int, ...], kind: type) -> wp.array:
            return wp.zeros(shape, dtype=kind, device=device)

        frame = Frame()
        frame.parameters = zeros((self.kinds, len(PARAMETERS)), wp.float64)
        frame.real, frame.whole = zeros(18, wp.float64), zeros(7, wp.int64)
        frame.given, frame.given_whole = zeros((m, GIVEN), wp.float64), zeros((m, 2), wp.int32)
        frame.order, frame.used = zeros(m, wp.int32), zeros((m, USED), wp.float64)
        frame.kind, frame.stage = zeros(m, wp.int32), zeros(m, wp.int32)
        frame.track_place, frame.track_report = zeros(n, wp.int32), zeros(n, wp.int32)
        frame.birth_place, frame.birth_report = zeros(m, wp.int32), zeros(m, wp.int32)
        frame.counts = zeros(len(COUNTS), wp.int64)
        frame.report, frame.report_whole = zeros((n, REPORT_REAL), wp.float64), zeros((n, REPORT_WHOLE), wp.int64)
        pairs = Pairs()
        pairs.count = zeros(n, wp.int32)
        pairs.detection = zeros((n, int(MOST_CANDIDATES)), wp.int32)
        pairs.cost = zeros((n, int(MOST_CANDIDATES)), wp.float64)
        search = Search()
        search.of_track, search.of_detection = zeros(n, wp.int32), zeros(m, wp.int32)
        search.track_price, search.detection_price = zeros(n, wp.float64), zeros(m, wp.float64)
        search.distance, search.before = zeros(m, wp.float64), zeros(m, wp.int32)
        search.reached, search.touched, search.work = zeros(m, wp.int32), zeros(m, wp.int32), zeros(2, wp.int32)
        columns = int(EVIDENCE) + self.kinds - 1
        tables = [(zeros((n, columns), wp.float64), zeros((n, WHOLE), wp.int64)) for _ in range(2)]

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("_arrays", {
            "parameters": frame.parameters, "frame_real": frame.real, "frame_whole": frame.whole, "given": frame.given,
            "given_whole": frame.given_whole, "order": frame.order, "counts": frame.counts, "report": frame.report,
            "report_whole": frame.report_whole,
        })  # fmt: skip
        for name, array in self._arrays.items():
            keep(name, array.numpy())  # of a CPU the memory itself
        keep("_structs", (frame, pairs, search))
        keep("_tables", tables)
        keep("_launches", [self._record(old, new) for old, new in (tables, tables[::-1])])
        keep("_turn", [0])

    def _record(self, old: tuple[wp.array, wp.array], new: tuple[wp.array, wp.array]) -> list[Any]:
        """The launches of a frame from one table into the other, with their arguments packed once."""
        frame, pairs, search = self._structs
        most = max(self.tracks, self.detections)

        def launch(kernel: Any, size: int, inputs: list, outputs: list) -> Any:
            return wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self.device, record_cmd=True)

        return [
            launch(_make_ready, most, [], [frame, *old, search]),
            launch(_find_pairs, self.tracks, [frame, *old], [pairs]),
            launch(_decide, 1, [frame, old[1], pairs], [search]),
            launch(_write, most, [frame, *old, search], [*new]),
        ]

    @property
    def _on_host(self) -> bool:
        return self.device == DEFAULT_DEVICE

    def send(self, *names: str) -> None:
        """Brings what was written on the host to the device."""
        if not self._on_host:
            for name in names:
                self._arrays[name].assign(getattr(self, name))

    def fetch(self, *names: str) -> None:
        """Brings results to the host, and waits for them."""
        if not self._on_host:
            for name in names:
                getattr(self, name)[:] = self._arrays[name].numpy()

    def launch(self) -> None:
        """Takes the tracks through a frame; allocates nothing, reads nothing back."""
        for command in self._launches[self._turn[0]]:
            command.launch()
        self._turn[0] ^= 1

    def table(self) -> tuple[np.ndarray, np.ndarray]:
        """The tracks as they are now: copies of the tables, shapes (tracks, columns) float64 and (tracks, 7) int64."""
        return tuple(array.numpy().copy() for array in self._tables[self._turn[0]])

    def set_table(self, real: np.ndarray, whole: np.ndarray) -> None:
        """Puts tracks in place of those there are: rows as `table` gives them, at most `tracks`."""
        for array, rows in zip(self._tables[self._turn[0]], (real, whole), strict=True):
            everything = array.numpy().copy()
            everything[: len(rows)] = rows
            array.assign(everything)
