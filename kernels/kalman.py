"""Batched Kalman filters for boxes: prediction and correction of all tracks at once, one thread a track.

A state begins with the seven numbers of a box, x y z l w h yaw, and goes on with rates:

- `constant_velocity`: vx vy vz, ten numbers; the box moves along the world's axes.
- `ctrv`: speed along the heading and yaw rate, nine numbers; the box moves on a circle (constant turn rate and
  velocity: Schubert et al., 2008), as an extended filter.

Measurements are boxes, each number with a variance of its own, so they can be taken up one number after the other: that
is the textbook's correction without inverting a matrix, and a number that was not measured is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE, resolve_device
from .interop import borrow, count_on, family_of, give

__all__ = ["STATE_SIZES", "KalmanFilter", "KalmanUpdate", "kalman_predict", "kalman_update"]

STATE_SIZES = {"constant_velocity": 10, "ctrv": 9}
"""How many numbers the state of each motion model has."""

_DTYPES = {"float32": wp.float32, "float64": wp.float64}
_MEASURED = wp.constant(7)
_YAW, _SPEED, _YAW_RATE = wp.constant(6), wp.constant(7), wp.constant(8)


@wp.func
def _is_active(i: int, active: wp.array(dtype=wp.int32), count: wp.array(dtype=wp.int32)) -> bool:
    if i >= count[0]:
        return False
    if active:
        return active[i] != 0
    return True


@wp.func
def _row(i: int, rows: int) -> int:
    """The row of a table that has one for each track, or one for all."""
    return wp.where(rows == 1, 0, i)


@wp.func
def _wrapped(angle: Any):
    """An angle in [−π, π)."""
    half = type(angle)(wp.PI)
    return angle - half * type(angle)(2.0) * wp.floor((angle + half) / (half * type(angle)(2.0)))


@wp.func
def _add_row(p: wp.array3d(dtype=Any), i: int, to: int, source: int, factor: Any):
    for j in range(p.shape[2]):
        p[i, to, j] = p[i, to, j] + factor * p[i, source, j]


@wp.func
def _add_column(p: wp.array3d(dtype=Any), i: int, to: int, source: int, factor: Any):
    for j in range(p.shape[1]):
        p[i, j, to] = p[i, j, to] + factor * p[i, j, source]


@wp.func
def _add_noise(p: wp.array3d(dtype=Any), i: int, at: int, rate: int, q: Any, dt: Any):
    """A rate that wanders with spectral density q, and what it is the rate of."""
    p[i, at, at] = p[i, at, at] + q * dt * dt * dt / type(dt)(3.0)
    p[i, at, rate] = p[i, at, rate] + q * dt * dt / type(dt)(2.0)
    p[i, rate, at] = p[i, rate, at] + q * dt * dt / type(dt)(2.0)
    p[i, rate, rate] = p[i, rate, rate] + q * dt


@wp.kernel
def _predict_constant_velocity(
    # in
    dt_in: wp.array(dtype=Any),
    noise_in: wp.array2d(dtype=Any),
    active_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    # in out
    state: wp.array2d(dtype=Any),
    p: wp.array3d(dtype=Any),
):
    i = wp.tid()
    if not _is_active(i, active_in, count_in):
        return
    dt = dt_in[_row(i, dt_in.shape[0])]
    row = _row(i, noise_in.shape[0])
    for axis in range(3):
        rate = _MEASURED + axis
        state[i, axis] = state[i, axis] + dt * state[i, rate]
        _add_row(p, i, axis, rate, dt)
    for axis in range(3):
        rate = _MEASURED + axis
        _add_column(p, i, axis, rate, dt)
    for axis in range(3):
        rate = _MEASURED + axis
        _add_noise(p, i, axis, rate, noise_in[row, rate], dt)
    for k in range(_MEASURED):
        p[i, k, k] = p[i, k, k] + noise_in[row, k] * dt


@wp.kernel
def _predict_ctrv(
    # in
    dt_in: wp.array(dtype=Any),
    noise_in: wp.array2d(dtype=Any),
    active_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    # in out
    state: wp.array2d(dtype=Any),
    p: wp.array3d(dtype=Any),
):
    i = wp.tid()
    if not _is_active(i, active_in, count_in):
        return
    dt = dt_in[_row(i, dt_in.shape[0])]
    row = _row(i, noise_in.shape[0])
    speed = state[i, _SPEED]
    turn = state[i, _YAW_RATE] * dt
    half = turn / type(dt)(2.0)
    # The chord of the circle: its direction is that of the middle, its length the arc's times sin(h) / h.
    middle = state[i, _YAW] + half
    share = type(dt)(1.0) - half * half / type(dt)(6.0)
    slope = -half / type(dt)(3.0) + half * half * half / type(dt)(30.0)
    if wp.abs(half) > type(dt)(0.02):
        share = wp.sin(half) / half
        slope = (wp.cos(half) - share) / half
    c = wp.cos(middle)
    s = wp.sin(middle)
    way = speed * dt
    state[i, 0] = state[i, 0] + way * share * c
    state[i, 1] = state[i, 1] + way * share * s
    state[i, _YAW] = _wrapped(state[i, _YAW] + turn)
    # The Jacobian is the identity but for x, y and yaw.
    x_yaw = -way * share * s
    y_yaw = way * share * c
    x_speed = dt * share * c
    y_speed = dt * share * s
    x_rate = way * dt / type(dt)(2.0) * (slope * c - share * s)
    y_rate = way * dt / type(dt)(2.0) * (slope * s + share * c)
    _add_row(p, i, 0, _YAW, x_yaw)
    _add_row(p, i, 0, _SPEED, x_speed)
    _add_row(p, i, 0, _YAW_RATE, x_rate)
    _add_row(p, i, 1, _YAW, y_yaw)
    _add_row(p, i, 1, _SPEED, y_speed)
    _add_row(p, i, 1, _YAW_RATE, y_rate)
    _add_row(p, i, _YAW, _YAW_RATE, dt)
    _add_column(p, i, 0, _YAW, x_yaw)
    _add_column(p, i, 0, _SPEED, x_speed)
    _add_column(p, i, 0, _YAW_RATE, x_rate)
    _add_column(p, i, 1, _YAW, y_yaw)
    _add_column(p, i, 1, _SPEED, y_speed)
    _add_column(p, i, 1, _YAW_RATE, y_rate)
    _add_column(p, i, _YAW, _YAW_RATE, dt)
    # The speed wanders along the chord, the yaw rate about the vertical.
    q = noise_in[row, _SPEED]
    cubed = q * dt * dt * dt / type(dt)(3.0)
    squared = q * dt * dt / type(dt)(2.0)
    p[i, 0, 0] = p[i, 0, 0] + cubed * c * c
    p[i, 0, 1] = p[i, 0, 1] + cubed * c * s
    p[i, 1, 0] = p[i, 1, 0] + cubed * c * s
    p[i, 1, 1] = p[i, 1, 1] + cubed * s * s
    p[i, 0, _SPEED] = p[i, 0, _SPEED] + squared * c
    p[i, _SPEED, 0] = p[i, _SPEED, 0] + squared * c
    p[i, 1, _SPEED] = p[i, 1, _SPEED] + squared * s
    p[i, _SPEED, 1] = p[i, _SPEED, 1] + squared * s
    p[i, _SPEED, _SPEED] = p[i, _SPEED, _SPEED] + q * dt
    _add_noise(p, i, _YAW, _YAW_RATE, noise_in[row, _YAW_RATE], dt)
    for k in range(_MEASURED):
        p[i, k, k] = p[i, k, k] + noise_in[row, k] * dt


@wp.kernel
def _update(
    # in
    measured_in: wp.array2d(dtype=Any),
    noise_in: wp.array2d(dtype=Any),
    active_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    # in out
    state: wp.array2d(dtype=Any),
    p: wp.array3d(dtype=Any),
    # out
    distance_out: wp.array(dtype=Any),
    log_likelihood_out: wp.array(dtype=Any),
):
    """Takes up a measurement number by number, yaw first: its difference is not linear, and so is the textbook's."""
    i = wp.tid()
    if i >= distance_out.shape[0]:
        return
    zero = noise_in.dtype(0.0)
    distance = noise_in.dtype(0.0)
    log_determinant = noise_in.dtype(0.0)
    numbers = int(0)
    if _is_active(i, active_in, count_in):
        row = _row(i, noise_in.shape[0])
        size = state.shape[1]
        for step in range(_MEASURED):
            k = wp.where(step == 0, _YAW, step - 1)
            z = measured_in[i, k]
            r = noise_in[row, k]
            variance = p[i, k, k] + r
            if wp.isfinite(z) and variance > zero:
                innovation = z - state[i, k]
                if k == _YAW:
                    innovation = _wrapped(innovation)
                inverse = noise_in.dtype(1.0) / variance
                pull = innovation * inverse
                for a in range(size):
                    state[i, a] = state[i, a] + p[i, a, k] * pull
                # P − P[:, k] P[k, :] / variance, which leaves of row and column k the share r / variance.
                for a in range(size):
                    if a != k:
                        gain = p[i, a, k] * inverse
                        for b in range(a, size):
                            if b != k:
                                rest = p[i, a, b] - gain * p[i, k, b]
                                p[i, a, b] = rest
                                p[i, b, a] = rest
                left = r * inverse
                for a in range(size):
                    if a != k:
                        p[i, a, k] = p[i, a, k] * left
                        p[i, k, a] = p[i, a, k]
                p[i, k, k] = p[i, k, k] * left
                distance += innovation * innovation / variance
                log_determinant += wp.log(variance)
                numbers += 1
        state[i, _YAW] = _wrapped(state[i, _YAW])
    distance_out[i] = distance
    log_two_pi = noise_in.dtype(1.8378770664093453)
    log_likelihood_out[i] = noise_in.dtype(-0.5) * (distance + log_determinant + noise_in.dtype(numbers) * log_two_pi)


def _launch_predict(
    model: str, dt: wp.array, noise: wp.array, active: wp.array | None, count: wp.array, state: wp.array, p: wp.array
) -> None:
    kernel = _predict_ctrv if model == "ctrv" else _predict_constant_velocity
    wp.launch(kernel, state.shape[0], inputs=[dt, noise, active, count], outputs=[state, p], device=state.device)


@dataclass(frozen=True, kw_only=True)
class KalmanFilter:
    """A plan: the filters of up to `capacity` tracks, whose states it keeps and changes in place."""

    capacity: int
    """Tracks at most."""
    model: str = "constant_velocity"
    """How tracks move: `constant_velocity` or `ctrv`, see above."""
    dtype: str = "float32"
    """Of all numbers: `float32` or `float64`."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    state: wp.array = field(init=False, repr=False, compare=False)
    """In out: shape (capacity, 10 or 9)."""
    covariance: wp.array = field(init=False, repr=False, compare=False)
    """In out: shape (capacity, 10 or 9, 10 or 9), symmetric."""
    active: wp.array = field(init=False, repr=False, compare=False)
    """In: tracks to be predicted and corrected, 1 or 0, shape (capacity,), int32; others stay as they are."""
    distance: wp.array = field(init=False, repr=False, compare=False)
    """Out of `update`: squared Mahalanobis distance of each measurement from its prediction, shape (capacity,)."""
    log_likelihood: wp.array = field(init=False, repr=False, compare=False)
    """Out of `update`: logarithm of each measurement's probability density, shape (capacity,)."""

    def __post_init__(self):
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be at least 1 and below 2³¹, not {self.capacity}")
        size = _state_size(self.model)
        if self.dtype not in _DTYPES:
            raise ValueError(f"dtype must be one of {', '.join(_DTYPES)}, not {self.dtype!r}")
        device, dtype = resolve_device(self.device), _DTYPES[self.dtype]

        def buffer(name: str, shape: int | tuple[int, ...], kind: type = dtype) -> None:
            object.__setattr__(self, name, wp.zeros(shape, dtype=kind, device=device))

        buffer("state", (self.capacity, size))
        buffer("covariance", (self.capacity, size, size))
        buffer("active", self.capacity, wp.int32)
        buffer("distance", self.capacity)
        buffer("log_likelihood", self.capacity)

    def predict(self, dt: wp.array, noise: wp.array) -> None:
        """Moves the active tracks forward in time; allocates nothing, reads nothing back.

        Args:
            dt: By how long [s], shape (1,) or (capacity,).
            noise: Spectral densities of what the numbers wander by, each its unit squared per second, shape (1, 10 or
                9) or (capacity, 10 or 9).
        """
        count = count_on(self.capacity, str(self.state.device))
        _launch_predict(self.model, dt, noise, self.active, count, self.state, self.covariance)

    def update(self, measurements: wp.array, noise: wp.array) -> None:
        """Corrects the active tracks by a measurement each; allocates nothing, reads nothing back.

        Args:
            measurements: Boxes, shape (capacity, 7); NaN for what was not measured.
            noise: Their variances, shape (1, 7) or (capacity, 7).
        """
        wp.launch(
            _update,
            self.capacity,
            inputs=[measurements, noise, self.active, count_on(self.capacity, str(self.state.device))],
            outputs=[self.state, self.covariance, self.distance, self.log_likelihood],
            device=self.state.device,
        )


@dataclass(frozen=True, eq=False)
class KalmanUpdate:
    """What `kalman_update` made of the tracks."""

    state: Any
    """Corrected, shape (n, 10 or 9)."""
    covariance: Any
    """Shape (n, 10 or 9, 10 or 9)."""
    distance: Any
    """Squared Mahalanobis distance of each measurement from its prediction, shape (n,); 0 where nothing was taken."""
    log_likelihood: Any
    """Logarithm of each measurement's probability density, shape (n,); 0 where nothing was taken."""


def _state_size(model: str) -> int:
    if model not in STATE_SIZES:
        raise ValueError(f"model must be one of {', '.join(STATE_SIZES)}, not {model!r}")
    return STATE_SIZES[model]


class _Tracks:
    """Copies of what a function was given, and views of what it only reads; all on the device of the state."""

    def __init__(self, state: Any, covariance: Any, model: str, active: Any):
        size = _state_size(model)
        self.family = family_of(state, "state")
        self.dtype = wp.float64 if "float64" in str(state.dtype) else wp.float32
        self._owners: list[Any] = []
        self.state = wp.clone(self.view(state, self.dtype, (None, size), "state"))
        self.n = self.state.shape[0]
        self.covariance = wp.clone(self.view(covariance, self.dtype, (self.n, size, size), "covariance"))
        self.active = None if active is None else self.view(active, wp.int32, (self.n,), "active")
        self.count = count_on(self.n, str(self.state.device))

    def view(self, array: Any, dtype: Any, shape: tuple[int | None, ...], name: str) -> wp.array:
        """An array as the kernels take it; what owns its memory is kept."""
        view, owner = borrow(array, dtype, shape, name)
        if str(view.device) != self.family.device:
            raise ValueError(
                f"{name} is on {view.device} and state on {self.family.device}; both must be on one device"
            )
        self._owners.append(owner)
        return view

    def table(self, array: Any, columns: int, name: str) -> wp.array:
        """Numbers for all tracks, shape (columns,), or for each, (n, columns): as a table of 1 or of n rows."""
        family_of(array, name)
        if len(array.shape) == 1:
            return self.view(array, self.dtype, (columns,), name).reshape((1, columns))
        return self.view(array, self.dtype, (self.n, columns), name)


def kalman_predict(
    state: Any,
    covariance: Any,
    dt: Any,
    noise: Any,
    *,
    model: str = "constant_velocity",
    active: Any = None,
) -> tuple[Any, Any]:
    """Moves the states of tracks forward in time.

    The noise is white and acts all the time: a number that has a rate of density q gains q dt³ / 3 in variance, its
    rate q dt, and both together q dt² / 2; any other number q dt.

    Args:
        state: x y z l w h yaw and the rates of the model [m, rad, s], shape (n, 10) or (n, 9), see the module; float64
            is computed in double precision, any other type in single.
        covariance: Of the states, symmetric, shape (n, 10, 10) or (n, 9, 9).
        dt: By how long [s]: a number, or for each track, shape (n,).
        noise: Spectral densities by which the numbers of a state wander, each its unit squared per second, shape (10,)
            or (9,), or for each track (n, 10) or (n, 9).
        model: `constant_velocity` or `ctrv`.
        active: The tracks to move, shape (n,), bool or integer; the others stay as they are. By default all.

    Returns:
        New states and covariances, of the family of `state`.

    Raises:
        TypeError: Something is not an array.
        ValueError: A shape does not fit, the devices differ, or there is no such model; the message says which.
    """
    tracks = _Tracks(state, covariance, model, active)
    if isinstance(dt, float | int):
        if not math.isfinite(dt):
            raise ValueError(f"dt must be a finite number of seconds, not {dt}")
        steps = wp.array([dt], dtype=tracks.dtype, device=tracks.state.device)
    else:
        steps = tracks.view(dt, tracks.dtype, (tracks.n,), "dt")
    wander = tracks.table(noise, STATE_SIZES[model], "noise")
    if tracks.n:
        _launch_predict(model, steps, wander, tracks.active, tracks.count, tracks.state, tracks.covariance)
    return give(tracks.state, tracks.family), give(tracks.covariance, tracks.family)


def kalman_update(
    state: Any,
    covariance: Any,
    measurements: Any,
    noise: Any,
    *,
    model: str = "constant_velocity",
    active: Any = None,
) -> KalmanUpdate:
    """Corrects the states of tracks by measured boxes, one for each.

    Args:
        state: x y z l w h yaw and the rates of the model [m, rad, s], shape (n, 10) or (n, 9), see the module; float64
            is computed in double precision, any other type in single.
        covariance: Of the states, symmetric, shape (n, 10, 10) or (n, 9, 9).
        measurements: x y z l w h yaw, shape (n, 7); what is not finite was not measured. A difference in yaw is taken
            the short way round.
        noise: Variances of the seven, shape (7,), or for each track (n, 7).
        model: `constant_velocity` or `ctrv`.
        active: The tracks to correct, shape (n,), bool or integer; the others stay as they are. By default all.

    Returns:
        New states and covariances, and how far and how likely the measurements were; of the family of `state`.

    Raises:
        TypeError: Something is not an array.
        ValueError: A shape does not fit, the devices differ, or there is no such model; the message says which.
    """
    tracks = _Tracks(state, covariance, model, active)
    measured = tracks.view(measurements, tracks.dtype, (tracks.n, 7), "measurements")
    variances = tracks.table(noise, 7, "noise")
    distance, log_likelihood = (wp.zeros(tracks.n, dtype=tracks.dtype, device=tracks.state.device) for _ in range(2))
    if tracks.n:
        wp.launch(
            _update,
            tracks.n,
            inputs=[measured, variances, tracks.active, tracks.count],
            outputs=[tracks.state, tracks.covariance, distance, log_likelihood],
            device=tracks.state.device,
        )
    results = (give(array, tracks.family) for array in (tracks.state, tracks.covariance, distance, log_likelihood))
    return KalmanUpdate(*results)
