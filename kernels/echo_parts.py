"""Echoes on a CPU: each part of a sweep by blocks of beams, in vector instructions. `echoes.py` says what they are.

A module of its own, so that no GPU waits for it: compilers for CUDA take long over what is written for a CPU.
"""

from __future__ import annotations

import warp as wp

from .beams import NO_HIT, UNIFORM
from .echoes import DROP_REACH, DROP_ZONE, WITHIN

__all__ = ["ECHO_BLOCK", "echo_part", "pack_echoes"]

ECHO_BLOCK = wp.constant(256)
"""Beams of a part's turn."""


# What `make_echoes` does, operation by operation, for the beams of a block at once: without a branch within a loop,
# but for rain.
_ECHOES = f"""
    using namespace wp;
    constexpr int BLOCK = {int(ECHO_BLOCK)}, NO_HIT = {int(NO_HIT)};
    constexpr float DROP_REACH = {float(DROP_REACH)!r}f, DROP_ZONE = {float(DROP_ZONE)!r}f, WITHIN = {float(WITHIN)!r}f;
    const auto uniform = [](const unsigned int seed, const unsigned int a, const unsigned int b) -> float {{{UNIFORM}}};
    const auto gauss = [&](const unsigned int seed, const unsigned int a, const unsigned int b) -> float {{
        const float u = uniform(seed, a, b) + uniform(seed + 1u, a, b);
        const float v = uniform(seed + 2u, a, b) + uniform(seed + 3u, a, b);
        return (u + v - 2.0f) * 1.7320508f;
    }};
    const int n = beams_in.shape[0], length = last - first;
    const long long offset = (long long)world * n;
    const unsigned int seed = seed_in.data[world] ^ 0x5BD1E995u;
    const vec2 rain = rain_in.data[world];
    const quat start = transform_get_rotation(pose_in.data[2 * world]);
    const quat way = sub(transform_get_rotation(pose_in.data[2 * world + 1]), start);
    const float* distance = distance_in.data + offset;
    const int* hit_label = hit_label_in.data + offset;
    const vec3* normal = normal_in.data + offset;
    float along[BLOCK], cosine[BLOCK], reflectivity[BLOCK], loss[BLOCK], gloss[BLOCK], roughness[BLOCK], mirror[BLOCK];
    float texture[BLOCK], lobe[BLOCK], signal[BLOCK], intensity[BLOCK], range[BLOCK];
    int kept[BLOCK];
    for (int j = 0; j < length; ++j) {{
        const int k = first + j;
        const quat turn = normalize(add(start, mul(fraction_in.data[k], way)));
        along[j] = dot(quat_rotate(turn, beams_in.data[k]), normal[k]);
        cosine[j] = wp::abs(along[j]);
    }}
    for (int j = 0; j < length; ++j) {{
        const float* material = material_in.data + (hit_label[first + j] & 255) * material_in.shape[1];
        reflectivity[j] = material[0];
        loss[j] = material[2];
        gloss[j] = material[3];
        roughness[j] = material[4];
        mirror[j] = material[5];
    }}
    const float polish = polish_in.data[world];
    for (int j = 0; j < length; ++j) {{
        const float own = 0.2f + 0.8f * uniform(0x9E3779B9u, hit_instance_in.data[offset + first + j], 31u);
        const float half = mirror[j] * polish * own;
        const float steep = cosine[j] * cosine[j] * cosine[j];
        const float within = (along[j] > 0.0f && mirror[j] > 0.0f) ? WITHIN : 1.0f;
        mirror[j] = steep / (steep + half * half * half + 1.0e-12f) * within;
    }}
    for (int j = 0; j < length; ++j) {{
        const float d = distance[first + j];
        texture[j] = 1.0f + 0.2f * gauss(seed, first + j, 1u);
        const float root = sqrtf(cosine[j]);
        const float slant = root * sqrtf(root);
        const float square = cosine[j] * cosine[j];
        lobe[j] = gloss[j] * square * square * square * square;
        const float echo = reflectivity[j] * texture[j] * ((1.0f - gloss[j]) * slant + lobe[j]);
        signal[j] = echo / (d * d) * (reach * reach) * 10.0f;
    }}
    if (rain[0] > 0.0f)
        for (int j = 0; j < length; ++j) signal[j] *= wp::exp(-rain[0] * distance[first + j]);
    for (int j = 0; j < length; ++j) {{
        const float cube = signal[j] * signal[j] * signal[j];
        const float seen = cube / (1.0f + cube) * mirror[j];
        const float chance = uniform(seed, first + j, 3u);
        const int none = (distance[first + j] < min_range) | (hit_label[first + j] < 0)
            | (chance > seen * (1.0f - drop_out) * (1.0f - loss[j]));
        kept[j] = 1 - none;
        const float reported
            = reflectivity[j] * texture[j] * ((1.0f - gloss[j]) * (0.5f + 0.5f * cosine[j]) + lobe[j]);
        intensity[j] = reported < 0.0f ? 0.0f : (reported > 1.0f ? 1.0f : reported);
    }}
    for (int j = 0; j < length; ++j) {{
        const int k = first + j;
        const float d = distance[k], chance = uniform(seed, k, 13u);
        const int step = chance < 0.5f * edge_share ? -1 : 1;
        const int there = (k + step >= 0) & (k + step < n), other = there ? k + step : k;
        const float gap = distance[other] - d;
        const int mixed = there & (chance < edge_share) & (ring_in.data[other] == ring_in.data[k])
            & (hit_label[other] >= 0) & !(wp::abs(gap) > pulse);
        const float between = d + 0.5f * uniform(seed, k, 14u) * gap;
        const float merged = mixed ? between : d;
        const float spread = sqrtf(range_noise * range_noise + roughness[j] * roughness[j]);
        const float noisy = merged + spread * gauss(seed, k, 7u);
        range[j] = noisy > min_range ? noisy : min_range;
    }}
    for (int j = 0; j < length; ++j) {{
        const long long i = offset + first + j;
        kept_out.data[i] = kept[j];
        range_out.data[i] = range[j];
        intensity_out.data[i] = intensity[j];
        label_out.data[i] = hit_label_in.data[i];
        instance_out.data[i] = hit_instance_in.data[i];
    }}
    if (!(rain[1] > 0.0f)) return;
    for (int j = 0; j < length; ++j) {{
        const int k = first + j;
        const float u = uniform(seed, k, 21u);
        if (!(u < rain[1] * DROP_ZONE)) continue;
        const float drop = min_range - DROP_REACH * wp::log(1.0f - 0.9999f * u / (rain[1] * DROP_ZONE));
        if (!(drop < (hit_label[k] >= 0 ? distance[k] : max_range))) continue;
        kept_out.data[offset + k] = 1;
        range_out.data[offset + k] = drop;
        intensity_out.data[offset + k] = 0.03f * uniform(seed, k, 22u);
        label_out.data[offset + k] = noise_label;
        instance_out.data[offset + k] = NO_HIT;
    }}
"""


@wp.func_native(_ECHOES)
def _echo(
    # in
    world: int,
    first: int,
    last: int,
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
    """Makes the echoes of the beams first … last − 1 of a world, which are at most `ECHO_BLOCK`."""


@wp.kernel
def echo_part(
    part: int,
    parts: int,
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
    """As `make_echoes`; parts take turns by blocks of beams."""
    n = beams_in.shape[0]
    blocks = (n + ECHO_BLOCK - 1) // ECHO_BLOCK
    for turn in range(part, seed_in.shape[0] * blocks, parts):
        world = turn // blocks
        first = (turn - world * blocks) * ECHO_BLOCK
        _echo(
            world, first, wp.min(first + ECHO_BLOCK, n), beams_in, fraction_in, ring_in, pose_in, distance_in,
            hit_label_in, hit_instance_in, normal_in, material_in, seed_in, rain_in, polish_in, min_range, max_range,
            reach, range_noise, drop_out, edge_share, pulse, noise_label, kept_out, range_out, intensity_out, label_out,
            instance_out,
        )  # fmt: skip


@wp.func_native("""
    const int n = beams_in.shape[0];
    const long long offset = (long long)world * n;
    const int* kept = kept_in.data + offset;
    long long at = offset;
    for (int k = 0; k < n; ++k) {
        if (!kept[k]) continue;
        const float range = range_in.data[offset + k];
        const wp::vec3 beam = beams_in.data[k];
        points_out.data[at]
            = wp::vec4(range * beam[0], range * beam[1], range * beam[2], intensity_in.data[offset + k]);
        ring_out.data[at] = beam_ring_in.data[k];
        t_out.data[at] = beam_time_in.data[k];
        point_class_out.data[at] = label_in.data[offset + k] >> 8;
        instance_out.data[at] = instance_in.data[offset + k];
        ++at;
    }
    count_out.data[world] = (int)(at - offset);
""")
def _pack(
    # in
    world: int,
    beams_in: wp.array(dtype=wp.vec3),
    kept_in: wp.array(dtype=wp.int32),
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
    """Writes the echoes of a world one after the other."""


@wp.kernel
def pack_echoes(
    # in
    beams_in: wp.array(dtype=wp.vec3),
    kept_in: wp.array(dtype=wp.int32),
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
    """As `compact_echoes`, without ranks: one world a thread."""
    _pack(
        wp.tid(), beams_in, kept_in, range_in, intensity_in, label_in, instance_in, beam_ring_in, beam_time_in,
        points_out, ring_out, t_out, point_class_out, instance_out, count_out,
    )  # fmt: skip
