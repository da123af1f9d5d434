"""What a LiDAR makes of the faces its beams meet: echoes with range, intensity, loss, mixed edges and rain.

Signal: a Lambertian surface with a glossy lobe, falling with the square of the range; what is polished mirrors beams
away that graze it. Rain takes a share a metre and drops give echoes of their own (Goodin et al., "Predicting the
influence of rain on LIDAR in ADAS", Electronics 2019: two-way attenuation exp(−0.02 R^0.6 z)). A beam is not a line:
where its footprint lies over the edge between two surfaces that are nearer to each other than the pulse is long, the
two echoes become one in between.

All that looks like chance is a hash of seed and beam, so the same scene gives the same bytes again.
"""

from __future__ import annotations

import warp as wp

from .beams import MATERIALS, NO_HIT, turn_at, uniform

__all__ = ["DROP_REACH", "DROP_ZONE", "WITHIN", "compact_echoes", "make_echoes"]

DROP_REACH = wp.constant(4.0)
"""Mean range of the echoes of drops; farther ones are too weak [m]."""
DROP_ZONE = wp.constant(10.0)
"""Within which they are seen [m]."""

WITHIN = wp.constant(0.08)
"""Share of the echoes from the inside of what mirrors on its outside."""

_MATERIAL_MASK = wp.constant(MATERIALS - 1)
_CLASS_SHIFT = wp.constant(8)
_REFLECTIVITY, _LOSS, _GLOSS, _ROUGHNESS, _MIRROR = (wp.constant(i) for i in (0, 2, 3, 4, 5))
_POLISH_SEED = wp.constant(wp.uint32(0x9E3779B9))


@wp.func
def _gauss(seed: wp.uint32, a: wp.uint32, b: wp.uint32) -> float:
    """A nearly normal number, within ± 3.5: the sum of four uniform ones, which needs no logarithm and no cosine."""
    u = uniform(seed, a, b) + uniform(seed + wp.uint32(1), a, b)
    v = uniform(seed + wp.uint32(2), a, b) + uniform(seed + wp.uint32(3), a, b)
    return (u + v - 2.0) * 1.7320508


@wp.func
def _mixed(
    i: int,
    k: int,
    n: int,
    d: float,
    edge_share: float,
    pulse: float,
    seed: wp.uint32,
    ring_in: wp.array(dtype=wp.uint16),
    distance_in: wp.array(dtype=wp.float32),
    hit_label_in: wp.array(dtype=wp.int32),
) -> float:
    """The range of the merged echo where beam k's footprint lies over an edge, else d."""
    chance = uniform(seed, wp.uint32(k), wp.uint32(13))
    if chance >= edge_share:
        return d
    step = wp.where(chance < 0.5 * edge_share, -1, 1)
    other = k + step
    if other < 0 or other >= n:
        return d
    if ring_in[other] != ring_in[k] or hit_label_in[i + step] < 0:
        return d
    gap = distance_in[i + step] - d
    if wp.abs(gap) > pulse:
        return d
    return d + 0.5 * uniform(seed, wp.uint32(k), wp.uint32(14)) * gap


@wp.kernel
def make_echoes(
    # in: hits
    beams_in: wp.array(dtype=wp.vec3),
    fraction_in: wp.array(dtype=wp.float32),
    ring_in: wp.array(dtype=wp.uint16),
    pose_in: wp.array(dtype=wp.transform),
    distance_in: wp.array(dtype=wp.float32),
    hit_label_in: wp.array(dtype=wp.int32),
    hit_instance_in: wp.array(dtype=wp.int32),
    normal_in: wp.array(dtype=wp.vec3),
    material_in: wp.array2d(dtype=wp.float32),
    seed_in: wp.array(dtype=wp.uint32),
    rain_in: wp.array(dtype=wp.vec2),
    polish_in: wp.array(dtype=wp.float32),
    # in: sensor
    min_range: float,
    max_range: float,
    reach: float,
    range_noise: float,
    drop_out: float,
    edge_share: float,
    pulse: float,
    noise_label: int,
    # out
    kept_out: wp.array(dtype=wp.int32),
    range_out: wp.array(dtype=wp.float32),
    intensity_out: wp.array(dtype=wp.float32),
    label_out: wp.array(dtype=wp.int32),
    instance_out: wp.array(dtype=wp.int32),
):
    """Makes an echo of each hit: its noisy range and its intensity, or none where it is too weak.

    Beams of several worlds lie one world after the other.
    """
    i = wp.tid()
    kept_out[i] = 0
    n = beams_in.shape[0]
    world = i // n
    beam = i - world * n
    k = wp.uint32(beam)
    seed = seed_in[world] ^ wp.uint32(0x5BD1E995)
    d = distance_in[i]
    label = hit_label_in[i]
    rain = rain_in[world]
    if rain[1] > 0.0:
        u = uniform(seed, k, wp.uint32(21))
        if u < rain[1] * DROP_ZONE:
            # What is left of u is as good as new: a range that falls off exponentially.
            drop = min_range - DROP_REACH * wp.log(1.0 - 0.9999 * u / (rain[1] * DROP_ZONE))
            if drop < wp.where(label >= 0, d, max_range):
                kept_out[i] = 1
                range_out[i] = drop
                intensity_out[i] = 0.03 * uniform(seed, k, wp.uint32(22))
                label_out[i] = noise_label
                instance_out[i] = NO_HIT
                return
    if d < min_range or label < 0:
        return
    along = wp.dot(wp.quat_rotate(turn_at(pose_in, world, fraction_in[beam]), beams_in[beam]), normal_in[i])
    cosine = wp.abs(along)
    material = label & _MATERIAL_MASK
    reflectivity = material_in[material, _REFLECTIVITY]
    gloss = material_in[material, _GLOSS]
    # Rough surfaces send back more at a grazing angle than Lambert's law says; glossy paint has a lobe as well.
    texture = 1.0 + 0.2 * _gauss(seed, k, wp.uint32(1))
    root = wp.sqrt(cosine)
    slant = root * wp.sqrt(root)
    square = cosine * cosine
    lobe = gloss * square * square * square * square
    echo = reflectivity * texture * ((1.0 - gloss) * slant + lobe)
    # The signal falls with the square of the range: it is 1 at `reach` for a tenth of full reflectivity, face on,
    # and there half of the echoes are seen.
    signal = echo / (d * d) * (reach * reach) * 10.0
    if rain[0] > 0.0:
        signal *= wp.exp(-rain[0] * d)
    cube = signal * signal * signal
    seen = cube / (1.0 + cube)
    # Clear coat and glass send a beam that grazes them on, as a mirror does. Things are not equally well polished, and
    # one is as polished in every sweep.
    own = 0.2 + 0.8 * uniform(_POLISH_SEED, wp.uint32(hit_instance_in[i]), wp.uint32(31))
    mirror = material_in[material, _MIRROR]
    half = mirror * polish_in[world] * own
    steep = cosine * cosine * cosine
    # Behind such a surface, as a beam that came in through a window meets it, is a dark lining.
    within = wp.where(along > 0.0 and mirror > 0.0, WITHIN, 1.0)
    seen *= steep / (steep + half * half * half + 1.0e-12) * within
    chance = uniform(seed, k, wp.uint32(3))
    if chance > seen * (1.0 - drop_out) * (1.0 - material_in[material, _LOSS]):
        return
    kept_out[i] = 1
    roughness = material_in[material, _ROUGHNESS]
    spread = wp.sqrt(range_noise * range_noise + roughness * roughness)
    merged = _mixed(i, beam, n, d, edge_share, pulse, seed, ring_in, distance_in, hit_label_in)
    range_out[i] = wp.max(merged + spread * _gauss(seed, k, wp.uint32(7)), min_range)
    # What is reported is compensated for range and in part for the angle, as sensors do.
    reported = reflectivity * texture * ((1.0 - gloss) * (0.5 + 0.5 * cosine) + lobe)
    intensity_out[i] = wp.clamp(reported, 0.0, 1.0)
    label_out[i] = label
    instance_out[i] = hit_instance_in[i]


@wp.kernel
def compact_echoes(
    # in
    beams_in: wp.array(dtype=wp.vec3),
    kept_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    range_in: wp.array(dtype=wp.float32),
    intensity_in: wp.array(dtype=wp.float32),
    label_in: wp.array(dtype=wp.int32),
    instance_in: wp.array(dtype=wp.int32),
    beam_ring_in: wp.array(dtype=wp.uint16),
    beam_time_in: wp.array(dtype=wp.float32),
    # out
    points_out: wp.array(dtype=wp.vec4),
    ring_out: wp.array(dtype=wp.uint16),
    t_out: wp.array(dtype=wp.float32),
    point_class_out: wp.array(dtype=wp.int32),
    instance_out: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
):
    """Writes the echoes of each world one after the other, in the order of the beams."""
    i = wp.tid()
    n = beams_in.shape[0]
    world = i // n
    beam = i - world * n
    first = rank_in[world * n]
    if beam == n - 1:
        count_out[world] = rank_in[i] + kept_in[i] - first
    if kept_in[i] == 0:
        return
    k = world * n + rank_in[i] - first
    p = range_in[i] * beams_in[beam]
    points_out[k] = wp.vec4(p[0], p[1], p[2], intensity_in[i])
    ring_out[k] = beam_ring_in[beam]
    t_out[k] = beam_time_in[beam]
    point_class_out[k] = label_in[i] >> _CLASS_SHIFT
    instance_out[k] = instance_in[i]
