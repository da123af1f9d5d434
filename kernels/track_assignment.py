"""Assignment of detections to tracks, exact, among few possible pairs: shortest augmenting paths over sparse costs.

Jonker and Volgenant's algorithm (1987) without its initialisation, on lists of the pairs that are possible, where each
track may also stay alone at a cost of 1. A search stays among what hangs together by possible pairs, so thousands of
tracks cost little more than they do one by one.
"""

from __future__ import annotations

import warp as wp

from . import device  # noqa: F401  (starts Warp quietly)

__all__ = ["MOST_CANDIDATES", "Pairs", "Search", "assign_stage", "offer"]

MOST_CANDIDATES = wp.constant(wp.int32(32))
"""Pairs kept of a track: of more that are possible, those that cost least."""

_WORK = wp.constant(wp.int32(10_000_000))
_NONE = wp.constant(wp.int32(-1))
_FAR = wp.constant(wp.float64(1e300))


@wp.struct
class Pairs:
    """The possible pairs: of each track a list of detections."""

    count: wp.array(dtype=wp.int32)
    """How many a track has, shape (tracks,)."""
    detection: wp.array2d(dtype=wp.int32)
    """Which, shape (tracks, MOST_CANDIDATES)."""
    cost: wp.array2d(dtype=wp.float64)
    """At what cost, from 0 to below 1, likewise."""


@wp.struct
class Search:
    """Result and workspace of the search."""

    of_track: wp.array(dtype=wp.int32)
    """Out: the detection of each track, −1 for none, shape (tracks,)."""
    of_detection: wp.array(dtype=wp.int32)
    """Out: the track of each detection, −1 for none, shape (detections,)."""
    track_price: wp.array(dtype=wp.float64)
    detection_price: wp.array(dtype=wp.float64)
    distance: wp.array(dtype=wp.float64)
    """Of the shortest path to a detection, shape (detections,)."""
    before: wp.array(dtype=wp.int32)
    """The track before it on that path."""
    reached: wp.array(dtype=wp.int32)
    """In which search it was reached last; negative once it is settled."""
    touched: wp.array(dtype=wp.int32)
    """The detections reached in this search, those settled first."""
    work: wp.array(dtype=wp.int32)
    """Steps taken in this frame; then 1 if they became too many, shape (2,)."""


@wp.func
def offer(pairs: Pairs, track: int, detection: int, cost: wp.float64):
    """Adds a possible pair; of a full list the dearest gives way."""
    n = pairs.count[track]
    at = n
    if n < MOST_CANDIDATES:
        pairs.count[track] = n + 1
    else:
        worst = int(0)
        for k in range(1, n):
            if pairs.cost[track, k] >= pairs.cost[track, worst]:
                worst = k
        if cost >= pairs.cost[track, worst]:
            return
        at = worst
    pairs.detection[track, at] = detection
    pairs.cost[track, at] = cost


@wp.func
def _exchange(search: Search, detection: int, last: int):
    """Gives detections along the path that leads to one, from the track `last` on, to the track before each."""
    d = int(detection)
    going = bool(True)
    while going:
        track = search.before[d]
        given_up = search.of_track[track]
        search.of_track[track] = d
        search.of_detection[d] = track
        d = given_up
        going = track != last


@wp.func
def _place(pairs: Pairs, search: Search, sure: wp.array(dtype=wp.int32), stage: int, first: int, tag: int):
    """Finds the cheapest way to fit in one more track: a free detection, or one track that stays alone."""
    touched = int(0)
    settled = int(0)
    least = wp.float64(0.0)
    alone = _FAR
    alone_track = int(-1)
    track = int(first)
    found = int(-1)
    final = wp.float64(0.0)
    work = int(search.work[0])
    going = bool(True)
    while going:
        price = search.track_price[track]
        if least + wp.float64(1.0) - price < alone:
            alone = least + wp.float64(1.0) - price
            alone_track = track
        for k in range(pairs.count[track]):
            d = pairs.detection[track, k]
            if sure[d] == stage and search.reached[d] != -tag:
                way = least + pairs.cost[track, k] - price - search.detection_price[d]
                if search.reached[d] != tag:
                    search.reached[d] = tag
                    search.touched[touched] = d
                    touched += 1
                    search.distance[d] = way
                    search.before[d] = track
                elif way < search.distance[d]:
                    search.distance[d] = way
                    search.before[d] = track
        nearest = _FAR
        at = int(-1)
        for k in range(settled, touched):
            if search.distance[search.touched[k]] < nearest:
                nearest = search.distance[search.touched[k]]
                at = k
        work += pairs.count[track] + touched - settled + 1
        if alone <= nearest:
            final = alone
            going = False
        else:
            d = search.touched[at]
            if search.of_detection[d] == _NONE:
                found = d
                final = nearest
                going = False
            else:
                search.touched[at] = search.touched[settled]
                search.touched[settled] = d
                settled += 1
                search.reached[d] = -tag
                least = nearest
                track = search.of_detection[d]
    search.track_price[first] = search.track_price[first] + final
    for k in range(settled):
        d = search.touched[k]
        rest = final - search.distance[d]
        search.detection_price[d] = search.detection_price[d] - rest
        owner = search.of_detection[d]
        search.track_price[owner] = search.track_price[owner] + rest
    if found >= 0:
        _exchange(search, found, first)
    elif alone_track != first:
        given_up = search.of_track[alone_track]
        search.of_track[alone_track] = _NONE
        _exchange(search, given_up, first)
    search.work[0] = work


@wp.func
def _take_cheapest(pairs: Pairs, search: Search, sure: wp.array(dtype=wp.int32), stage: int, track: int):
    """Gives a track the cheapest of the detections that are free."""
    best = wp.float64(1.0)
    chosen = int(-1)
    for k in range(pairs.count[track]):
        d = pairs.detection[track, k]
        if sure[d] == stage and search.of_detection[d] == _NONE and pairs.cost[track, k] < best:
            best = pairs.cost[track, k]
            chosen = d
    if chosen >= 0:
        search.of_track[track] = chosen
        search.of_detection[chosen] = track


@wp.func
def assign_stage(pairs: Pairs, search: Search, sure: wp.array(dtype=wp.int32), stage: int, tracks: int, first_tag: int):
    """The cheapest one-to-one assignment of the detections of one stage to the tracks that have none yet.

    Where the search takes more than 10 million steps, as among thousands of objects in one place, the tracks left take
    the cheapest detection that is free: time is bounded, and `work[1]` says so.

    Args:
        pairs: What is possible.
        search: The result, to be −1 throughout before the first stage; `reached` and prices of detections are 0.
        sure: The stage of each detection.
        stage: Which to assign.
        tracks: How many.
        first_tag: 1, and then more by `tracks` for each stage.
    """
    for track in range(tracks):
        if search.of_track[track] == _NONE:
            search.track_price[track] = wp.float64(0.0)
    for track in range(tracks):
        if search.of_track[track] == _NONE and pairs.count[track] > 0:
            if search.work[0] < _WORK:
                _place(pairs, search, sure, stage, track, first_tag + track)
            else:
                search.work[1] = 1
                _take_cheapest(pairs, search, sure, stage, track)
