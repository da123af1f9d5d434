"""One Gauss–Newton step of point-to-point registration on SE(3), for device code: sums, the step, its length.

A step moves the sensor and turns it about its own place, so that the numbers are as good far from the map's origin.
"""

from __future__ import annotations

import warp as wp

from .device import DEFAULT_DEVICE  # noqa: F401  (starts Warp quietly)

__all__ = ["COUNT", "SQUARES", "Step", "Sums", "narrowed", "solve", "stepped", "stretch_of", "terms_of"]

# Sums must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

# What is summed over all points, w being a point's weight, r its residual, a its arm from the sensor:
# w, w a (3), w a aᵀ (xx xy xz yy yz zz), w r (3), w a × r (3), r², and how many there are.
_W, _A, _AA, _R, _AR, SQUARES, COUNT = (wp.constant(i) for i in (0, 1, 4, 10, 13, 16, 17))
Sums = wp.types.vector(length=18, dtype=wp.float64)
Step = wp.types.vector(length=6, dtype=wp.float64)
_System = wp.types.matrix(shape=(6, 6), dtype=wp.float64)
_SMALL_STEP = wp.constant(wp.float32(0.01))  # beside the kernel's scale
_LONGEST = wp.constant(wp.float64(4.0))  # as many times a step may be lengthened


@wp.func
def terms_of(w: wp.float64, r: wp.vec3d, a: wp.vec3d) -> Sums:
    """What one point adds to the sums; nothing for weight 0."""
    s = Sums()
    if w > wp.float64(0.0):
        s[0] = w
        s[1] = w * a[0]
        s[2] = w * a[1]
        s[3] = w * a[2]
        s[4] = w * a[0] * a[0]
        s[5] = w * a[0] * a[1]
        s[6] = w * a[0] * a[2]
        s[7] = w * a[1] * a[1]
        s[8] = w * a[1] * a[2]
        s[9] = w * a[2] * a[2]
        s[10] = w * r[0]
        s[11] = w * r[1]
        s[12] = w * r[2]
        s[13] = w * (a[1] * r[2] - a[2] * r[1])
        s[14] = w * (a[2] * r[0] - a[0] * r[2])
        s[15] = w * (a[0] * r[1] - a[1] * r[0])
        s[16] = wp.length_sq(r)
        s[17] = wp.float64(1.0)
    return s


@wp.func
def solve(s: Sums) -> Step:
    """The Gauss–Newton step: translation, then rotation vector about the sensor, by Cholesky's decomposition.

    No step where there is nothing to go by.
    """
    zero = wp.float64(0.0)
    h = _System()
    for k in range(3):
        h[k, k] = s[_W]
    # The upper right block is -w [a]×.
    h[0, 4] = s[_A + 2]
    h[0, 5] = -s[_A + 1]
    h[1, 3] = -s[_A + 2]
    h[1, 5] = s[_A]
    h[2, 3] = s[_A + 1]
    h[2, 4] = -s[_A]
    h[3, 3] = s[_AA + 3] + s[_AA + 5]
    h[4, 4] = s[_AA] + s[_AA + 5]
    h[5, 5] = s[_AA] + s[_AA + 3]
    h[3, 4] = -s[_AA + 1]
    h[3, 5] = -s[_AA + 2]
    h[4, 5] = -s[_AA + 4]
    # What the points say nothing about, such as a turn about the line that all lie on, is left as it is.
    tiny = wp.float64(1.0e-9)
    inertia = (h[3, 3] + h[4, 4] + h[5, 5]) * tiny + s[_W] * tiny
    for k in range(3):
        h[k, k] = h[k, k] + s[_W] * tiny
        h[k + 3, k + 3] = h[k + 3, k + 3] + inertia
    x = Step()
    for k in range(3):
        x[k] = -s[_R + k]
        x[k + 3] = -s[_AR + k]
    # h = uᵀ u, u upper triangular in place of h.
    for i in range(6):
        for k in range(i):
            h[i, i] = h[i, i] - h[k, i] * h[k, i]
        if h[i, i] <= zero:
            return Step()
        h[i, i] = wp.sqrt(h[i, i])
        for j in range(i + 1, 6):
            for k in range(i):
                h[i, j] = h[i, j] - h[k, i] * h[k, j]
            h[i, j] = h[i, j] / h[i, i]
    for i in range(6):
        for k in range(i):
            x[i] = x[i] - h[k, i] * x[k]
        x[i] = x[i] / h[i, i]
    for back in range(6):
        i = 5 - back
        for k in range(i + 1, 6):
            x[i] = x[i] - h[i, k] * x[k]
        x[i] = x[i] / h[i, i]
    return x


@wp.func
def stepped(pose: wp.mat44d, x: Step) -> wp.mat44d:
    """The pose moved by a step and turned about its own place, its rotation kept a rotation."""
    one = wp.float64(1.0)
    half = wp.float64(0.5)
    turn = wp.vec3d(x[3], x[4], x[5])
    angle = wp.length(turn)
    # Rodrigues' formula.
    sine = one - angle * angle / wp.float64(6.0)
    cosine = half - angle * angle / wp.float64(24.0)
    if angle > wp.float64(1.0e-4):
        sine = wp.sin(angle) / angle
        cosine = (one - wp.cos(angle)) / (angle * angle)
    cross = wp.skew(turn)
    exponential = wp.identity(n=3, dtype=wp.float64) + sine * cross + cosine * (cross * cross)
    rotation = wp.mat33d(
        pose[0, 0], pose[0, 1], pose[0, 2], pose[1, 0], pose[1, 1], pose[1, 2], pose[2, 0], pose[2, 1], pose[2, 2]
    )
    rotation = exponential * rotation
    # One step of Newton's to the nearest rotation.
    rotation = wp.float64(1.5) * rotation - half * (rotation * wp.transpose(rotation) * rotation)
    moved = wp.mat44d(pose)
    for i in range(3):
        for j in range(3):
            moved[i, j] = rotation[i, j]
        moved[i, 3] = pose[i, 3] + x[i]
    return moved


@wp.func
def narrowed(scale: float, final_scale: float, x: Step) -> float:
    """The kernel's scale after a step: half of it once steps are small beside it, but not below the final one."""
    following = float(scale)
    if float(wp.length_sq(x)) < _SMALL_STEP * _SMALL_STEP * scale * scale:
        following = wp.max(0.5 * scale, final_scale)
    return following


@wp.func
def stretch_of(s: Sums, x: Step, last: Step, last_stretch: wp.float64) -> wp.float64:
    """By how much to lengthen a step, from how it compares with the last (Barzilai and Borwein, 1988).

    ICP's steps shrink by a near constant share, as each finds but a part of the way: a longer one saves many. Turns
    count by how far they move the points.
    """
    one = wp.float64(1.0)
    arm_sq = wp.float64(0.0)
    if s[_W] > wp.float64(0.0):
        arm_sq = (s[_AA] + s[_AA + 3] + s[_AA + 5]) / s[_W]
    along = wp.float64(0.0)
    before = wp.float64(0.0)
    for k in range(3):
        along += x[k] * last[k] + arm_sq * x[k + 3] * last[k + 3]
        before += last[k] * last[k] + arm_sq * last[k + 3] * last[k + 3]
    stretch = one
    # Only where it goes on the same way, and by less.
    if along > wp.float64(0.0):
        stretch = _LONGEST
        if along * _LONGEST < before * (_LONGEST - last_stretch):
            stretch = wp.max(last_stretch * before / (before - along), one)
    return stretch
