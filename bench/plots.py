"""Plots of the report, drawn as SVG: the same results give the same bytes."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from html import escape

from .results import Pair, Result

__all__ = ["draw_cost", "draw_ratios"]

_FONT = "font-family='system-ui,sans-serif'"
_OURS, _TAICHI = "#0b62c4", "#4aa8ff"
_PEERS = ("#c2410c", "#15803d", "#9333ea", "#a16207", "#0e7490", "#db2777", "#4d7c0f", "#6b7280", "#7f1d1d", "#111827")
_INK, _FAINT = "#222", "#ccc"
_STREET = re.compile(r"street (10k|120k|500k|2M)")
_LEAST_SIZES = 3  # that a curve needs


def _page(width: int, height: int, parts: Iterable[str]) -> str:
    body = "\n".join(parts)
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' width='{width}' height='{height}' viewBox='0 0 {width} {height}'>\n"
        f"<rect width='{width}' height='{height}' fill='#fff'/>\n{body}\n</svg>\n"
    )


def _text(x: float, y: float, text: str, *, size: int = 11, colour: str = _INK, anchor: str = "start") -> str:
    return (
        f"<text x='{x:.1f}' y='{y:.1f}' {_FONT} font-size='{size}' fill='{colour}' text-anchor='{anchor}'>"
        f"{escape(text)}</text>"
    )


def _line(x1: float, y1: float, x2: float, y2: float, colour: str = _FAINT) -> str:
    return f"<line x1='{x1:.1f}' y1='{y1:.1f}' x2='{x2:.1f}' y2='{y2:.1f}' stroke='{colour}'/>"


# ---- goals


def draw_ratios(pairs: Sequence[Pair]) -> str:
    """Bars of our time over what the goal allows, on a scale of octaves from 1/8 to 8; empty where there is no goal."""
    rows = [pair for pair in pairs if pair.ratio is not None and pair.goal is not None]
    if not rows:
        return ""
    left, right, top, step = 330, 180, 44, 20
    width, height = 900, top + step * len(rows) + 14
    span = width - left - right

    def across(value: float) -> float:
        return left + span * (min(max(math.log2(value), -3.0), 3.0) + 3.0) / 6.0

    parts = [_text(12, 18, "Our time over what the goal allows: left of 1 the goal is reached", size=13)]
    for octave in range(-3, 4):
        x = across(2.0**octave)
        parts.append(_line(x, top - 6, x, height - 10, _INK if octave == 0 else _FAINT))
        parts.append(_text(x, top - 10, f"1/{2**-octave}" if octave < 0 else str(2**octave), anchor="middle"))
    for number, pair in enumerate(rows):
        y = top + step * number
        value = pair.ratio / pair.goal  # pyright: ignore[reportOptionalOperand]
        begin, end = sorted((across(1.0), across(value)))
        colour = _OURS if pair.is_reached else _PEERS[0]
        parts.append(_text(left - 8, y + 13, f"{pair.ours.kernel}, {pair.ours.on}", anchor="end"))
        parts.append(
            f"<rect x='{begin:.1f}' y='{y + 3}' width='{max(end - begin, 1.0):.1f}' height='{step - 6}' "
            f"fill='{colour}'/>"
        )
        peer = pair.peer.who if pair.peer is not None else ""
        parts.append(_text(width - right + 8, y + 13, f"{value:.2f} · {peer}"))
    return _page(width, height, parts)


# ---- cost against points


def draw_cost(results: Sequence[Result]) -> str:
    """A panel for each kernel that was timed on three sizes of the street: milliseconds against points.

    Both axes are logarithmic. Empty where there is no such kernel.
    """
    panels = [(title, curves) for title, curves in _curves(results).items() if _shows_growth(curves)]
    if not panels:
        return ""
    columns, panel_width, panel_height, top = 3, 300, 240, 30
    names = sorted({who for _, curves in panels for who in curves if not who.startswith("warploom")})
    parts = [_text(12, 18, "Time [ms] against points, both logarithmic", size=13)]
    for number, (title, curves) in enumerate(panels):
        x, y = (number % columns) * panel_width, top + (number // columns) * panel_height
        parts += _panel(x, y, panel_width, panel_height, title, curves, names)
    return _page(columns * panel_width, top + panel_height * math.ceil(len(panels) / columns), parts)


def _curves(results: Iterable[Result]) -> dict[str, dict[str, list[tuple[int, float]]]]:
    """By panel and contender the points and milliseconds on the street, in the order of the points."""
    panels: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for result in results:
        if not _STREET.match(result.on) or result.who == "warploom plan":
            continue
        title = result.kernel + _STREET.sub("", result.on, count=1)
        who = result.who if result.device == "cpu" else f"{result.who}, {result.device}"
        curve = panels.setdefault(title, {}).setdefault(who, [])
        curve.append((result.size, 1e3 * result.seconds))
        curve.sort()
    return panels


def _shows_growth(curves: dict[str, list[tuple[int, float]]]) -> bool:
    return any(len(curve) >= _LEAST_SIZES for who, curve in curves.items() if who.startswith("warploom"))


def _colour(who: str, names: Sequence[str]) -> str:
    if who.startswith("warploom"):
        return _TAICHI if "Taichi" in who else _OURS
    return _PEERS[names.index(who) % len(_PEERS)]


def _panel(
    x: float,
    y: float,
    width: float,
    height: float,
    title: str,
    curves: dict[str, list[tuple[int, float]]],
    names: Sequence[str],
) -> list[str]:
    left, right, top, bottom = x + 44, x + width - 12, y + 26, y + height - 26
    points = [point for curve in curves.values() for point in curve]
    sizes = [math.log10(size) for size, _ in points]
    low, high = min(sizes) - 0.1, max(sizes) + 0.1
    first = math.floor(min(math.log10(ms) for _, ms in points))
    last = max(math.ceil(max(math.log10(ms) for _, ms in points)), first + 1)

    def at(size: float, ms: float) -> tuple[float, float]:
        across = left + (math.log10(size) - low) / (high - low) * (right - left)
        return across, bottom - (math.log10(ms) - first) / (last - first) * (bottom - top)

    parts = [_text(left, y + 16, title, size=12)]
    for decade in range(first, last + 1):
        across = at(10**low, 10.0**decade)[1]
        parts += [_line(left, across, right, across), _text(left - 5, across + 4, f"{10.0**decade:g}", anchor="end")]
    for size in (10_000, 100_000, 1_000_000):
        if low <= math.log10(size) <= high:
            down = at(size, 10.0**first)[0]
            parts.append(_line(down, top, down, bottom))
            parts.append(_text(down, bottom + 14, {10_000: "10k", 100_000: "100k", 1_000_000: "1M"}[size],
                               anchor="middle"))  # fmt: skip
    for number, (who, curve) in enumerate(sorted(curves.items(), key=lambda item: not item[0].startswith("warploom"))):
        colour = _colour(who, names)
        dashes = " stroke-dasharray='4 3'" if who not in ("warploom", *names) else ""
        path = " ".join(f"{a:.1f},{b:.1f}" for a, b in (at(*point) for point in curve))
        parts.append(f"<polyline points='{path}' fill='none' stroke='{colour}' stroke-width='2'{dashes}/>")
        parts += [f"<circle cx='{a:.1f}' cy='{b:.1f}' r='2.5' fill='{colour}'/>" for a, b in (at(*p) for p in curve)]
        mark = "- - " if dashes else ""
        parts.append(_text(left + 6, top + 12 + 12 * number, f"{mark}{who}", size=10, colour=colour))
    return parts
