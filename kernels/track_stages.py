"""What becomes of one track or one detection in a step of tracking: stages for the kernels of `track_step.py`."""

from __future__ import annotations

import warp as wp

from .track_motion import (
    CONSTANT_VELOCITY,
    STRAIGHT,
    TURNING,
    Mat4,
    Mat5,
    Noise,
    Vec5,
    cartesian,
    correct_place,
    correct_velocity,
    difference,
    mix,
    posterior,
    predict,
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
    covariance_of,
    keep,
    likeliest,
    state_of,
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
    s = state_of(f, i, 0)
    p = covariance_of(f, i, 0)
    if motion == 2:
        b = state_of(f, i, 1)
        pb = covariance_of(f, i, 1)
        switch = HALF * (wp.float64(1.0) - wp.exp(-wp.float64(2.0) * frame.parameters[kind, SWITCH] * dt))
        s, p, b, pb, turns = mix(s, p, b, pb, f[i, TURNS], switch)
        s, p = predict(s, p, STRAIGHT, noise, dt)
        b, pb = predict(b, pb, TURNING, noise, dt)
        f[i, TURNS] = turns
        keep(f, i, 1, b, pb)
    else:
        s, p = predict(s, p, wp.where(motion == 0, CONSTANT_VELOCITY, TURNING), noise, dt)
    keep(f, i, 0, s, p)
    f[i, VARIANCE] = f[i, VARIANCE] + dt * frame.parameters[kind, VERTICAL]
    for k in range(1, 4):
        f[i, VARIANCE + k] = f[i, VARIANCE + k] + dt * frame.parameters[kind, SIZE_DRIFT]
    combine(f, i, motion, True)


@wp.func
def use_detection(j: int, frame: Frame):
    """Checks a detection, and turns it into the frame of the tracks."""
    total = wp.float64(0.0)
    for k in range(8):
        total += frame.given[j, k]
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
    x = frame.given[j, 0]
    y = frame.given[j, 1]
    z = frame.given[j, 2]
    for k in range(3):
        at = POSE + 4 * k
        frame.used[j, k] = frame.real[at] * x + frame.real[at + 1] * y + frame.real[at + 2] * z + frame.real[at + 3]
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
def _turned_round(s: Vec5, motion: int) -> Vec5:
    """A state with the opposite heading, moving as before."""
    s[2] = s[2] + wp.float64(wp.PI)
    if motion != 0:
        s[3] = -s[3]
    return s


@wp.func
def _turn_covariance(p: Mat5, motion: int) -> Mat5:
    if motion != 0:
        for k in range(5):
            if k != 3:
                p[3, k] = -p[3, k]
                p[k, 3] = -p[k, 3]
    return p


@wp.func
def _take_box(frame: Frame, f: wp.array2d(dtype=wp.float64), i: int, kind: int, motion: int, box: Vec7, outvoted: bool):
    """Corrects a track by the box that was measured, at the heading that was made out for it."""
    yaw = box[6]
    place = frame.parameters[kind, POSITION]
    turn = frame.parameters[kind, TURN]
    for k in range(4):
        p = f[i, VARIANCE + k]
        noise = wp.where(k == 0, place, frame.parameters[kind, SIZE])
        gain = p / (p + noise)
        f[i, 2 + k] = f[i, 2 + k] + gain * (box[2 + k] - f[i, 2 + k])
        f[i, VARIANCE + k] = p - gain * p
    likely = wp.vec2d()
    for model in range(wp.where(motion == 2, 2, 1)):
        s = state_of(f, i, model)
        p5 = covariance_of(f, i, model)
        if outvoted:
            s = _turned_round(s, motion)
            p5 = _turn_covariance(p5, motion)
        s, p5, fit = correct_place(s, p5, box[0], box[1], yaw, place, turn)
        likely[model] = fit
        keep(f, i, model, s, p5)
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
    moves = wp.where(motion == 0, CONSTANT_VELOCITY, TURNING)
    for model in range(wp.where(motion == 2, 2, 1)):
        s = state_of(f, i, model)
        p = covariance_of(f, i, model)
        total = wp.float64(0.0)
        if has_velocity:
            variance = frame.parameters[kind, VELOCITY]
            one = wp.float64(1.0)
            none = wp.float64(0.0)
            s, p, fit = correct_velocity(s, p, moves, one, none, frame.used[j, Z_VX], variance)
            total += fit
            s, p, fit = correct_velocity(s, p, moves, none, one, frame.used[j, Z_VX + 1], variance)
            total += fit
        if has_radial:
            std = frame.used[j, Z_RADIAL + 3]
            s, p, fit = correct_velocity(
                s, p, moves, frame.used[j, Z_RADIAL], frame.used[j, Z_RADIAL + 1], frame.used[j, Z_RADIAL + 2],
                std * std,
            )  # fmt: skip
            total += fit
        likely[model] = total
        keep(f, i, model, s, p)
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
    s = Vec5()
    s[0] = f[i, 0]
    s[1] = f[i, 1]
    s[2] = f[i, YAW]
    p = Mat5()
    p[0, 0] = place
    p[1, 1] = place
    p[2, 2] = frame.parameters[kind, TURN]
    p[3, 3] = frame.parameters[kind, SPEED]
    p[4, 4] = frame.parameters[kind, wp.where(motion == 0, SPEED, RATE)]
    keep(f, i, 0, s, p)
    if motion == 2:
        keep(f, i, 1, s, p)
        f[i, TURNS] = TURNS_AT_FIRST
    score = frame.used[j, Z_SCORE]
    f[i, SCORE] = score
    f[i, VOTES] = wp.float64(1.0)
    f[i, EVIDENCE + frame.given_whole[j, 0]] = wp.max(score, LEAST_SCORE)
    _take_velocity(frame, f, i, kind, motion, j)
    combine(f, i, motion, False)
    whole[i, KIND] = wp.int64(kind)
    whole[i, MOVES] = wp.int64(motion)
    whole[i, SEEN] = frame.whole[NOW]
    whole[i, HITS] = wp.int64(1)
    whole[i, AGE] = wp.int64(1)
    whole[i, CONFIRMED] = wp.int64(wp.where(frame.birth_report[j] >= 0, 1, 0))


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
    s = state_of(f, i, 0)
    covariance = cartesian(s, covariance_of(f, i, 0), wp.where(motion == 0, CONSTANT_VELOCITY, TURNING))
    if motion == 2:
        share = f[i, TURNS]
        rest = wp.float64(1.0) - share
        b = state_of(f, i, 1)
        v = velocity_of(s, TURNING)
        w = velocity_of(b, TURNING)
        d = difference(b, s)
        apart = wp.vec4d(d[0], d[1], w[0] - v[0], w[1] - v[1])
        covariance = covariance * rest + cartesian(b, covariance_of(f, i, 1), TURNING) * share
        covariance = covariance + wp.outer(apart, apart) * (share * rest)
    # Place and velocity turn likewise.
    turn = Mat4(
        r00, r10, wp.float64(0.0), wp.float64(0.0),
        r01, r11, wp.float64(0.0), wp.float64(0.0),
        wp.float64(0.0), wp.float64(0.0), r00, r10,
        wp.float64(0.0), wp.float64(0.0), r01, r11,
    )  # fmt: skip
    turned = turn * covariance * wp.transpose(turn)
    for a in range(4):
        for b in range(4):
            frame.report[at, R_COVARIANCE + 4 * a + b] = turned[a, b]
    unseen = detection < 0
    frame.report[at, R_SCORE] = f[i, SCORE] * wp.where(unseen, frame.real[COASTED], wp.float64(1.0))
    frame.report_whole[at, 0] = whole[i, ID]
    frame.report_whole[at, 1] = wp.int64(likeliest(f, i))
    frame.report_whole[at, 2] = wp.int64(wp.where(int(whole[i, KIND]) == frame.parameters.shape[0] - 1, 1, 0))
    frame.report_whole[at, 3] = whole[i, AGE]
    frame.report_whole[at, 4] = whole[i, HITS]
    frame.report_whole[at, 5] = wp.int64(wp.where(unseen, 1, 0))
    frame.report_whole[at, 6] = wp.int64(detection)
