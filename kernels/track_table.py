"""The tables of tracks and detections that a step of tracking works on: what stands where, and how it is read.

Tracks are rows of a table of real numbers and of one of whole ones. Columns and rows have names here, for kernels.
"""

from __future__ import annotations

import warp as wp

from . import device  # noqa: F401  (starts Warp quietly)
from .track_motion import CONSTANT_VELOCITY, STRAIGHT, TURNING, velocity_of, wrapped
from .track_overlap import Vec7

__all__ = [
    "ACCELERATION",
    "AGE",
    "BACKGROUND",
    "BIRTH_HITS",
    "BIRTH_SCORE",
    "BORN",
    "COAST",
    "COASTED",
    "CONFIRMED",
    "COST",
    "COSTS",
    "COUNTS",
    "CUT",
    "DETECTIONS",
    "DT",
    "EVIDENCE",
    "FILTER",
    "FRAME",
    "GIVEN",
    "GROUP",
    "HALF",
    "HIGH_SCORE",
    "HITS",
    "ID",
    "KEPT",
    "KIND",
    "LARGEST",
    "LEAST_SCORE",
    "LEAST_SIZE",
    "LIMIT",
    "MEMORY",
    "MIN_SCORE",
    "MOST",
    "MOST_VOTES",
    "MOTION",
    "MOTIONS",
    "MOVES",
    "NEAR",
    "NEAR_LIMIT",
    "NEXT_ID",
    "NOT_FINITE",
    "NOT_SIZED",
    "NOW",
    "OVER",
    "PARAMETERS",
    "PLACE",
    "POSE",
    "POSITION",
    "RATE",
    "RATE_DRIFT",
    "RATE_OF",
    "REPORT",
    "REPORT_REAL",
    "REPORT_WHOLE",
    "R_COVARIANCE",
    "R_SCORE",
    "SCORE",
    "SEEN",
    "SHOWN",
    "SIZE",
    "SIZE_DRIFT",
    "SIZE_WEIGHT",
    "SLIP",
    "SORTED",
    "SPEED",
    "SWITCH",
    "TENTATIVE",
    "TRACKS",
    "TURN",
    "TURNS",
    "TURNS_AT_FIRST",
    "USED",
    "VARIANCE",
    "VELOCITY",
    "VERTICAL",
    "VOTES",
    "VX",
    "WEAK",
    "WEIGHT",
    "WHOLE",
    "WIDER",
    "YAW",
    "YAW_DRIFT",
    "Z_RADIAL",
    "Z_SCORE",
    "Z_SIZES",
    "Z_VX",
    "Frame",
    "P",
    "S",
    "box_of",
    "combine",
    "filter_at",
    "likeliest",
    "models_of",
    "motion_of",
]  # fmt: skip

MOTIONS = ("cv", "ctrv", "imm")
"""Motions a class may have: `cv` moves on as it did along the axes of the ground; `ctrv` along its heading, which turns
at a constant rate; `imm` weighs going straight on against turning."""
COSTS = ("mahalanobis", "giou", "distance")
"""What associates."""

PARAMETERS = (
    "min_score", "high_score", "birth_score", "birth_hits", "tentative", "coast", "report", "group",
    "motion", "cost", "limit", "association_variance", "association_limit", "size_weight",
    "position_variance", "size_variance", "yaw_variance", "velocity_variance",
    "speed_variance", "acceleration", "slip", "vertical_drift", "size_drift", "yaw_drift",
    "turn_variance", "turn_acceleration", "switch_rate", "is_background",
)  # fmt: skip
"""Columns of a plan's `parameters`; times in nanoseconds, noises as variances or spectral densities."""
(
    MIN_SCORE, HIGH_SCORE, BIRTH_SCORE, BIRTH_HITS, TENTATIVE, COAST, REPORT, GROUP,
    MOTION, COST, LIMIT, NEAR, NEAR_LIMIT, SIZE_WEIGHT,
    POSITION, SIZE, TURN, VELOCITY,
    SPEED, ACCELERATION, SLIP, VERTICAL, SIZE_DRIFT, YAW_DRIFT,
    RATE, RATE_DRIFT, SWITCH, BACKGROUND,
) = (wp.constant(wp.int32(i)) for i in range(len(PARAMETERS)))  # fmt: skip

# Columns of the tables of tracks. Real: the box; vx vy and the turn rate; variances of z l w h and of the place; score,
# votes for the heading, probability that it turns; state and covariance of two filters; then the evidence by class.
VX, RATE_OF, VARIANCE, PLACE, SCORE, VOTES, TURNS = (wp.constant(wp.int32(i)) for i in (7, 9, 10, 14, 16, 17, 18))
S, P, FILTER, EVIDENCE = (wp.constant(wp.int32(i)) for i in (19, 24, 30, 79))
YAW = wp.constant(wp.int32(6))
# Whole: times in ns, counts of frames.
ID, KIND, MOVES, SEEN, HITS, AGE, CONFIRMED = (wp.constant(wp.int32(i)) for i in range(7))
WHOLE = 7
# Columns of the measurements as they are given, and as they are used, then with logarithms of the sizes.
Z_SCORE, Z_VX, Z_RADIAL, Z_SIZES = (wp.constant(wp.int32(i)) for i in (7, 8, 10, 14))
GIVEN, USED = 14, 17
# Of the frame, real: seconds; widening of gates; factors of scores and evidence; the largest volume; world from
# sensor, 12 numbers.
DT, WIDER, COASTED, MEMORY, WEIGHT, LARGEST, POSE = (wp.constant(wp.int32(i)) for i in range(7))
# Whole.
NOW, TRACKS, DETECTIONS, NEXT_ID, FRAME, SORTED, MOST = (wp.constant(wp.int32(i)) for i in range(7))
COUNTS = ("tracks", "reported", "born", "not finite", "size not positive", "low score", "over capacity", "cut short")
"""What a plan's `counts` holds."""
KEPT, SHOWN, BORN, NOT_FINITE, NOT_SIZED, WEAK, OVER, CUT = (wp.constant(wp.int32(i)) for i in range(8))
# Columns of the report.
R_SCORE, R_COVARIANCE = (wp.constant(wp.int32(i)) for i in (10, 11))
REPORT_REAL, REPORT_WHOLE = 27, 7

MOST_VOTES = wp.constant(wp.float64(5.0))  # for a heading: so many detections the other way turn it round
LEAST_SIZE = wp.constant(wp.float64(1e-2))
LEAST_SCORE = wp.constant(wp.float64(1e-3))
TURNS_AT_FIRST = wp.constant(wp.float64(0.2))
HALF = wp.constant(wp.float64(0.5))


@wp.struct
class Frame:
    """What the kernels are given of a frame."""

    parameters: wp.array2d(dtype=wp.float64)
    real: wp.array(dtype=wp.float64)
    whole: wp.array(dtype=wp.int64)
    given: wp.array2d(dtype=wp.float64)
    given_whole: wp.array2d(dtype=wp.int32)
    order: wp.array(dtype=wp.int32)
    used: wp.array2d(dtype=wp.float64)
    kind: wp.array(dtype=wp.int32)
    stage: wp.array(dtype=wp.int32)
    """Of each detection: 1 sure, 2 not so sure, 0 of no use."""
    track_place: wp.array(dtype=wp.int32)
    """The row of each track in the new table, −1 for none."""
    track_report: wp.array(dtype=wp.int32)
    birth_place: wp.array(dtype=wp.int32)
    birth_report: wp.array(dtype=wp.int32)
    counts: wp.array(dtype=wp.int64)
    report: wp.array2d(dtype=wp.float64)
    report_whole: wp.array2d(dtype=wp.int64)


@wp.func
def filter_at(model: int) -> int:
    """Where one of a track's filters begins."""
    return S + model * FILTER


@wp.func
def motion_of(motion: int, model: int) -> int:
    """How one of a track's filters moves."""
    if motion == 0:
        return CONSTANT_VELOCITY
    if motion == 2 and model == 0:
        return STRAIGHT
    return TURNING


@wp.func
def models_of(motion: int) -> int:
    """How many filters a track has."""
    return wp.where(motion == 2, 2, 1)


@wp.func
def combine(f: wp.array2d(dtype=wp.float64), i: int, motion: int):
    """Writes place, heading, rates and the variances of the place of a track, as its filter or filters have them."""
    at = filter_at(0)
    v = velocity_of(f, i, at, motion_of(motion, 0))
    x = f[i, at]
    y = f[i, at + 1]
    yaw = f[i, at + 2]
    rate = wp.float64(0.0)
    pxx = f[i, at + 5]
    pyy = f[i, at + 11]
    if motion == 1:
        rate = f[i, at + 4]
    if motion == 2:
        other = filter_at(1)
        w = velocity_of(f, i, other, TURNING)
        share = f[i, TURNS]
        apart = share * (wp.float64(1.0) - share)
        dx = f[i, other] - x
        dy = f[i, other + 1] - y
        pxx = pxx + share * (f[i, other + 5] - pxx) + apart * dx * dx
        pyy = pyy + share * (f[i, other + 11] - pyy) + apart * dy * dy
        x = x + share * dx
        y = y + share * dy
        yaw = wrapped(yaw + share * wrapped(f[i, other + 2] - yaw))
        v = v + (w - v) * share
        rate = share * f[i, other + 4]
    f[i, 0] = x
    f[i, 1] = y
    f[i, YAW] = yaw
    f[i, VX] = v[0]
    f[i, VX + 1] = v[1]
    f[i, RATE_OF] = rate
    f[i, PLACE] = pxx
    f[i, PLACE + 1] = pyy


@wp.func
def box_of(table: wp.array2d(dtype=wp.float64), i: int) -> Vec7:
    """The first seven numbers of a row."""
    box = Vec7()
    for k in range(7):
        box[k] = table[i, k]
    return box


@wp.func
def likeliest(f: wp.array2d(dtype=wp.float64), i: int) -> int:
    """The class that most of the evidence speaks for."""
    best = int(0)
    for k in range(1, f.shape[1] - EVIDENCE):
        if f[i, EVIDENCE + k] > f[i, EVIDENCE + best]:
            best = k
    return best
