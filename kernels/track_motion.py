"""How tracked objects move over the ground: prediction and correction of one track's filter, for use in kernels.

Each filter has five numbers, the first three of which are measured:

- constant velocity: x y yaw vx vy; the heading wanders by itself.
- constant turn rate and velocity (Schubert et al., 2008): x y yaw speed turn-rate, with the speed along the heading;
  an extended filter. Going straight on is the same without a turn rate.

A filter stands in a row of a table, its state from column `at` on and its covariance by rows after that: all is done
in place, with loops that compile fast.

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
    "Noise",
    "Table",
    "Vec5",
    "correct_place",
    "correct_velocity",
    "covariance_between",
    "gradient_of_velocity",
    "mix",
    "posterior",
    "predict",
    "turn_round",
    "unit",
    "velocity_of",
    "wrapped",
]

Table = wp.array2d(dtype=wp.float64)
"""What filters stand in."""
Vec5 = wp.types.vector(length=5, dtype=wp.float64)
"""What is computed along a state."""

CONSTANT_VELOCITY, STRAIGHT, TURNING = (wp.constant(wp.int32(i)) for i in range(3))
"""Which motion a filter has."""

_TURN_RATE_OF_STRAIGHT = wp.constant(wp.float64(1e-4))  # variance, so that a covariance stays regular
_P = wp.constant(wp.int32(5))  # of the covariance, after the state


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
def _add(f: Table, i: int, at: int, row: int, column: int, value: wp.float64):
    """Adds to an entry of the covariance and to the one across."""
    k = at + _P + 5 * row + column
    f[i, k] = f[i, k] + value
    if row != column:
        k = at + _P + 5 * column + row
        f[i, k] = f[i, k] + value


@wp.func
def _shear(f: Table, i: int, at: int, to: int, source: int, factor: wp.float64):
    """Takes the covariance through x[to] += factor · x[source]."""
    row = at + _P + 5 * to
    other = at + _P + 5 * source
    for k in range(5):
        f[i, row + k] = f[i, row + k] + factor * f[i, other + k]
    row = at + _P + to
    other = at + _P + source
    for k in range(5):
        f[i, row + 5 * k] = f[i, row + 5 * k] + factor * f[i, other + 5 * k]


@wp.func
def _wander(f: Table, i: int, at: int, place: int, rate: int, q: wp.float64, dt: wp.float64):
    """A rate that wanders with density q, and what it is the rate of."""
    _add(f, i, at, place, place, q * dt * dt * dt / wp.float64(3.0))
    _add(f, i, at, place, rate, q * dt * dt / wp.float64(2.0))
    _add(f, i, at, rate, rate, q * dt)


@wp.func
def _predict_constant_velocity(f: Table, i: int, at: int, noise: Noise, dt: wp.float64):
    for axis in range(2):
        f[i, at + axis] = f[i, at + axis] + dt * f[i, at + 3 + axis]
        _shear(f, i, at, axis, axis + 3, dt)
    for axis in range(2):
        _wander(f, i, at, axis, axis + 3, noise.acceleration, dt)
        _add(f, i, at, axis, axis, noise.slip * dt)


@wp.func
def _predict_turning(f: Table, i: int, at: int, noise: Noise, dt: wp.float64, turns: wp.bool):
    way = f[i, at + 3] * dt
    half = wp.float64(0.0)
    if turns:
        half = f[i, at + 4] * dt / wp.float64(2.0)
    # The chord of the circle: its direction is that of the middle, its length the arc's times sin(h) / h.
    middle = f[i, at + 2] + half
    share = wp.float64(1.0) - half * half / wp.float64(6.0)
    slope = -half / wp.float64(3.0) + half * half * half / wp.float64(30.0)
    if wp.abs(half) > wp.float64(0.02):
        share = wp.sin(half) / half
        slope = (wp.cos(half) - share) / half
    f[i, at + 2] = wrapped(f[i, at + 2] + wp.float64(2.0) * half)
    # The Jacobian is the identity but for x, y and yaw, and no two of its entries follow on each other: sheared by one
    # after the other, x and y before yaw.
    for axis in range(2):
        c = wp.cos(middle)
        n = -wp.sin(middle)
        if axis == 1:
            n = c
            c = wp.sin(middle)
        f[i, at + axis] = f[i, at + axis] + way * share * c
        _shear(f, i, at, axis, 2, way * share * n)
        _shear(f, i, at, axis, 3, dt * share * c)
        if turns:
            _shear(f, i, at, axis, 4, way * dt / wp.float64(2.0) * (slope * c + share * n))
    if turns:
        _shear(f, i, at, 2, 4, dt)
        _wander(f, i, at, 2, 4, noise.turn, dt)
    else:
        f[i, at + 4] = wp.float64(0.0)
        for k in range(5):
            f[i, at + _P + 20 + k] = wp.float64(0.0)
            f[i, at + _P + 5 * k + 4] = wp.float64(0.0)
        f[i, at + _P + 24] = _TURN_RATE_OF_STRAIGHT
    # The speed wanders along the chord.
    q = noise.acceleration
    cubed = q * dt * dt * dt / wp.float64(3.0)
    squared = q * dt * dt / wp.float64(2.0)
    x = wp.cos(middle)
    y = wp.sin(middle)
    _add(f, i, at, 0, 0, cubed * x * x + noise.slip * dt)
    _add(f, i, at, 0, 1, cubed * x * y)
    _add(f, i, at, 1, 1, cubed * y * y + noise.slip * dt)
    _add(f, i, at, 0, 3, squared * x)
    _add(f, i, at, 1, 3, squared * y)
    _add(f, i, at, 3, 3, q * dt)


@wp.func
def predict(f: Table, i: int, at: int, motion: int, noise: Noise, dt: wp.float64):
    """Moves a filter `dt` seconds on."""
    if motion == CONSTANT_VELOCITY:
        _predict_constant_velocity(f, i, at, noise, dt)
    else:
        _predict_turning(f, i, at, noise, dt, motion == TURNING)
    _add(f, i, at, 2, 2, noise.yaw * dt)


@wp.func
def unit(k: int) -> Vec5:
    """The gradient of a number of the state itself."""
    h = Vec5()
    h[k] = wp.float64(1.0)
    return h


@wp.func
def covariance_between(f: Table, i: int, at: int, a: Vec5, b: Vec5) -> wp.float64:
    """Of two numbers with the gradients a and b."""
    total = wp.float64(0.0)
    for row in range(5):
        along = wp.float64(0.0)
        for column in range(5):
            along += f[i, at + _P + 5 * row + column] * b[column]
        total += a[row] * along
    return total


@wp.func
def _correct(f: Table, i: int, at: int, h: Vec5, innovation: wp.float64, variance: wp.float64) -> wp.float64:
    """Corrects a filter by one number that was measured.

    Args:
        f: Table.
        i: Its row.
        at: Where the filter begins.
        h: Gradient of the number by the state.
        innovation: How far what was measured is above what was foretold.
        variance: Of the measurement.

    Returns:
        The logarithm of how likely that number was.
    """
    ph = Vec5()
    total = wp.float64(variance)
    for row in range(5):
        along = wp.float64(0.0)
        for column in range(5):
            along += f[i, at + _P + 5 * row + column] * h[column]
        ph[row] = along
        total += along * h[row]
    pull = innovation / total
    for row in range(5):
        f[i, at + row] = f[i, at + row] + ph[row] * pull
        gain = ph[row] / total
        for column in range(5):
            k = at + _P + 5 * row + column
            f[i, k] = f[i, k] - gain * ph[column]
    log_two_pi = wp.float64(1.8378770664093453)
    return wp.float64(-0.5) * (innovation * pull + wp.log(total) + log_two_pi)


@wp.func
def correct_place(
    f: Table,
    i: int,
    at: int,
    x: wp.float64,
    y: wp.float64,
    yaw: wp.float64,
    place: wp.float64,
    turn: wp.float64,
) -> wp.float64:
    """Corrects a filter by position and heading with variances `place` and `turn`; gives the log-likelihood."""
    # Yaw first: its difference is taken the short way round, which is not linear.
    likely = wp.float64(0.0)
    for step in range(3):
        k = (step + 2) % 3
        innovation = wrapped(yaw - f[i, at + 2])
        noise = turn
        if k == 0:
            innovation = x - f[i, at]
            noise = place
        elif k == 1:
            innovation = y - f[i, at + 1]
            noise = place
        likely += _correct(f, i, at, unit(k), innovation, noise)
    f[i, at + 2] = wrapped(f[i, at + 2])
    return likely


@wp.func
def velocity_of(f: Table, i: int, at: int, motion: int) -> wp.vec2d:
    """Velocity over the ground."""
    if motion == CONSTANT_VELOCITY:
        return wp.vec2d(f[i, at + 3], f[i, at + 4])
    return wp.vec2d(f[i, at + 3] * wp.cos(f[i, at + 2]), f[i, at + 3] * wp.sin(f[i, at + 2]))


@wp.func
def gradient_of_velocity(f: Table, i: int, at: int, motion: int, x: wp.float64, y: wp.float64) -> Vec5:
    """Of the velocity along the direction (x, y)."""
    h = Vec5()
    if motion == CONSTANT_VELOCITY:
        h[3] = x
        h[4] = y
    else:
        c = wp.cos(f[i, at + 2])
        n = wp.sin(f[i, at + 2])
        h[2] = f[i, at + 3] * (y * c - x * n)
        h[3] = x * c + y * n
    return h


@wp.func
def correct_velocity(
    f: Table,
    i: int,
    at: int,
    motion: int,
    x: wp.float64,
    y: wp.float64,
    speed: wp.float64,
    variance: wp.float64,
) -> wp.float64:
    """Corrects a filter by the speed along the direction (x, y); gives the log-likelihood."""
    h = gradient_of_velocity(f, i, at, motion, x, y)
    v = velocity_of(f, i, at, motion)
    likely = _correct(f, i, at, h, speed - (v[0] * x + v[1] * y), variance)
    f[i, at + 2] = wrapped(f[i, at + 2])
    return likely


@wp.func
def turn_round(f: Table, i: int, at: int, motion: int):
    """Turns a filter to the opposite heading, moving as before."""
    f[i, at + 2] = f[i, at + 2] + wp.float64(wp.PI)
    if motion != CONSTANT_VELOCITY:
        f[i, at + 3] = -f[i, at + 3]
        for k in range(5):
            if k != 3:
                f[i, at + _P + 15 + k] = -f[i, at + _P + 15 + k]
                f[i, at + _P + 5 * k + 3] = -f[i, at + _P + 5 * k + 3]


@wp.func
def mix(f: Table, i: int, a: int, b: int, probability: wp.float64, switch: wp.float64) -> wp.float64:
    """The interaction step: what each of two filters starts from, if its motion may have begun just now.

    Args:
        f: Table.
        i: Its row.
        a: Where the filter begins that goes straight.
        b: Where the one begins that turns.
        probability: That the object turns.
        switch: Probability that it went over from one to the other since.

    Returns:
        The probability that it turns now, before any measurement.
    """
    rest = wp.float64(1.0) - probability
    turning = probability * (wp.float64(1.0) - switch) + rest * switch
    into_straight = probability * switch / wp.max(wp.float64(1.0) - turning, wp.float64(1e-12))
    into_turning = probability * (wp.float64(1.0) - switch) / wp.max(turning, wp.float64(1e-12))
    d = Vec5()
    for k in range(5):
        d[k] = f[i, b + k] - f[i, a + k]
    d[2] = wrapped(d[2])
    spread_straight = into_straight * (wp.float64(1.0) - into_straight)
    spread_turning = into_turning * (wp.float64(1.0) - into_turning)
    for row in range(5):
        for column in range(5):
            k = _P + 5 * row + column
            first = f[i, a + k]
            more = f[i, b + k] - first
            apart = d[row] * d[column]
            f[i, a + k] = first + into_straight * more + spread_straight * apart
            f[i, b + k] = first + into_turning * more + spread_turning * apart
    for k in range(5):
        start = f[i, a + k]
        f[i, a + k] = start + into_straight * d[k]
        f[i, b + k] = start + into_turning * d[k]
    f[i, a + 2] = wrapped(f[i, a + 2])
    f[i, b + 2] = wrapped(f[i, b + 2])
    return turning


@wp.func
def posterior(turning: wp.float64, straight_likely: wp.float64, turning_likely: wp.float64) -> wp.float64:
    """The probability that it turns, after measurements of these log-likelihoods."""
    # Neither motion ever becomes impossible: the way back to it would take too long.
    odds = wp.exp(wp.clamp(straight_likely - turning_likely, wp.float64(-30.0), wp.float64(30.0)))
    p = turning / (turning + (wp.float64(1.0) - turning) * odds)
    return wp.clamp(p, wp.float64(1e-3), wp.float64(1.0) - wp.float64(1e-3))
