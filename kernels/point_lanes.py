"""Points from rows of memory into lanes, x, y and z apart, as vector instructions want them: C++ for kernels."""

from __future__ import annotations

__all__ = ["LOAD_POINTS"]

# Left to itself, a compiler fetches rows of four number by number, since the fourth is not wanted. It is read here
# where another row follows, as one that is the end of its memory may have only three.
LOAD_POINTS = """
    const auto load_rows = [](const float* from, const long long step, int k, const int end, auto& along) {
        for (; k < end; ++k)
            for (int axis = 0; axis < 3; ++axis) along[axis][k] = from[step * k + axis];
    };
    const auto load_points = [&](const float* from, const long long step, const int length, auto& along) {
        int k = 0;
        if (step == 3) load_rows(from, 3, 0, length, along);
        else {
        #ifdef __clang__
            typedef float Eight __attribute__((ext_vector_type(8)));
            for (; step == 4 && k + 8 < length; k += 8) {
                Eight two[4];
                memcpy(two, from + 4 * k, sizeof(two));
                const Eight a = __builtin_shufflevector(two[0], two[1], 0, 4, 8, 12, 1, 5, 9, 13);
                const Eight b = __builtin_shufflevector(two[2], two[3], 0, 4, 8, 12, 1, 5, 9, 13);
                const Eight x = __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11);
                const Eight y = __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
                const Eight c = __builtin_shufflevector(two[0], two[1], 2, 6, 10, 14, 2, 6, 10, 14);
                const Eight d = __builtin_shufflevector(two[2], two[3], 2, 6, 10, 14, 2, 6, 10, 14);
                const Eight z = __builtin_shufflevector(c, d, 0, 1, 2, 3, 8, 9, 10, 11);
                memcpy(along[0] + k, &x, sizeof(x));
                memcpy(along[1] + k, &y, sizeof(y));
                memcpy(along[2] + k, &z, sizeof(z));
            }
        #endif
            load_rows(from, step, k, length, along);
        }
    };
"""
"""C++: `load_points(from, step, length, along)` puts the first three numbers of rows that begin `step` numbers apart,
the first at `from`, into `float along[3][…]`, up to `length`, which the last row may end with."""
