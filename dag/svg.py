"""Modules drawn as a picture (SVG): layers from left to right, after Sugiyama, Tagawa and Toda (1981).

Boxes are sorted into layers by their longest way from a start, long arrows get a place in each layer that they pass,
and sweeps put everything near what it is connected with. A component's vertices are laid out first, for themselves;
the component is then one large box among the topics.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from xml.sax.saxutils import escape

from .drawing import Flow, Node, flow_of
from .schema import ModuleSpec

__all__ = ["draw_svg"]

_CHAR = 7.3  # width of a letter of the 12 px monospace font, rounded up
_SMALL = 6.1  # and of the 10 px one
_HEIGHT = 40.0
_GAP = 18.0  # between boxes of a layer
_PAD, _HEAD = 16.0, 26.0  # within a component: around its vertices, and for its name
_MARGIN = 16.0
_SWEEPS = 8

_STYLE = """\
text{font-family:ui-monospace,Menlo,Consolas,"DejaVu Sans Mono",monospace;font-size:12px;fill:#1b2733}
.detail,.datum{font-size:10px;fill:#5b6b7a}
.topic rect{fill:#fff4d6;stroke:#c99a1c}
.vertex rect{fill:#e3f0ff;stroke:#3f7fc4}
.component rect{fill:#e8f5e6;stroke:#4b9a45}
.group rect{fill:#f7f9fb;stroke:#9fb1c2;stroke-dasharray:5 3}
.group text{font-weight:bold}
.arrow{fill:none;stroke:#66788a;stroke-width:1.3}
.weak{stroke-dasharray:4 3}"""


@dataclass
class _Box:
    """A place in a layer: of a node, of a component with its vertices, or of a long arrow on its way (without size)."""

    id: str
    width: float = 0.0
    height: float = 0.0
    x: float = 0.0
    y: float = 0.0
    layer: int = 0
    order: float = 0.0
    before: list[_Box] = field(default_factory=list)
    after: list[_Box] = field(default_factory=list)

    @property
    def middle(self) -> float:
        return self.y + self.height / 2


@dataclass
class _Layout:
    """Boxes with their places, from (0, 0) on, and the ways of the arrows between them."""

    boxes: dict[str, _Box]
    ways: dict[tuple[str, str], list[_Box]]
    width: float
    height: float


def draw_svg(*modules: ModuleSpec) -> str:
    """The components, vertices and topics of some modules as an SVG document; the same modules give the same bytes.

    Raises:
        ConfigError: A class of a processor cannot be imported.
    """
    flow = flow_of(modules)
    member = {node: group for group, (_, nodes) in flow.groups.items() for node in nodes}
    inner: dict[str, _Layout] = {}
    sizes: dict[str, tuple[float, float]] = {}
    for group, (label, nodes) in flow.groups.items():
        arrows = [(a.source, a.target) for a in flow.arrows if member.get(a.source) == member.get(a.target) == group]
        room = _room(flow, arrows)
        inner[group] = layout = _lay_out({node: _size(flow.nodes[node]) for node in nodes}, arrows, room)
        width = max(layout.width, len(label) * _CHAR)
        sizes[group] = width + 2 * _PAD, layout.height + _PAD + _HEAD
    outer = {node.id: _size(node) for node in flow.nodes.values() if node.id not in member} | sizes
    crossing = [(member.get(a.source, a.source), member.get(a.target, a.target)) for a in flow.arrows]
    layout = _lay_out(outer, [(a, b) for a, b in crossing if a != b], 60.0)
    for group, within in inner.items():
        frame = layout.boxes[group]
        places = {id(box): box for box in (*within.boxes.values(), *(b for way in within.ways.values() for b in way))}
        for box in places.values():
            box.x += frame.x + _PAD
            box.y += frame.y + _HEAD
    return _document(flow, layout, inner, member)


def _room(flow: Flow, arrows: Iterable[tuple[str, str]]) -> float:
    """How far apart layers must be, so that the names of the data fit between them."""
    names = [a.datum for a in flow.arrows if (a.source, a.target) in set(arrows)]
    return 40.0 + max((len(name) * _SMALL for name in names), default=0.0)


def _size(node: Node) -> tuple[float, float]:
    width = max(len(node.label) * _CHAR, len(node.detail) * _SMALL) + 20.0
    return width, _HEIGHT if node.detail else 28.0


def _lay_out(sizes: Mapping[str, tuple[float, float]], arrows: Sequence[tuple[str, str]], room: float) -> _Layout:
    """Places boxes of given sizes."""
    boxes = {name: _Box(name, width, height) for name, (width, height) in sizes.items()}
    forward = _without_cycles(list(sizes), list(dict.fromkeys(arrows)))
    for _ in boxes:  # the longest way from a start: as many rounds as there are boxes at the most
        moved = False
        for source, target in forward:
            if boxes[target].layer <= boxes[source].layer:
                boxes[target].layer, moved = boxes[source].layer + 1, True
        if not moved:
            break
    ways: dict[tuple[str, str], list[_Box]] = {}
    everything = list(boxes.values())
    for source, target in forward:
        chain = [boxes[source]]
        for layer in range(boxes[source].layer + 1, boxes[target].layer):
            chain.append(_Box(f"{source} {target} {layer}", 0.0, 6.0, layer=layer))
            everything.append(chain[-1])
        chain.append(boxes[target])
        for left, right in itertools.pairwise(chain):
            left.after.append(right)
            right.before.append(left)
        ways[source, target] = chain[1:-1]
    layers = _ordered(everything)
    x = 0.0
    for layer in layers:
        width = max(box.width for box in layer)
        for box in layer:
            box.x = x + (width - box.width) / 2
        x += width + room
    _heights(layers)
    top = min((box.y for box in everything), default=0.0)
    for box in everything:
        box.y -= top
    height = max((box.y + box.height for box in everything), default=0.0)
    return _Layout(boxes, ways, max(0.0, x - room), height)


def _without_cycles(names: Sequence[str], arrows: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """The arrows that lead forward: those that close a cycle in a depth-first search are left out."""
    after: dict[str, list[str]] = {name: [] for name in names}
    for source, target in arrows:
        after[source].append(target)
    state = dict.fromkeys(names, 0)
    kept: set[tuple[str, str]] = set()
    for root in names:
        stack = [(root, iter(after[root]))] if not state[root] else []
        state[root] = state[root] or 1
        while stack:
            name, rest = stack[-1]
            for target in rest:
                if state[target] != 1:
                    kept.add((name, target))
                if state[target] == 0:
                    state[target] = 1
                    stack.append((target, iter(after[target])))
                    break
            else:
                state[name] = 2
                stack.pop()
    return [arrow for arrow in arrows if arrow in kept]


def _ordered(boxes: Sequence[_Box]) -> list[list[_Box]]:
    """The boxes by layer, in each by the mean place of what they are connected with."""
    layers: list[list[_Box]] = [[] for _ in range(1 + max((box.layer for box in boxes), default=-1))]
    for box in boxes:
        box.order = float(len(layers[box.layer]))
        layers[box.layer].append(box)
    for sweep in range(_SWEEPS):
        down = sweep % 2 == 0
        for layer in layers if down else reversed(layers):
            means = {}
            for box in layer:
                near = box.before if down else box.after
                means[id(box)] = sum(one.order for one in near) / len(near) if near else box.order
            layer.sort(key=lambda box: means[id(box)])
            for place, box in enumerate(layer):
                box.order = float(place)
    return layers


def _heights(layers: Sequence[Sequence[_Box]]) -> None:
    """Puts every box near the mean height of its neighbours, in its layer's order and without touching another."""
    for layer in layers:
        y = 0.0
        for box in layer:
            box.y = y
            y += box.height + _GAP
    for sweep in range(2 * _SWEEPS):
        down = sweep % 2 == 0
        for layer in layers if down else reversed(layers):
            wanted = []
            for box in layer:
                near = box.before if down else box.after
                middle = sum(one.middle for one in near) / len(near) if near else box.middle
                wanted.append(middle - box.height / 2)
            _spread(layer, wanted)


def _spread(layer: Sequence[_Box], wanted: Sequence[float]) -> None:
    """The places nearest to those that are wanted, in this order and apart: pooling of adjacent violators."""
    blocks: list[tuple[float, int]] = []  # where a run of boxes begins, less their offsets; how many there are
    offsets = []
    offset = 0.0
    for box, place in zip(layer, wanted, strict=True):
        offsets.append(offset)
        blocks.append((place - offset, 1))
        offset += box.height + _GAP
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (a, m), (b, n) = blocks[-2:]
            blocks[-2:] = [((a * m + b * n) / (m + n), m + n)]
    starts = [start for start, count in blocks for _ in range(count)]
    for box, start, offset in zip(layer, starts, offsets, strict=True):
        box.y = start + offset


def _document(flow: Flow, layout: _Layout, inner: Mapping[str, _Layout], member: Mapping[str, str]) -> str:
    boxes = dict(layout.boxes)
    for within in inner.values():
        boxes |= within.boxes
    width, height = layout.width + 2 * _MARGIN, layout.height + 2 * _MARGIN
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" height="{height:.0f}">',
        f"<style>{_STYLE}</style>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0,0 L8,4 L0,8 z" fill="#66788a"/></marker></defs>',
        '<rect width="100%" height="100%" fill="#ffffff"/>',
        f'<g transform="translate({_MARGIN:.0f},{_MARGIN:.0f})">',
    ]
    for group, (label, _) in flow.groups.items():
        box = layout.boxes[group]
        text = f'<text x="{box.x + _PAD:.1f}" y="{box.y + 17:.1f}">{escape(label)}</text>'
        lines.append(f'<g class="group" id="{group}">{_rect(box, 6)}{text}</g>')
    named: set[tuple[str, str]] = set()
    for arrow in flow.arrows:
        source, target = boxes[arrow.source], boxes[arrow.target]
        ends = member.get(arrow.source, arrow.source), member.get(arrow.target, arrow.target)
        if ends[0] == ends[1]:
            way = inner[ends[0]].ways.get((arrow.source, arrow.target), [])
        else:
            way = layout.ways.get(ends, [])
        title = escape(
            f"{flow.nodes[arrow.source].label} → {arrow.datum or 'topic'} → {flow.nodes[arrow.target].label}"
        )
        weak = " weak" if arrow.weak else ""
        lines.append(
            f'<path class="arrow{weak}" d="{_curve(source, way, target)}" marker-end="url(#tip)">'
            f"<title>{title}</title></path>"
        )
        if arrow.datum and (arrow.source, arrow.datum) not in named:
            place = sum(1 for name, _ in named if name == arrow.source)
            named.add((arrow.source, arrow.datum))
            x, y = source.x + source.width + 5, source.middle - 5 - 11 * place
            lines.append(f'<text class="datum" x="{x:.1f}" y="{y:.1f}">{escape(arrow.datum)}</text>')
    for node in flow.nodes.values():
        box = boxes[node.id]
        x = box.x + box.width / 2
        y = box.middle + (-2 if node.detail else 4)
        text = f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="middle">{escape(node.label)}</text>'
        if node.detail:
            text += (
                f'<text class="detail" x="{x:.1f}" y="{y + 14:.1f}" text-anchor="middle">{escape(node.detail)}</text>'
            )
        lines.append(f'<g class="{node.kind}" id="{node.id}">{_rect(box, 14 if node.kind == "topic" else 4)}{text}</g>')
    return "\n".join([*lines, "</g>", "</svg>", ""])


def _rect(box: _Box, radius: int) -> str:
    return f'<rect x="{box.x:.1f}" y="{box.y:.1f}" width="{box.width:.1f}" height="{box.height:.1f}" rx="{radius}"/>'


def _curve(source: _Box, way: Sequence[_Box], target: _Box) -> str:
    """From the right side of a box through the places of a long arrow to the left side of another."""
    points = [(source.x + source.width, source.middle), *((box.x, box.middle) for box in way)]
    points.append((target.x, target.middle))
    path = f"M{points[0][0]:.1f},{points[0][1]:.1f}"
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        bend = max(20.0, abs(x1 - x0) / 2)
        path += f" C{x0 + bend:.1f},{y0:.1f} {x1 - bend:.1f},{y1:.1f} {x1:.1f},{y1:.1f}"
    return path
