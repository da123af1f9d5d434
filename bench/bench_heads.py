"""Detection heads on one frame: ours in floating point and in eight bits, beside KITTI's PointPillars.

From points to boxes for the heads; the peer is PointPillars' backbone alone (4.8 M parameters, random weights, as the
time does not depend on them), without making pillars or reading boxes. All run in ONNX Runtime with two threads.
"""

import numpy as np
import pytest
import warp as wp

from warploom.bench.contest import OURS, Contender, peer, record_figure
from warploom.bench.scans import REAL
from warploom.models.card import DEFAULT_CARD, EIGHT_BITS_CARD
from warploom.models.head import DetectionHead
from warploom.models.network import Network

CLOUDS = ("street 120k", REAL)
BACKBONE = "PointPillars' backbone"
CARDS = {"detection head": DEFAULT_CARD, "detection head, 8 bits": EIGHT_BITS_CARD}
GOAL_MS = 35.0  # of the head that the profiles for a CPU take
SECOND_GOAL_MS = 6.0  # of them for its second stage, of 96 candidates
HOW = "points to boxes, 480 x 480 cells; the peer is that backbone alone, in floating point"
_HEIGHT, _THREADS = 1.73, 2


def backbone(folder):
    """PointPillars' two-dimensional part for KITTI: 64 x 496 x 432 to scores, residuals and directions."""
    torch = peer("torch")
    from warploom.models.importers.pointpillars import PointPillarsNet, PointPillarsSpec

    torch.manual_seed(0)
    whole = PointPillarsNet(PointPillarsSpec()).eval()

    class Backbone(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.whole = whole

        def forward(self, x):
            sides = []
            for block, up in zip(self.whole.blocks, self.whole.ups, strict=True):
                x = block(x)
                sides.append(up(x))
            x = torch.cat(sides, dim=1)
            return self.whole.scores(x), self.whole.residuals(x), self.whole.directions(x)

    path = folder / "backbone.onnx"
    torch.onnx.export(
        Backbone(), (torch.zeros(1, 64, 496, 432),), str(path), opset_version=17, dynamo=False,
        input_names=["canvas"], output_names=["scores", "residuals", "directions"],
    )  # fmt: skip
    return path, sum(parameter.numel() for parameter in whole.parameters())


def found(result):
    return f"{len(result)} objects"


def agreement(card, points):
    """How far a variant's boxes are from those in floating point, at the card's score."""
    ours, other = DetectionHead(DEFAULT_CARD, threads=_THREADS), DetectionHead(card, threads=_THREADS)
    a, b = ours.detect_points(points, _HEIGHT), other.detect_points(points, _HEIGHT)
    if not len(a) or not len(b):
        return f"{len(b)} of {len(a)} objects"
    apart = np.linalg.norm(a.boxes[:, None, :2] - b.boxes[None, :, :2], axis=2).min(axis=1)
    return f"{(apart < 0.5).sum()} of {len(a)} objects within 0.5 m, {len(b)} in all"


@pytest.mark.parametrize("kernel", CARDS)
@pytest.mark.parametrize("scan", CLOUDS)
def bench_head(benchmark, contest, kernel, scan):
    points, card = contest.cloud(scan), CARDS[kernel]
    said = agreement(card, points) if card == EIGHT_BITS_CARD else None

    def call(device):
        head = DetectionHead(card, device=device, threads=_THREADS)
        head.warm_up()
        return lambda: head.detect_points(points, _HEIGHT)

    contest.run(
        Contender(OURS), {OURS: call}, kernel=kernel, on=scan, size=len(points),
        score=(lambda result: said) if said else found, how=HOW,
    )  # fmt: skip
    record_figure(
        benchmark, f"{kernel}, {scan}, median", 1e3 * benchmark.stats.stats.median, "ms",
        goal=GOAL_MS if card == EIGHT_BITS_CARD else None, note=f"{len(points):,} points to boxes; {_THREADS} threads",
    )  # fmt: skip


@pytest.mark.parametrize("scan", CLOUDS)
def bench_refinement(benchmark, contest, scan):
    """What it takes to turn and move the vehicles that were found onto their points, which the head's time includes."""
    points = contest.cloud(scan)
    head = DetectionHead(EIGHT_BITS_CARD, threads=_THREADS)
    objects = head.detect_points(points, _HEIGHT)
    slot = head._slots[0]
    xyz = wp.array(np.ascontiguousarray(points[:, :3], np.float32), dtype=wp.vec3, device="cpu")
    boxes, _, kinds = slot.found
    found = (boxes, kinds, slot.kept.keep, slot.kept.keep_count)
    benchmark.pedantic(lambda: slot.refine.launch(xyz, slot.count, *found), rounds=30, warmup_rounds=3)
    record_figure(
        benchmark, f"boxes refined, {scan}, median", 1e3 * benchmark.stats.stats.median, "ms",
        note=f"{len(points):,} points, {len(objects)} objects; one thread",
    )  # fmt: skip


@pytest.mark.parametrize("scan", CLOUDS)
def bench_second_look(benchmark, contest, scan):
    """What it takes to look at the points of the candidates, which the head's time includes."""
    points = contest.cloud(scan)
    head = DetectionHead(EIGHT_BITS_CARD, threads=_THREADS)
    head.detect_points(points, _HEIGHT)
    slot, second = head._slots[0], head._second
    xyz = wp.array(np.ascontiguousarray(points[:, :3], np.float32), dtype=wp.vec3, device="cpu")
    given = [(xyz, slot.count, _HEIGHT)], [(slot.decode, slot.nms)], head.score_threshold
    benchmark.pedantic(lambda: second.launch(*given), rounds=30, warmup_rounds=3)
    candidates = int(second.look(0).rescore.count.numpy()[0])
    record_figure(
        benchmark, f"second look, {scan}, median", 1e3 * benchmark.stats.stats.median, "ms",
        goal=SECOND_GOAL_MS, note=f"{len(points):,} points, {candidates} candidates; {_THREADS} threads",
    )  # fmt: skip


@pytest.mark.parametrize("kernel", CARDS)
def bench_pointpillars_backbone(contest, tmp_path, kernel):
    path, parameters = backbone(tmp_path)
    points = contest.cloud("street 120k")

    def call(device):
        import warp as wp

        shapes = {"scores": 18, "residuals": 42, "directions": 12}
        network = Network(
            path,
            {"canvas": (1, 64, 496, 432)},
            {name: (1, channels, 248, 216) for name, channels in shapes.items()},
            device=device,
            threads=_THREADS,
        )
        network.bind_input("canvas", wp.zeros((1, 64, 496, 432), dtype=wp.float32, device=device))
        kept = [wp.zeros((1, channels, 248, 216), dtype=wp.float32, device=device) for channels in shapes.values()]
        for name, array in zip(shapes, kept, strict=True):
            network.bind_output(name, array)
        return lambda: (network.run(), kept)

    contest.run(
        Contender(BACKBONE), {BACKBONE: call}, kernel=kernel, on="street 120k", size=len(points),
        score=lambda _: f"{parameters / 1e6:.1f} M parameters", threads={BACKBONE: _THREADS}, how=HOW,
    )  # fmt: skip
