"""Perceives scans of your own: python examples/your_scans.py FOLDER_OR_FILE (.bin, .npy, .pcd, .ply)."""

import sys

import warploom as wl

source = wl.read(sys.argv[1])
with wl.Pipeline.from_profile("cpu") as pipeline:
    for frame in pipeline.run(source):
        print(f"frame {frame.index}: {len(frame.points)} points, {frame.ground.mean():.0%} ground,", end=" ")
        print(f"{frame.clusters.max(initial=-1) + 1} clusters, {frame.latency.total_ms:.0f} ms")
        for thing in frame.objects:
            if thing.kind == "foreground":
                x, y, z = thing.box[:3]
                print(f"  {thing.label} {thing.id} at ({x:.1f}, {y:.1f}, {z:.1f}) m, score {thing.score:.2f}")
