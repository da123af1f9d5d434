"""The ground drawn from an image of three bytes a pixel in vector instructions, for a CPU."""

from __future__ import annotations

import warp as wp

from . import device  # noqa: F401  (starts Warp quietly)

__all__ = ["Bytes", "Weights", "sample_parts"]

Bytes = wp.types.vector(length=3, dtype=wp.uint8)
Weights = wp.types.vector(length=4, dtype=wp.uint16)
"""Of the four pixels about a cell's centre, upper left, upper right, lower left, lower right; they add up to 2¹³."""


# Eight bytes hold two neighbouring pixels. Each channel's two values lie side by side as the two weights do: one
# instruction multiplies them and adds the pair up. Four cells are twelve bytes, of which sixteen are written: the next
# cells write over the four. Before the image's end, eight bytes are read from a little further ahead.
# CUDA's compiler, which is shown this file too, knows no such vectors, and never runs it.
@wp.func_native("""
#ifdef __clang__
    typedef unsigned char Bytes8 __attribute__((vector_size(8)));
    typedef unsigned char Bytes16 __attribute__((vector_size(16)));
    typedef short Shorts8 __attribute__((vector_size(16)));
    typedef int Ints4 __attribute__((vector_size(16)));
    typedef int Ints8 __attribute__((vector_size(32)));
    typedef int Ints16 __attribute__((vector_size(64)));
    const unsigned char* const image = (const unsigned char*)image_in.data;
    const long long bytes = 3LL * image_in.shape[0], next = 3LL * down;
    const int* const places = place_in.data;
    const unsigned short* const weights = (const unsigned short*)weights_in.data;
    unsigned char* const ground = (unsigned char*)ground_out.data;
    const auto read = [&](const long long at) {
        Bytes8 pair;
        memcpy(&pair, image + at, 8);
        return pair;
    };
    const auto read_near_end = [&](const long long at) {
        const long long held = at < bytes - 8 ? at : bytes - 8;
        return (Bytes8)((unsigned long long)read(held) >> 8 * (at - held));
    };
    const auto weigh = [](const Bytes8 pair, const unsigned short* const two) {
        const Bytes8 zero = {};
        const Shorts8 values = (Shorts8)__builtin_shufflevector(
            pair, zero, 0, 8, 3, 8, 1, 8, 4, 8, 2, 8, 5, 8, 8, 8, 8, 8);
        int both;
        memcpy(&both, two, 4);
        const Ints4 repeated = {both, both, both, both};
        const Shorts8 shares = (Shorts8)repeated;
#ifdef __SSE2__
        return (Ints4)__builtin_ia32_pmaddwd128(values, shares);
#else
        const auto products = __builtin_convertvector(values, Ints8) * __builtin_convertvector(shares, Ints8);
        return __builtin_shufflevector(products, products, 0, 2, 4, 6)
            + __builtin_shufflevector(products, products, 1, 3, 5, 7);
#endif
    };
    const auto draw = [&](const int cell, const auto& read_pair) {
        const long long at = 3LL * places[cell];
        const unsigned short* const four = weights + 4 * cell;
        return (weigh(read_pair(at), four) + weigh(read_pair(at + next), four + 2) + 4096) >> 13;
    };
    const int furthest = (int)((bytes - 8) / 3 - down);
    constexpr int BLOCK = 2048;
    int cell = first;
    while (cell < last) {
        const int end = last - cell < BLOCK ? last : cell + BLOCK;
        bool are_inside = true;
        for (int k = cell; k < end; ++k) are_inside &= places[k] <= furthest;
        for (; are_inside && cell + 6 <= end; cell += 4) {
            const Ints8 one = __builtin_shufflevector(draw(cell, read), draw(cell + 1, read), 0, 1, 2, 3, 4, 5, 6, 7);
            const Ints8 two = __builtin_shufflevector(
                draw(cell + 2, read), draw(cell + 3, read), 0, 1, 2, 3, 4, 5, 6, 7);
            const Ints16 all = __builtin_shufflevector(
                one, two, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
            const Bytes16 apart = __builtin_convertvector(all, Bytes16);
            const Bytes16 drawn = __builtin_shufflevector(
                apart, apart, 0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, 15, 15, 15, 15);
            memcpy(ground + 3LL * cell, &drawn, 16);
        }
        for (; cell < end; ++cell) {
            const Ints4 drawn = draw(cell, read_near_end);
            for (int channel = 0; channel < 3; ++channel) {
                ground[3LL * cell + channel] = (unsigned char)drawn[channel];
            }
        }
    }
#endif
    return last;
""")
def _sample_run(
    image_in: wp.array(dtype=Bytes),
    place_in: wp.array(dtype=wp.int32),
    weights_in: wp.array(dtype=Weights),
    down: int,
    first: int,
    last: int,
    ground_out: wp.array(dtype=Bytes),
) -> int:
    """Draws the cells first … last − 1."""


@wp.kernel
def sample_parts(
    part: int,
    parts: int,
    # in
    image_in: wp.array(dtype=Bytes),
    place_in: wp.array(dtype=wp.int32),
    weights_in: wp.array(dtype=Weights),
    down: int,
    # out
    ground_out: wp.array(dtype=Bytes),
):
    """A share of the cells, from an image of three pixels or more.

    Args:
        part: Which, 0 … parts − 1.
        parts: How many.
        image_in: The pixels, row after row.
        place_in: Per cell the upper left of the four pixels about its centre.
        weights_in: Per cell what each of the four counts.
        down: Pixels from a row to the next.
        ground_out: The cells.
    """
    cells = place_in.shape[0]
    share = (cells + parts - 1) / parts
    first = part * share
    _sample_run(image_in, place_in, weights_in, down, first, wp.min(first + share, cells), ground_out)
