"""Rays in packets of eight, for CPUs: near ones meet the same boxes and faces, and eight are as quick as one.

A packet goes down the tree of a mesh together, the nearer child first (Wald et al., "Interactive rendering with
coherent ray tracing", 2001). What a box or a face is to eight rays is asked in vector instructions, without a branch;
the few rays that may hit a face are then tried one by one by Warp's own test, so that hits are those of its queries.
"""

from __future__ import annotations

import warp as wp

from .beams import MATERIALS, MAX_PASSES, NO_HIT, POROSITY, STEP, UNIFORM, carried_back, ray_of, world_normal

__all__ = ["cast_packets", "hit_packets"]

_BLOCK = wp.constant(256)  # rays of a part's turn; near ones meet the same faces


# Shared by the two functions below. `descend` takes a packet through a tree and calls `leaf` with ranges of what it
# holds; `meet_faces` finds the first face of a mesh for each ray of a packet.
_TRAVERSAL = """
    using namespace wp;
    constexpr int WIDTH = 8;
    constexpr int DEEPEST = 128;  // of a tree; they are as deep as the logarithm of their faces, or somewhat more
    struct Packet {
        float o[3][WIDTH], d[3][WIDTH], r[3][WIDTH], length;
        void prepare() {
            length = 0.0f;
            for (int axis = 0; axis < 3; ++axis)
                for (int k = 0; k < WIDTH; ++k) {
                    const float along = d[axis][k];
                    r[axis][k] = 1.0f / (along == 0.0f ? 1.0e-20f : along);
                    length = wp::max(length, wp::abs(along));
                }
        }
    };
    // When the first ray of the packet comes to the box, as the bits of a float, which are in the order of floats.
    using Corner = BVHPackedNodeHalf;
    const auto entry = [](const Packet& p, const float* best, const Corner& low, const Corner& high) {
        constexpr int never = 0x7f7fffff;
        int first = never;
        for (int k = 0; k < WIDTH; ++k) {
            const float x0 = (low.x - p.o[0][k]) * p.r[0][k], x1 = (high.x - p.o[0][k]) * p.r[0][k];
            const float y0 = (low.y - p.o[1][k]) * p.r[1][k], y1 = (high.y - p.o[1][k]) * p.r[1][k];
            const float z0 = (low.z - p.o[2][k]) * p.r[2][k], z1 = (high.z - p.o[2][k]) * p.r[2][k];
            const float nx = x0 < x1 ? x0 : x1, fx = x0 < x1 ? x1 : x0;
            const float ny = y0 < y1 ? y0 : y1, fy = y0 < y1 ? y1 : y0;
            const float nz = z0 < z1 ? z0 : z1, fz = z0 < z1 ? z1 : z0;
            float in = nx > ny ? nx : ny, out = fx < fy ? fx : fy;
            in = in > nz ? in : nz;
            out = out < fz ? out : fz;
            in = in > 0.0f ? in : 0.0f;
            // A little wider than it is, for what rounding took.
            const int hit = (in <= out * 1.000001f) & (in < best[k]);
            int bits;
            memcpy(&bits, &in, 4);
            bits = hit ? bits : never;
            first = bits < first ? bits : first;
        }
        return first;
    };
    const auto descend = [&](const BVH& bvh, const Packet& p, const float* best, const auto& leaf) {
        constexpr int never = 0x7f7fffff;
        uint64_t stack[DEEPEST];
        int entries[DEEPEST], depth = 0, limit = 0;
        bool nearer = true;  // than `limit` says: it is what the farthest hit so far is, after a leaf anew
        const int root = *bvh.root;
        if (entry(p, best, bvh_load_node(bvh.node_lowers, root), bvh_load_node(bvh.node_uppers, root)) == never) return;
        uint64_t node = bvh_query_node_load(bvh, root);
        while (true) {
            if (bvh_query_node_is_leaf(node)) {
                leaf(bvh_query_node_lower_payload(node), bvh_query_node_upper_payload(node));
                nearer = true;
            } else {
                const int left = bvh_query_node_lower_payload(node), right = bvh_query_node_upper_payload(node);
                const Corner left_low = bvh_load_node(bvh.node_lowers, left);
                const Corner left_high = bvh_load_node(bvh.node_uppers, left);
                const Corner right_low = bvh_load_node(bvh.node_lowers, right);
                const Corner right_high = bvh_load_node(bvh.node_uppers, right);
                const int to_left = entry(p, best, left_low, left_high);
                const int to_right = entry(p, best, right_low, right_high);
                const uint64_t left_node = bvh_query_node_pack(left_low, left_high);
                const uint64_t right_node = bvh_query_node_pack(right_low, right_high);
                if (to_left != never || to_right != never) {
                    const bool left_first = to_left <= to_right;
                    node = left_first ? left_node : right_node;
                    const int later = left_first ? to_right : to_left;
                    if (later != never && depth < DEEPEST) {
                        stack[depth] = left_first ? right_node : left_node;
                        entries[depth++] = later;
                    }
                    continue;
                }
            }
            if (nearer) {
                float farthest = 0.0f;
                for (int k = 0; k < WIDTH; ++k) farthest = best[k] > farthest ? best[k] : farthest;
                memcpy(&limit, &farthest, 4);
                nearer = false;
            }
            do {
                if (depth == 0) return;
                --depth;
            } while (entries[depth] >= limit);
            node = stack[depth];
        }
    };
    const auto meet_faces = [&](const Mesh& mesh, const Packet& p, float* best, int* face) {
        descend(mesh.bvh, p, best, [&](const int begin, const int end) {
            for (int at = begin; at < end; ++at) {
                const int number = mesh.bvh.primitive_indices[at];
                const vec3 a = mesh.points[mesh.indices[3 * number]];
                const vec3 b = mesh.points[mesh.indices[3 * number + 1]];
                const vec3 c = mesh.points[mesh.indices[3 * number + 2]];
                int may[WIDTH], any = 0;
                // On which side of the edges a ray passes, where rounding leaves no doubt.
                for (int k = 0; k < WIDTH; ++k) {
                    const float ax = a[0] - p.o[0][k], ay = a[1] - p.o[1][k], az = a[2] - p.o[2][k];
                    const float bx = b[0] - p.o[0][k], by = b[1] - p.o[1][k], bz = b[2] - p.o[2][k];
                    const float cx = c[0] - p.o[0][k], cy = c[1] - p.o[1][k], cz = c[2] - p.o[2][k];
                    const float dx = p.d[0][k], dy = p.d[1][k], dz = p.d[2][k];
                    const float u = dx * (cy * bz - cz * by) + dy * (cz * bx - cx * bz) + dz * (cx * by - cy * bx);
                    const float v = dx * (ay * cz - az * cy) + dy * (az * cx - ax * cz) + dz * (ax * cy - ay * cx);
                    const float w = dx * (by * az - bz * ay) + dy * (bz * ax - bx * az) + dz * (bx * ay - by * ax);
                    const float a2 = ax * ax + ay * ay + az * az, b2 = bx * bx + by * by + bz * bz;
                    const float c2 = cx * cx + cy * cy + cz * cz;
                    const float doubt = 4.0e-6f * p.length * (a2 + b2 + c2);
                    const float least = u < v ? (u < w ? u : w) : (v < w ? v : w);
                    const float most = u > v ? (u > w ? u : w) : (v > w ? v : w);
                    may[k] = ((least >= -doubt) | (most <= doubt)) & (best[k] > 0.0f);
                    any |= may[k];
                }
                if (!any) continue;
                for (int k = 0; k < WIDTH; ++k) {
                    if (!may[k]) continue;
                    float t, u, v, sign;
                    const vec3 o(p.o[0][k], p.o[1][k], p.o[2][k]), d(p.d[0][k], p.d[1][k], p.d[2][k]);
                    if (intersect_ray_tri_woop(o, d, a, b, c, t, u, v, sign, (vec3*)nullptr) && t >= 0.0f
                        && (t < best[k] || (t == best[k] && face[k] >= 0 && number < face[k]))) {
                        best[k] = t;
                        face[k] = number;
                    }
                }
            }
        });
    };
"""


@wp.func_native(
    _TRAVERSAL
    + """
    const Mesh mesh = mesh_get(mesh_in);
    for (int start = first; start < last; start += WIDTH) {
        Packet p;
        float best[WIDTH];
        int face[WIDTH];
        bool together = true;  // packets pay for rays that are near each other
        const vec3 lead = normalize(direction_in[start]), from = origin_in[start];
        for (int k = 0; k < WIDTH; ++k) {
            const int i = start + k < last ? start + k : start;
            const vec3 o = origin_in[i], d = normalize(direction_in[i]);
            for (int axis = 0; axis < 3; ++axis) {
                p.o[axis][k] = o[axis];
                p.d[axis][k] = d[axis];
            }
            best[k] = start + k < last ? max_distance : -1.0f;
            face[k] = -1;
            together = together && dot(lead, d) > 0.99f && o == from;
        }
        if (together) {
            p.prepare();
            meet_faces(mesh, p, best, face);
        } else {
            for (int k = 0; k < WIDTH && start + k < last; ++k) {
                float t, u, v, sign;
                vec3 normal;
                const vec3 o(p.o[0][k], p.o[1][k], p.o[2][k]), d(p.d[0][k], p.d[1][k], p.d[2][k]);
                if (mesh_query_ray(mesh_in, o, d, max_distance, t, u, v, sign, normal, face[k])) best[k] = t;
                else face[k] = -1;
            }
        }
        for (int k = 0; k < WIDTH && start + k < last; ++k) {
            distance_out[start + k] = best[k];
            face_out[start + k] = face[k];
        }
    }
"""
)
def _meet_mesh(
    # in
    first: int,
    last: int,
    mesh_in: wp.uint64,
    origin_in: wp.array(dtype=wp.vec3),
    direction_in: wp.array(dtype=wp.vec3),
    max_distance: float,
    # out
    distance_out: wp.array(dtype=wp.float32),
    face_out: wp.array(dtype=wp.int32),
):
    """The first face of a mesh for the rays first … last − 1."""


_MATERIALS = f"""
    constexpr int MATERIALS = {MATERIALS}, POROSITY = {int(POROSITY)}, MAX_PASSES = {int(MAX_PASSES)};
    constexpr float STEP = {float(STEP)!r}f;
    const auto uniform = [](const unsigned int seed, const unsigned int a, const unsigned int b) -> float {{{UNIFORM}}};
"""


@wp.func_native(
    _TRAVERSAL
    + _MATERIALS
    + """
    const BVH scene = bvh_get(scene_in);
    for (int start = first; start < last; start += WIDTH) {
        Packet world;
        float best[WIDTH], fraction[WIDTH];
        int item[WIDTH], face[WIDTH];
        for (int k = 0; k < WIDTH; ++k) {
            const int i = start + k < last ? start + k : start;
            fraction[k] = fraction_in[order_in[i]];
            for (int axis = 0; axis < 3; ++axis) {
                world.o[axis][k] = origin_in[i][axis];
                world.d[axis][k] = direction_in[i][axis];
            }
            best[k] = start + k < last ? max_range : -1.0f;
            item[k] = face[k] = -1;
        }
        world.prepare();
        const auto meet = [&](const int number) {
            Packet p;
            float row[3][4], found[WIDTH];
            int on[WIDTH];
            for (int axis = 0; axis < 3; ++axis)
                for (int column = 0; column < 4; ++column) row[axis][column] = rows_in.data[3 * number + axis][column];
            // Of an instance that moves, each ray meets what is there at the ray's own time.
            const vec4 motion = motion_in[number];
            const bool moves = motion[0] != 0.0f || motion[1] != 0.0f || motion[2] != 0.0f;
            float from[3][WIDTH];
            for (int axis = 0; axis < 3; ++axis)
                for (int k = 0; k < WIDTH; ++k) from[axis][k] = world.o[axis][k];
            if (moves)
                for (int axis = 0; axis < 3; ++axis)
                    for (int k = 0; k < WIDTH; ++k) from[axis][k] -= fraction[k] * motion[axis];
            for (int axis = 0; axis < 3; ++axis)
                for (int k = 0; k < WIDTH; ++k) {
                    p.o[axis][k] = row[axis][0] * from[0][k] + row[axis][1] * from[1][k]
                        + row[axis][2] * from[2][k] + row[axis][3];
                    p.d[axis][k] = row[axis][0] * world.d[0][k] + row[axis][1] * world.d[1][k]
                        + row[axis][2] * world.d[2][k];
                }
            if (motion[3] != 0.0f)
                for (int k = 0; k < WIDTH; ++k) {
                    const float c = cosf(fraction[k] * motion[3]), s = sinf(fraction[k] * motion[3]);
                    const float ox = p.o[0][k], oy = p.o[1][k], dx = p.d[0][k], dy = p.d[1][k];
                    p.o[0][k] = c * ox + s * oy;
                    p.o[1][k] = c * oy - s * ox;
                    p.d[0][k] = c * dx + s * dy;
                    p.d[1][k] = c * dy - s * dx;
                }
            for (int k = 0; k < WIDTH; ++k) {
                found[k] = best[k];
                on[k] = -1;
            }
            p.prepare();
            meet_faces(mesh_get(mesh_in[number]), p, found, on);
            for (int k = 0; k < WIDTH; ++k) {
                if (on[k] < 0) continue;
                // A porous face lets some rays through, which then go on by themselves.
                const vec3 o(p.o[0][k], p.o[1][k], p.o[2][k]), d(p.d[0][k], p.d[1][k], p.d[2][k]);
                float t = found[k], gone = 0.0f;
                int met = on[k];
                for (int passes = 1; passes <= MAX_PASSES; ++passes) {
                    const int material = label_in[first_face_in[number] + met] & (MATERIALS - 1);
                    const float porosity = material_in.data[material * material_in.shape[1] + POROSITY];
                    if (passes == MAX_PASSES || !(porosity > 0.0f)
                        || !(uniform(seed + number, order_in[start + k], met) < porosity)) {
                        if (t < best[k]) {
                            best[k] = t;
                            item[k] = number;
                            face[k] = met;
                        }
                        break;
                    }
                    gone = t + STEP;
                    float further, u, v, sign;
                    vec3 normal;
                    if (gone >= best[k]
                        || !mesh_query_ray(
                            mesh_in[number], o + gone * d, d, best[k] - gone, further, u, v, sign, normal, met
                        ))
                        break;
                    t = gone + further;
                }
            }
        };
        meet(0);  // it is not in the tree: its hit bounds the search among the others
        descend(scene, world, best, [&](const int begin, const int end) {
            for (int at = begin; at < end; ++at) meet(scene.primitive_indices[at] + 1);
        });
        for (int k = 0; k < WIDTH && start + k < last; ++k) {
            const int i = order_in[start + k];
            distance_out[i] = best[k];
            item_out[i] = item[k];
            face_out[i] = face[k];
        }
    }
"""
)
def _meet_scene(
    # in
    first: int,
    last: int,
    origin_in: wp.array(dtype=wp.vec3),
    direction_in: wp.array(dtype=wp.vec3),
    order_in: wp.array(dtype=wp.int32),
    fraction_in: wp.array(dtype=wp.float32),
    max_range: float,
    seed: wp.uint32,
    scene_in: wp.uint64,
    mesh_in: wp.array(dtype=wp.uint64),
    first_face_in: wp.array(dtype=wp.int32),
    rows_in: wp.array2d(dtype=wp.vec4),
    motion_in: wp.array(dtype=wp.vec4),
    label_in: wp.array(dtype=wp.int32),
    material_in: wp.array2d(dtype=wp.float32),
    # out
    distance_out: wp.array(dtype=wp.float32),
    item_out: wp.array(dtype=wp.int32),
    face_out: wp.array(dtype=wp.int32),
):
    """The first face of a scene for the rays first … last − 1; ray i is that of beam `order_in[i]`."""


@wp.kernel
def hit_packets(
    part: int,
    parts: int,
    # in
    mesh: wp.uint64,
    origins_in: wp.array(dtype=wp.vec3),
    directions_in: wp.array(dtype=wp.vec3),
    max_distance: float,
    # out
    distance_out: wp.array(dtype=wp.float32),
    face_out: wp.array(dtype=wp.int32),
    normal_out: wp.array(dtype=wp.vec3),
):
    """The first face of a mesh that each ray meets; parts take turns by blocks of rays."""
    n = origins_in.shape[0]
    for block in range(part, (n + _BLOCK - 1) // _BLOCK, parts):
        first = block * _BLOCK
        last = wp.min(first + _BLOCK, n)
        _meet_mesh(first, last, mesh, origins_in, directions_in, max_distance, distance_out, face_out)
        for i in range(first, last):
            normal = wp.vec3(0.0, 0.0, 0.0)
            if face_out[i] >= 0:
                normal = wp.mesh_eval_face_normal(mesh, face_out[i])
            else:
                distance_out[i] = wp.inf
            normal_out[i] = normal


@wp.kernel
def cast_packets(
    part: int,
    parts: int,
    # in: beams, and in which order they go together
    order_in: wp.array(dtype=wp.int32),
    beams_in: wp.array(dtype=wp.vec3),
    fraction_in: wp.array(dtype=wp.float32),
    pose_in: wp.array(dtype=wp.transform),
    max_range: float,
    seed_in: wp.array(dtype=wp.uint32),
    # in: scene
    scene_in: wp.array(dtype=wp.uint64),
    mesh_in: wp.array(dtype=wp.uint64),
    first_face_in: wp.array(dtype=wp.int32),
    rows_in: wp.array2d(dtype=wp.vec4),
    motion_in: wp.array(dtype=wp.vec4),
    label_in: wp.array(dtype=wp.int32),
    material_in: wp.array2d(dtype=wp.float32),
    # out: rays in the world, in that order
    origin_out: wp.array(dtype=wp.vec3),
    direction_out: wp.array(dtype=wp.vec3),
    # out
    distance_out: wp.array(dtype=wp.float32),
    instance_out: wp.array(dtype=wp.int32),
    face_out: wp.array(dtype=wp.int32),
    hit_label_out: wp.array(dtype=wp.int32),
    normal_out: wp.array(dtype=wp.vec3),
):
    """The first face that each beam does not pass through; parts take turns by blocks of beams."""
    n = order_in.shape[0]
    for block in range(part, (n + _BLOCK - 1) // _BLOCK, parts):
        first = block * _BLOCK
        last = wp.min(first + _BLOCK, n)
        for k in range(first, last):
            origin, direction = ray_of(order_in[k], 0, beams_in, fraction_in, pose_in)
            origin_out[k] = origin
            direction_out[k] = direction
        _meet_scene(
            first, last, origin_out, direction_out, order_in, fraction_in, max_range, seed_in[0], scene_in[0],
            mesh_in, first_face_in, rows_in, motion_in, label_in, material_in, distance_out, instance_out, face_out,
        )  # fmt: skip
        for k in range(first, last):
            i = order_in[k]
            item = instance_out[i]
            face = face_out[i]
            label = int(NO_HIT)
            normal = wp.vec3(0.0, 0.0, 0.0)
            if face >= 0:
                label = label_in[first_face_in[item] + face]
                normal = wp.mesh_eval_face_normal(mesh_in[item], face)
                turned = fraction_in[i] * motion_in[item][3]
                if turned != 0.0:
                    normal = carried_back(normal, -turned)
                normal = world_normal(normal, rows_in[item, 0], rows_in[item, 1], rows_in[item, 2])
            else:
                distance_out[i] = 0.0
            hit_label_out[i] = label
            normal_out[i] = normal
