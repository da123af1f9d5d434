"""Columns of cells and those around them, for CPUs: what `cell_columns.py` sorts, as C++ that kernels are made with.

Half of the neighbours are listed for each column, those that come after it: a pair of columns is then met once. They
are looked up on a map, or, of a cloud too wide for one, met by going along the rows at the same pace.
"""

from __future__ import annotations

__all__ = ["FORWARD", "LIST_NEIGHBORS", "map_places"]

_LEAST_MAP, _MAP_PER_POINT = 1 << 20, 16

FORWARD = 12
"""Columns up to two away that come after a column; the first four share a corner with it, and two of these a side."""

LIST_NEIGHBORS = """
    // Of the columns begin … end − 1 the neighbours among them, 12 each, −1 where there is none.
    const auto list_neighbors = [&](const int begin, const int end, int* __restrict neighbors) {
        const wp::vec4i* __restrict column = columns.data;
        const long long row_length = (long long)layout.depth + 4;  // two columns free on either side
        const long long rows = (long long)layout.levels * (layout.width + 2);
        if (layout.high_digits > 0 && rows * row_length <= column_map.shape[0]) {
            int* __restrict map = column_map.data;
            const auto place_of = [&](const int k) {
                const int x = column[k][0];
                const int level = layout.has_levels ? (x + (1 << 18)) >> 19 : 0;
                const int along = x - level * (1 << 19) - layout.least[0];
                const int row = (level - layout.least[3]) * (layout.width + 2) + along;
                return (int)(row * row_length) + column[k][1] - layout.least[1] + 2;
            };
            const int next = (int)row_length, second = 2 * next;
            const int offsets[12] = {1, next, next - 1, next + 1, 2, second, next - 2, next + 2,
                                     second - 1, second + 1, second - 2, second + 2};
            for (int k = begin; k < end; ++k) map[place_of(k)] = k;
            for (int k = begin; k < end; ++k) {
                const int* around = map + place_of(k);
                int* __restrict out = neighbors + 12ll * k;
                for (int o = 0; o < 12; ++o) {
                    const int other = around[offsets[o]];  // or a column of another part
                    out[o] = (unsigned)(other - begin) < (unsigned)(end - begin) ? other : -1;
                }
            }
            for (int k = begin; k < end; ++k) map[place_of(k)] = -1;
            return;
        }
        const auto key = [&](const int k) {
            return (unsigned long long)((unsigned)column[k][0] ^ 0x80000000u) << 32
                | ((unsigned)column[k][1] ^ 0x80000000u);
        };
        constexpr unsigned long long ROW = 1ull << 32;
        const int slots[3][5] = {{12, 12, 12, 0, 4}, {6, 2, 1, 3, 7}, {10, 8, 5, 9, 11}};
        int heads[2] = {begin, begin};
        for (int k = begin; k < end; ++k) {
            int out[13];
            for (int o = 0; o < 12; ++o) out[o] = -1;
            for (int dx = 0; dx < 3; ++dx) {
                const unsigned long long first = key(k) + dx * ROW - 2;
                int other = k + 1;
                if (dx > 0) {
                    int& head = heads[dx - 1];
                    while (head < end && key(head) < first) ++head;
                    other = head;
                }
                for (; other < end && key(other) - first < 5; ++other) out[slots[dx][key(other) - first]] = other;
            }
            for (int o = 0; o < 12; ++o) neighbors[12ll * k + o] = out[o];
        }
    };
"""
"""Needs `columns`, `layout` and `column_map`, an array of -1 everywhere that it leaves so."""


def map_places(capacity: int) -> int:
    """How many places the map of a plan for up to `capacity` points has."""
    return max(_LEAST_MAP, _MAP_PER_POINT * capacity)
