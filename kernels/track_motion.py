"""How tracked objects move over the ground: prediction and correction of one track's filter, for use in kernels.

Each filter has five numbers, the first three of which are measured:

- constant velocity: x y yaw vx vy; the heading wanders by itself.
- constant turn rate and velocity (Schubert et al., 2008): x y yaw speed turn-rate, with the speed along the heading;
  an extended filter. Going straight on is the same without a turn rate.

An interacting multiple model (Blom and Bar-Shalom, 1988) keeps two of the latter, one that goes straight and one that
turns, and mixes them by how well each has foretold the measurements.
"""

from __future__ import annotations

import warp as wp

from . import device  # noqa: F401  (starts Warp quietly)

__all__ = [
    "CONSTANT_VELOCITY",
    "STRAIGHT",
    "TURNING",
    "Mat4",
    "Mat5",
    "Noise",
    "Vec5",
    "cartesian",
    "correct_place",
    "correct_velocity",
    "difference",
    "mean_of",
    "mix",
    "posterior",
    "predict",
    "spread_of",
    "velocity_of",
    "wrapped",
]

Vec5 = wp.types.vector(length=5, dtype=wp.float64)
Mat5 = wp.types.matrix(shape=(5, 5), dtype=wp.float64)
Mat4 = wp.types.matrix(shape=(4, 4), dtype=wp.float64)

CONSTANT_VELOCITY, STRAIGHT, TURNING = (wp.constant(wp.int32(i)) for i in range(3))
"""Which motion a filter has."""

_TURN_RATE_OF_STRAIGHT = wp.constant(wp.float64(1e-4))  # variance, so that a covariance stays regular


@wp.struct
class Noise:
    """Spectral densities by which what a filter has of an object wanders, each its unit squared per second."""

    acceleration: wp.float64
    """Of velocity or speed."""
    slip: wp.float64
    """Of the position by itself."""
    yaw: wp.float64
    """Of the heading by itself."""
    turn: wp.float64
    """Of the turn rate."""


@wp.func
def wrapped(angle: wp.float64) -> wp.float64:
    """An angle in [−π, π)."""
    half = wp.float64(wp.PI)
    return angle - half * wp.float64(2.0) * wp.floor((angle + half) / (half * wp.float64(2.0)))


@wp.func
def _wander(p: Mat5, at: int, rate: int, q: wp.float64, dt: wp.float64) -> Mat5:
    """A rate that wanders with density q, and what it is the rate of."""
    p[at, at] = p[at, at] + q * dt * dt * dt / wp.float64(3.0)
    p[at, rate] = p[at, rate] + q * dt * dt / wp.float64(2.0)
    p[rate, at] = p[rate, at] + q * dt * dt / wp.float64(2.0)
    p[rate, rate] = p[rate, rate] + q * dt
    return p


@wp.func
def _predict_constant_velocity(s: Vec5, p: Mat5, noise: Noise, dt: wp.float64):
    s[0] = s[0] + dt * s[3]
    s[1] = s[1] + dt * s[4]
    # F P Fᵀ, in which F adds dt times the rows of the rates to those of the places.
    for axis in range(2):
        for k in range(5):
            p[axis, k] = p[axis, k] + dt * p[axis + 3, k]
    for axis in range(2):
        for k in range(5):
            p[k, axis] = p[k, axis] + dt * p[k, axis + 3]
    for axis in range(2):
        p = _wander(p, axis, axis + 3, noise.acceleration, dt)
        p[axis, axis] = p[axis, axis] + noise.slip * dt
    p[2, 2] = p[2, 2] + noise.yaw * dt
    return s, p


@wp.func
def _predict_turning(s: Vec5, p: Mat5, noise: Noise, dt: wp.float64, turns: wp.bool):
    f = Mat5()
    for k in range(5):
        f[k, k] = wp.float64(1.0)
    way = s[3] * dt
    half = wp.float64(0.0)
    if turns:
        half = s[4] * dt / wp.float64(2.0)
    # The chord of the circle: its direction is that of the middle, its length the arc's times sin(h) / h.
    middle = s[2] + half
    share = wp.float64(1.0) - half * half / wp.float64(6.0)
    slope = -half / wp.float64(3.0) + half * half * half / wp.float64(30.0)
    if wp.abs(half) > wp.float64(0.02):
        share = wp.sin(half) / half
        slope = (wp.cos(half) - share) / half
    c = wp.cos(middle)
    n = wp.sin(middle)
    s[0] = s[0] + way * share * c
    s[1] = s[1] + way * share * n
    s[2] = wrapped(s[2] + wp.float64(2.0) * half)
    f[0, 2] = -way * share * n
    f[1, 2] = way * share * c
    f[0, 3] = dt * share * c
    f[1, 3] = dt * share * n
    if turns:
        f[0, 4] = way * dt / wp.float64(2.0) * (slope * c - share * n)
        f[1, 4] = way * dt / wp.float64(2.0) * (slope * n + share * c)
        f[2, 4] = dt
    else:
        f[4, 4] = wp.float64(0.0)
        s[4] = wp.float64(0.0)
    p = f * p * wp.transpose(f)
    # The speed wanders along the chord, the turn rate about the vertical.
    q = noise.acceleration
    cubed = q * dt * dt * dt / wp.float64(3.0)
    squared = q * dt * dt / wp.float64(2.0)
    p[0, 0] = p[0, 0] + cubed * c * c + noise.slip * dt
    p[0, 1] = p[0, 1] + cubed * c * n
    p[1, 0] = p[1, 0] + cubed * c * n
    p[1, 1] = p[1, 1] + cubed * n * n + noise.slip * dt
    p[0, 3] = p[0, 3] + squared * c
    p[3, 0] = p[3, 0] + squared * c
    p[1, 3] = p[1, 3] + squared * n
    p[3, 1] = p[3, 1] + squared * n
    p[3, 3] = p[3, 3] + q * dt
    p[2, 2] = p[2, 2] + noise.yaw * dt
    if turns:
        p = _wander(p, 2, 4, noise.turn, dt)
    else:
        p[4, 4] = _TURN_RATE_OF_STRAIGHT
    return s, p


@wp.func
def predict(s: Vec5, p: Mat5, motion: int, noise: Noise, dt: wp.float64):
    """A filter's state and covariance `dt` seconds later."""
    if motion == CONSTANT_VELOCITY:
        s1, p1 = _predict_constant_velocity(s, p, noise, dt)
        return s1, p1
    s2, p2 = _predict_turning(s, p, noise, dt, motion == TURNING)
    return s2, p2


@wp.func
def correct(s: Vec5, p: Mat5, h: Vec5, innovation: wp.float64, variance: wp.float64):
    """A filter after one number was measured, and the logarithm of how likely that number was.

    Args:
        s: State.
        p: Covariance.
        h: Gradient of the number by the state.
        innovation: How far what was measured is above what was foretold.
        variance: Of the measurement.
    """
    ph = p * h
    total = wp.dot(h, ph) + variance
    s = s + ph * (innovation / total)
    p = p - wp.outer(ph, ph) / total
    log_two_pi = wp.float64(1.8378770664093453)
    return s, p, wp.float64(-0.5) * (innovation * innovation / total + wp.log(total) + log_two_pi)


@wp.func
def unit(k: int) -> Vec5:
    """The gradient of a number of the state itself."""
    h = Vec5()
    h[k] = wp.float64(1.0)
    return h


@wp.func
def correct_place(s: Vec5, p: Mat5, x: wp.float64, y: wp.float64, yaw: wp.float64, place: wp.float64, turn: wp.float64):
    """A filter after position and heading were measured, with variances `place` and `turn`; and the log-likelihood."""
    # Yaw first: its difference is taken the short way round, which is not linear.
    s1, p1, a = correct(s, p, unit(2), wrapped(yaw - s[2]), turn)
    s2, p2, b = correct(s1, p1, unit(0), x - s1[0], place)
    s3, p3, c = correct(s2, p2, unit(1), y - s2[1], place)
    s3[2] = wrapped(s3[2])
    return s3, p3, a + b + c


@wp.func
def velocity_of(s: Vec5, motion: int) -> wp.vec2d:
    """Velocity over the ground."""
    if motion == CONSTANT_VELOCITY:
        return wp.vec2d(s[3], s[4])
    return wp.vec2d(s[3] * wp.cos(s[2]), s[3] * wp.sin(s[2]))


@wp.func
def gradient_of_velocity(s: Vec5, motion: int, x: wp.float64, y: wp.float64) -> Vec5:
    """Of the velocity along the direction (x, y)."""
    h = Vec5()
    if motion == CONSTANT_VELOCITY:
        h[3] = x
        h[4] = y
    else:
        c = wp.cos(s[2])
        n = wp.sin(s[2])
        h[2] = s[3] * (y * c - x * n)
        h[3] = x * c + y * n
    return h


@wp.func
def correct_velocity(
    s: Vec5, p: Mat5, motion: int, x: wp.float64, y: wp.float64, speed: wp.float64, variance: wp.float64
):
    """A filter after the speed along the direction (x, y) was measured; and the log-likelihood."""
    h = gradient_of_velocity(s, motion, x, y)
    v = velocity_of(s, motion)
    s1, p1, likely = correct(s, p, h, speed - (v[0] * x + v[1] * y), variance)
    s1[2] = wrapped(s1[2])
    return s1, p1, likely


@wp.func
def cartesian(s: Vec5, p: Mat5, motion: int) -> Mat4:
    """Covariance of x y vx vy."""
    v0 = gradient_of_velocity(s, motion, wp.float64(1.0), wp.float64(0.0))
    v1 = gradient_of_velocity(s, motion, wp.float64(0.0), wp.float64(1.0))
    p0 = p * v0
    p1 = p * v1
    c = Mat4()
    for i in range(2):
        for j in range(2):
            c[i, j] = p[i, j]
        c[i, 2] = p0[i]
        c[2, i] = p0[i]
        c[i, 3] = p1[i]
        c[3, i] = p1[i]
    c[2, 2] = wp.dot(v0, p0)
    c[2, 3] = wp.dot(v0, p1)
    c[3, 2] = c[2, 3]
    c[3, 3] = wp.dot(v1, p1)
    return c


@wp.func
def difference(a: Vec5, b: Vec5) -> Vec5:
    """The first less the second, with headings the short way round."""
    d = a - b
    d[2] = wrapped(d[2])
    return d


@wp.func
def mean_of(a: Vec5, b: Vec5, share: wp.float64) -> Vec5:
    """What lies between two states, `share` of the way from a to b."""
    m = a + difference(b, a) * share
    m[2] = wrapped(m[2])
    return m


@wp.func
def spread_of(a: Vec5, pa: Mat5, b: Vec5, pb: Mat5, share: wp.float64) -> Mat5:
    """Covariance of a mixture of two, about its mean."""
    d = difference(b, a)
    rest = wp.float64(1.0) - share
    return pa * rest + pb * share + wp.outer(d, d) * (share * rest)


@wp.func
def mix(a: Vec5, pa: Mat5, b: Vec5, pb: Mat5, probability: wp.float64, switch: wp.float64):
    """The interaction step: what each of two filters starts from, if its motion may have begun just now.

    Args:
        a: State of the one that goes straight.
        pa: Its covariance.
        b: State of the one that turns.
        pb: Its covariance.
        probability: That the object turns.
        switch: Probability that it went over from one to the other since.

    Returns:
        The four, mixed, and the probability that it turns now, before any measurement.
    """
    rest = wp.float64(1.0) - probability
    turning = probability * (wp.float64(1.0) - switch) + rest * switch
    into_straight = probability * switch / wp.max(wp.float64(1.0) - turning, wp.float64(1e-12))
    into_turning = probability * (wp.float64(1.0) - switch) / wp.max(turning, wp.float64(1e-12))
    a1 = mean_of(a, b, into_straight)
    b1 = mean_of(a, b, into_turning)
    pa1 = spread_of(a, pa, b, pb, into_straight)
    pb1 = spread_of(a, pa, b, pb, into_turning)
    return a1, pa1, b1, pb1, turning


@wp.func
def posterior(turning: wp.float64, straight_likely: wp.float64, turning_likely: wp.float64) -> wp.float64:
    """The probability that it turns, after measurements of these log-likelihoods."""
    # Neither motion ever becomes impossible: the way back to it would take too long.
    odds = wp.exp(wp.clamp(straight_likely - turning_likely, wp.float64(-30.0), wp.float64(30.0)))
    p = turning / (turning + (wp.float64(1.0) - turning) * odds)
    return wp.clamp(p, wp.float64(1e-3), wp.float64(1.0) - wp.float64(1e-3))
