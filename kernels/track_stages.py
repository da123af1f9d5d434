"""What becomes of one track or one detection in a step of tracking: stages for the kernels of `track_step.py`."""

from __future__ import annotations

import warp as wp

from .track_motion import (
    Noise,
    Vec5,
    correct_place,
    correct_velocity,
    covariance_between,
    gradient_of_velocity,
    mix,
    posterior,
    predict,
    turn_round,
    velocity_of,
    wrapped,
)
from .track_overlap import Vec7
from .track_table import (
    ACCELERATION,
    AGE,
    BACKGROUND,
    BIRTH_HITS,
    COASTED,
    CONFIRMED,
    DT,
    EVIDENCE,
    HALF,
    HIGH_SCORE,
    HITS,
    ID,
    KIND,
    LEAST_SCORE,
    MEMORY,
    MIN_SCORE,
    MOST_VOTES,
    MOTION,
    MOVES,
    NOT_FINITE,
    NOT_SIZED,
    NOW,
    POSE,
    POSITION,
    R_COVARIANCE,
    R_SCORE,
    RATE,
    RATE_DRIFT,
    RATE_OF,
    SCORE,
    SEEN,
    SIZE,
    SIZE_DRIFT,
    SLIP,
    SPEED,
    SWITCH,
    TURN,
    TURNS,
    TURNS_AT_FIRST,
    VARIANCE,
    VELOCITY,
    VERTICAL,
    VOTES,
    VX,
    WEAK,
    WEIGHT,
    YAW,
    YAW_DRIFT,
    Z_RADIAL,
    Z_SCORE,
    Z_SIZES,
    Z_VX,
    Frame,
    box_of,
    combine,
    filter_at,
    likeliest,
    models_of,
    motion_of,
)

__all__ = ["begin_track", "correct_track", "predict_track", "tell", "use_detection"]


@wp.func
def predict_track(i: int, frame: Frame, f: wp.array2d(dtype=wp.float64), whole: wp.array2d(dtype=wp.int64)):
    """Moves a track forward to now."""
    kind = int(whole[i, KIND])
    motion = int(whole[i, MOVES])
    dt = frame.real[DT]
    noise = Noise()
    noise.acceleration = frame.parameters[kind, ACCELERATION]
    noise.slip = frame.parameters[kind, SLIP]
    noise.yaw = frame.parameters[kind, YAW_DRIFT]
    noise.turn = frame.parameters[kind, RATE_DRIFT]
    if motion == 2:
        switch = HALF * (wp.float64(1.0) - wp.exp(-wp.float64(2.0) * frame.parameters[kind, SWITCH] * dt))
        f[i, TURNS] = mix(f, i, filter_at(0), filter_at(1), f[i, TURNS], switch)
    for model in range(models_of(motion)):
        predict(f, i, filter_at(model), motion_of(motion, model), noise, dt)
    f[i, VARIANCE] = f[i, VARIANCE] + dt * frame.parameters[kind, VERTICAL]
    for k in range(1, 4):
        f[i, VARIANCE + k] = f[i, VARIANCE + k] + dt * frame.parameters[kind, SIZE_DRIFT]
    combine(f, i, motion)


@wp.func
def use_detection(j: int, frame: Frame):
    """Checks a detection, and turns it into the frame of the tracks."""
    total = wp.float64(0.0)
    for k in range(8):
        total += frame.given[j, k]
    # First the place, by which detections of no use are in order too.
    x = frame.given[j, 0]
    y = frame.given[j, 1]
    z = frame.given[j, 2]
    for k in range(3):
        at = POSE + 4 * k
        frame.used[j, k] = frame.real[at] * x + frame.real[at + 1] * y + frame.real[at + 2] * z + frame.real[at + 3]
    frame.stage[j] = 0
    kind = frame.given_whole[j, 0]
    if frame.given_whole[j, 1] != 0:
        kind = frame.parameters.shape[0] - 1
    frame.kind[j] = kind
    score = frame.given[j, Z_SCORE]
    if total - total != wp.float64(0.0):
        wp.atomic_add(frame.counts, NOT_FINITE, wp.int64(1))
        return
    if wp.min(wp.min(frame.given[j, 3], frame.given[j, 4]), frame.given[j, 5]) <= wp.float64(0.0):
        wp.atomic_add(frame.counts, NOT_SIZED, wp.int64(1))
        return
    if score < frame.parameters[kind, MIN_SCORE]:
        wp.atomic_add(frame.counts, WEAK, wp.int64(1))
        return
    frame.stage[j] = wp.where(score >= frame.parameters[kind, HIGH_SCORE], 1, 2)
    for k in range(3, 6):
        frame.used[j, k] = frame.given[j, k]
        frame.used[j, Z_SIZES + k - 3] = wp.log(frame.given[j, k])
    c = wp.cos(frame.given[j, 6])
    n = wp.sin(frame.given[j, 6])
    r00 = frame.real[POSE]
    r01 = frame.real[POSE + 1]
    r10 = frame.real[POSE + 4]
    r11 = frame.real[POSE + 5]
    frame.used[j, 6] = wp.atan2(r10 * c + r11 * n, r00 * c + r01 * n)
    frame.used[j, Z_SCORE] = score
    for k in range(2):
        at = wp.where(k == 0, Z_VX, Z_RADIAL)
        vx = frame.given[j, at]
        vy = frame.given[j, at + 1]
        frame.used[j, at] = r00 * vx + r01 * vy
        frame.used[j, at + 1] = r10 * vx + r11 * vy
        frame.used[j, at + 2] = frame.given[j, at + 2]
        frame.used[j, at + 3] = frame.given[j, at + 3]


@wp.func
def _take_box(frame: Frame, f: wp.array2d(dtype=wp.float64), i: int, kind: int, motion: int, box: Vec7, outvoted: bool):
    """Corrects a track by the box that was measured, at the heading that was made out for it."""
    place = frame.parameters[kind, POSITION]
    turn = frame.parameters[kind, TURN]
    for k in range(4):
        p = f[i, VARIANCE + k]
        noise = wp.where(k == 0, place, frame.parameters[kind, SIZE])
        gain = p / (p + noise)
        f[i, 2 + k] = f[i, 2 + k] + gain * (box[2 + k] - f[i, 2 + k])
        f[i, VARIANCE + k] = p - gain * p
    likely = wp.vec2d()
    for model in range(models_of(motion)):
        at = filter_at(model)
        if outvoted:
            turn_round(f, i, at, motion_of(motion, model))
        likely[model] = correct_place(f, i, at, box[0], box[1], box[6], place, turn)
    if motion == 2:
        f[i, TURNS] = posterior(f[i, TURNS], likely[0], likely[1])


@wp.func
def _take_velocity(frame: Frame, f: wp.array2d(dtype=wp.float64), i: int, kind: int, motion: int, j: int):
    """Corrects a track by velocities that were measured with its detection, if any were."""
    velocity = frame.used[j, Z_VX] + frame.used[j, Z_VX + 1]
    radial = frame.used[j, Z_RADIAL] + frame.used[j, Z_RADIAL + 1] + frame.used[j, Z_RADIAL + 2]
    has_velocity = velocity - velocity == wp.float64(0.0)
    has_radial = radial - radial == wp.float64(0.0)
    if not has_velocity and not has_radial:
        return
    likely = wp.vec2d()
    for model in range(models_of(motion)):
        total = wp.float64(0.0)
        # Along x, along y, along the line of sight: what of these was measured.
        for k in range(3):
            x = wp.float64(wp.where(k == 0, 1.0, 0.0))
            y = wp.float64(wp.where(k == 1, 1.0, 0.0))
            speed = frame.used[j, Z_VX + wp.min(k, 1)]
            variance = frame.parameters[kind, VELOCITY]
            if k == 2:
                x = frame.used[j, Z_RADIAL]
                y = frame.used[j, Z_RADIAL + 1]
                speed = frame.used[j, Z_RADIAL + 2]
                variance = frame.used[j, Z_RADIAL + 3] * frame.used[j, Z_RADIAL + 3]
            if (k < 2 and has_velocity) or (k == 2 and has_radial):
                moves = motion_of(motion, model)
                total += correct_velocity(f, i, filter_at(model), moves, x, y, speed, variance)
        likely[model] = total
    if motion == 2:
        f[i, TURNS] = posterior(f[i, TURNS], likely[0], likely[1])


@wp.func
def correct_track(
    frame: Frame, f: wp.array2d(dtype=wp.float64), whole: wp.array2d(dtype=wp.int64), i: int, j: int, motion: int
):
    """Corrects a track by its detection."""
    kind = int(whole[i, KIND])
    background = frame.parameters[kind, BACKGROUND] != wp.float64(0.0)
    box = box_of(frame.used, j)
    turn = wrapped(box[6] - f[i, YAW])
    if background:
        # A cluster has no front, and which of its sides is the longer may change from frame to frame.
        quarters = wp.rint(turn / (HALF * wp.float64(wp.PI)))
        box[6] = box[6] - HALF * wp.float64(wp.PI) * quarters
        turn = turn - HALF * wp.float64(wp.PI) * quarters
        if (int(quarters) & 1) != 0:
            length = box[3]
            box[3] = box[4]
            box[4] = length
    opposite = wp.abs(turn) > HALF * wp.float64(wp.PI)
    votes = wp.min(f[i, VOTES] + wp.where(opposite, wp.float64(-1.0), wp.float64(1.0)), MOST_VOTES)
    outvoted = votes < wp.float64(0.0)
    if outvoted:
        votes = wp.float64(1.0)
    elif opposite:
        box[6] = box[6] + wp.float64(wp.PI)
    f[i, VOTES] = votes
    _take_box(frame, f, i, kind, motion, box, outvoted)
    _take_velocity(frame, f, i, kind, motion, j)

    score = frame.used[j, Z_SCORE]
    weight = wp.max(wp.float64(1.0) / wp.float64(whole[i, HITS] + wp.int64(1)), frame.real[WEIGHT])
    f[i, SCORE] = f[i, SCORE] + weight * (score - f[i, SCORE])
    for k in range(f.shape[1] - EVIDENCE):
        f[i, EVIDENCE + k] = f[i, EVIDENCE + k] * frame.real[MEMORY]
    seen_as = EVIDENCE + frame.given_whole[j, 0]
    f[i, seen_as] = f[i, seen_as] + wp.max(score, LEAST_SCORE)
    whole[i, SEEN] = frame.whole[NOW]
    whole[i, HITS] = whole[i, HITS] + wp.int64(1)
    if wp.float64(whole[i, HITS]) >= frame.parameters[kind, BIRTH_HITS]:
        whole[i, CONFIRMED] = wp.int64(1)
    if not background:
        whole[i, KIND] = wp.int64(likeliest(f, i))


@wp.func
def begin_track(frame: Frame, f: wp.array2d(dtype=wp.float64), whole: wp.array2d(dtype=wp.int64), j: int, i: int):
    """A track of one detection."""
    kind = frame.kind[j]
    motion = int(frame.parameters[kind, MOTION])
    for k in range(f.shape[1]):
        f[i, k] = wp.float64(0.0)
    for k in range(7):
        f[i, k] = frame.used[j, k]
    place = frame.parameters[kind, POSITION]
    f[i, VARIANCE] = place
    for k in range(1, 4):
        f[i, VARIANCE + k] = frame.parameters[kind, SIZE]
    for model in range(models_of(motion)):
        at = filter_at(model)
        f[i, at] = f[i, 0]
        f[i, at + 1] = f[i, 1]
        f[i, at + 2] = f[i, YAW]
        f[i, at + 5] = place
        f[i, at + 11] = place
        f[i, at + 17] = frame.parameters[kind, TURN]
        f[i, at + 23] = frame.parameters[kind, SPEED]
        f[i, at + 29] = frame.parameters[kind, wp.where(motion == 0, SPEED, RATE)]
    f[i, TURNS] = TURNS_AT_FIRST
    score = frame.used[j, Z_SCORE]
    f[i, SCORE] = score
    f[i, VOTES] = wp.float64(1.0)
    f[i, EVIDENCE + frame.given_whole[j, 0]] = wp.max(score, LEAST_SCORE)
    _take_velocity(frame, f, i, kind, motion, j)
    combine(f, i, motion)
    whole[i, KIND] = wp.int64(kind)
    whole[i, MOVES] = wp.int64(motion)
    whole[i, SEEN] = frame.whole[NOW]
    whole[i, HITS] = wp.int64(1)
    whole[i, AGE] = wp.int64(1)
    whole[i, CONFIRMED] = wp.int64(wp.where(frame.birth_report[j] >= 0, 1, 0))


@wp.func
def _told_gradient(frame: Frame, f: wp.array2d(dtype=wp.float64), i: int, of: int, moves: int, k: int) -> Vec5:
    """Of x, y and the velocity along x and y in the frame of the detections by the state of a filter."""
    x = frame.real[POSE + (k & 1)]
    y = frame.real[POSE + 4 + (k & 1)]
    if k < 2:
        h = Vec5()
        h[0] = x
        h[1] = y
        return h
    return gradient_of_velocity(f, i, of, moves, x, y)


@wp.func
def _told_offset(frame: Frame, f: wp.array2d(dtype=wp.float64), i: int, of: int, moves: int, k: int) -> wp.float64:
    """How far a filter's own x, y and velocity are from the track's, in the frame of the detections."""
    x = f[i, of] - f[i, 0]
    y = f[i, of + 1] - f[i, 1]
    if k > 1:
        v = velocity_of(f, i, of, moves)
        x = v[0] - f[i, VX]
        y = v[1] - f[i, VX + 1]
    return frame.real[POSE + (k & 1)] * x + frame.real[POSE + 4 + (k & 1)] * y


@wp.func
def _tell_covariance(
    frame: Frame, f: wp.array2d(dtype=wp.float64), i: int, at: int, of: int, moves: int, share: wp.float64
):
    """Adds a filter's share to the covariance of place and velocity in the report."""
    for row in range(4):
        a = _told_gradient(frame, f, i, of, moves, row)
        off = _told_offset(frame, f, i, of, moves, row)
        for column in range(4):
            b = _told_gradient(frame, f, i, of, moves, column)
            value = covariance_between(f, i, of, a, b)
            value += off * _told_offset(frame, f, i, of, moves, column)
            to = R_COVARIANCE + 4 * row + column
            frame.report[at, to] = frame.report[at, to] + share * value


@wp.func
def tell(
    frame: Frame, f: wp.array2d(dtype=wp.float64), whole: wp.array2d(dtype=wp.int64), i: int, at: int, detection: int
):
    """Writes a track into the report, in the frame of the detections."""
    r00 = frame.real[POSE]
    r01 = frame.real[POSE + 1]
    r10 = frame.real[POSE + 4]
    r11 = frame.real[POSE + 5]
    for k in range(3):
        place = wp.float64(0.0)
        for row in range(3):
            place += frame.real[POSE + 4 * row + k] * (f[i, row] - frame.real[POSE + 4 * row + 3])
        frame.report[at, k] = place
    for k in range(3, 6):
        frame.report[at, k] = f[i, k]
    c = wp.cos(f[i, YAW])
    n = wp.sin(f[i, YAW])
    frame.report[at, 6] = wp.atan2(r01 * c + r11 * n, r00 * c + r10 * n)
    frame.report[at, 7] = r00 * f[i, VX] + r10 * f[i, VX + 1]
    frame.report[at, 8] = r01 * f[i, VX] + r11 * f[i, VX + 1]
    frame.report[at, 9] = f[i, RATE_OF]
    motion = int(whole[i, MOVES])
    for k in range(16):
        frame.report[at, R_COVARIANCE + k] = wp.float64(0.0)
    for model in range(models_of(motion)):
        share = wp.float64(1.0)
        if motion == 2:
            share = wp.where(model == 0, wp.float64(1.0) - f[i, TURNS], f[i, TURNS])
        _tell_covariance(frame, f, i, at, filter_at(model), motion_of(motion, model), share)
    unseen = detection < 0
    frame.report[at, R_SCORE] = f[i, SCORE] * wp.where(unseen, frame.real[COASTED], wp.float64(1.0))
    frame.report_whole[at, 0] = whole[i, ID]
    frame.report_whole[at, 1] = wp.int64(likeliest(f, i))
    frame.report_whole[at, 2] = wp.int64(wp.where(int(whole[i, KIND]) == frame.parameters.shape[0] - 1, 1, 0))
    frame.report_whole[at, 3] = whole[i, AGE]
    frame.report_whole[at, 4] = whole[i, HITS]
    frame.report_whole[at, 5] = wp.int64(wp.where(unseen, 1, 0))
    frame.report_whole[at, 6] = wp.int64(detection)
