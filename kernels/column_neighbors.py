"""Columns of cells and those around them, for CPUs: what `cell_columns.py` sorts, as C++ that kernels are made with.

Columns stand in order of x and y, so those near one are a stretch of its own row, of the next and so on, and for the
columns of a row each of these stretches begins and ends where the one before does, or later.
"""

from __future__ import annotations

__all__ = ["NEAR_COLUMNS"]

NEAR_COLUMNS = """
    // The columns of `columns` from `begin` up to `end` that are `dx` rows on, and `dy` or less along y, for one column
    // after the other.
    struct NearColumns {
        const wp::vec4i* column;
        int end, dx, dy, first, last;
        // By one number: rows are all of an int32 apart.
        static long long key(const long long x, const long long y) { return x * 4294967296ll + y; }
        long long key_of(const int k) const { return key(column[k][0], column[k][1]); }
        int moved(int head, const long long limit) const {
            // Mostly by two at most, and there is no telling: without a branch.
            for (int step = 0; step < 2; ++step) head += (head < end) & (key_of(head) < limit);
            while (head < end && key_of(head) < limit) ++head;
            return head;
        }
        void move_to(const int k) {
            const long long x = (long long)column[k][0] + dx, y = column[k][1];
            first = moved(first, key(x, y - dy));
            last = moved(last < first ? first : last, key(x, y + dy + 1));
        }
    };
"""
"""C++: `NearColumns near{columns, end, dx, dy, begin, begin}` and `near.move_to(k)`, upon which the columns are those
from `near.first` to before `near.last`."""
