"""Runs the pipeline with a processor of one's own: python examples/own_processor/run.py."""

import pathlib
import sys

import warploom as wl

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))  # where the module file finds nearest.NearestObject

with wl.Pipeline.from_profile(str(HERE / "profile.yaml")) as pipeline:
    for frame in pipeline.run(wl.read("sim:street?seed=3&duration=1"), topics=["example/distance"]):
        distance = frame.data["example/distance"]
        print(f"frame {frame.index}: {len(frame.objects)} objects, the nearest at {distance:.1f} m")
