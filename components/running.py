"""A whole run: from a source through a pipeline into a folder, with a progress bar and a table at the end."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from ..dag.trace import Trace
from ..errors import ConfigError, SinkError, SourceError
from .machine import describe_machine
from .observing import Observer
from .pipeline import PerceptionFrame, Pipeline
from .report import RunReport
from .sinks import JsonLinesSink, McapSink
from .sources import Source, open_source

__all__ = ["run_to_folder"]


def run_to_folder(
    uri: str,
    *,
    out: Path,
    profile: str = "cpu",
    device: str | None = None,
    settings: Iterable[str] = (),
    frames: int | None = None,
    realtime: bool = False,
    mcap: bool = True,
    picture: bool = False,
    trace: Path | None = None,
    metrics_port: int | None = None,
) -> dict[str, Any]:
    """Perceives a source and writes `objects.jsonl`, `report.json` and `run.mcap` into a folder.

    Args:
        uri: The source, as `sources.open_source` takes it.
        out: The folder; made where there is none, its files of those names replaced.
        profile: Hardware profile, by name or path.
        device: Compute device in place of the profile's.
        settings: Changes by dotted key, as texts `key=value`.
        frames: Stop after so many; None takes all.
        realtime: Feed the frames at their own pace; what is too slow drops frames, counted.
        mcap: Whether to record `run.mcap`.
        picture: Whether to draw a frame in the middle as `frame.png`.
        trace: File for a trace of the run that ui.perfetto.dev opens.
        metrics_port: Port of an endpoint for Prometheus on this machine.

    Returns:
        The report, as it is in `report.json`.

    Raises:
        ConfigError: Profile, settings or source make no sense, or there is nothing at the source.
        SourceError: The source broke off, or gave no frame.
        SinkError: The outputs cannot be written.
    """
    console = Console(stderr=True)
    started = time.perf_counter()
    settings = list(settings)
    with console.status("preparing"):
        try:
            source = open_source(uri, device=device)
        except SourceError as error:  # nothing is there to run on: the caller's mistake, not a run that failed
            raise ConfigError(f"--source {error}") from error
        pipeline = Pipeline.from_profile(profile, device=device, settings=settings)
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SinkError(f"{out}: the folder cannot be made: {error.strerror or error}") from error
    prepared = time.perf_counter() - started
    report = RunReport()
    length = source.length if frames is None or source.length is None else min(frames, source.length)
    middle: PerceptionFrame | None = None
    with ExitStack() as stack:
        stack.enter_context(pipeline)
        observer = stack.enter_context(Observer(pipeline, trace=trace, metrics_port=metrics_port))
        if observer.server is not None:
            console.print(f"metrics at http://127.0.0.1:{observer.server.port}/metrics")
        sinks: list[JsonLinesSink | McapSink] = [stack.enter_context(JsonLinesSink(out / "objects.jsonl"))]
        if mcap:
            # On a vehicle a slow disk must not hold up perception; offline nothing may be lost.
            when_full = "drop" if realtime else "block"
            sinks.append(stack.enter_context(McapSink(out / "run.mcap", when_full=when_full)))
        progress = stack.enter_context(_progress(console))
        task = progress.add_task(source.name, total=length)
        first_frame = None
        # Closed before the sinks, so that the pipeline's threads are gone when an error leaves this block.
        perceived = pipeline.run(itertools.islice(source, frames), realtime=realtime, watch=observer.watch)
        stack.callback(perceived.close)
        for frame in perceived:
            first_frame = first_frame or time.perf_counter() - started
            for sink in sinks:
                sink.write(
                    frame.objects, latency_ms=frame.latency.total_ms, points=frame.points, pose=frame.sensor.pose
                )
            report.add(frame)
            if picture and (middle is None or frame.index == (length or 0) // 2):
                middle = frame
            progress.advance(task)
    if report.frames == 0:
        raise SourceError(f"{uri}: not one frame came out; {_skipped_text(source)}")
    outputs = ["objects.jsonl", "report.json", *(["run.mcap"] if mcap else [])]
    if middle is not None:
        from .viewer.picture import draw_frame, write_png

        write_png(out / "frame.png", draw_frame(middle))
        outputs.append("frame.png")
    summary = report.write(
        out / "report.json",
        source=uri,
        profile=pipeline.profile.profile,
        device=pipeline.device,
        settings=settings,
        latency_budget_ms=pipeline.profile.latency_budget_ms,
        seconds={
            "prepare": round(prepared, 3),
            "first_frame": round(first_frame or 0.0, 3),
            "all": round(time.perf_counter() - started, 3),
        },
        frames_skipped=[{"frame": s.index, "path": str(s.path), "reason": s.reason} for s in source.skipped],
        losses=pipeline.losses,
        **({"trace": _trace_of(observer.trace)} if observer.trace is not None else {}),
        metrics=observer.metrics.as_dict(),
        sinks={
            sink.path.name: {"written": sink.written, "dropped": sink.dropped, "objects_refused": sink.refused}
            for sink in sinks
        },
        machine=describe_machine(),
    )
    _print(Console(), summary, out, outputs)
    return summary


def _progress(console: Console) -> Progress:
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not sys.stderr.isatty(),
    )


def _trace_of(trace: Trace) -> dict[str, Any]:
    return {"path": str(trace.path), "events_dropped": trace.dropped, "failure": trace.failure}


def _skipped_text(source: Source) -> str:
    if not source.skipped:
        return "the source is empty"
    first = source.skipped[0]
    return f"{len(source.skipped)} could not be read, the first of them {first.path}: {first.reason}"


def _print(console: Console, report: dict[str, Any], out: Path, outputs: list[str]) -> None:
    latency = report["latency_ms"]
    table = Table(title=f"latency, {report['frames']} frames of {report['points_per_frame']:,.0f} points", min_width=56)
    for name in ("stage", "p50 [ms]", "p90 [ms]", "p99 [ms]", "max [ms]", "wait [ms]"):
        table.add_column(name, justify="left" if name == "stage" else "right")
    for stage, row in latency["stages"].items():
        if not stage.split(".")[1].startswith("commit"):
            table.add_row(stage, *_times(row), f"{row['wait_median']:.2f}")
    table.add_section()
    total = latency["total"]
    if total["median"] is not None:
        table.add_row("whole frame", *_times(total), "")
    console.print(table)
    if "objects" in report:
        table = Table(title="objects against the truth", min_width=56)
        for name in ("class", "true", "found", "precision", "id switches", "centre [m]", "velocity [m/s]"):
            table.add_column(name, justify="left" if name == "class" else "right")
        for name, row in report["objects"].items():
            if isinstance(row, dict):
                table.add_row(
                    name,
                    str(row["objects"]),
                    _percent(row["found"]),
                    _percent(row["precision"]),
                    str(row["id_switches"]),
                    _number(row["position_error_m"]),
                    _number(row["velocity_error_mps"]),
                )
        console.print(table)
    counts = ", ".join(f"{count} {name}" for name, count in sorted(report["objects_reported"].items()))
    console.print(f"objects reported over all frames: {counts}; {report['tracks']} foreground tracks")
    if report.get("ground_f1") is not None:
        console.print(f"ground F1 {100 * report['ground_f1']:.2f} %")
    for what in ("frames_failed", "frames_skipped", "losses"):
        if report[what]:
            console.print(f"{what.replace('_', ' ')}: {report[what]}", style="yellow")
    if report.get("trace"):
        console.print(f"trace in {report['trace']['path']}: open it at ui.perfetto.dev")
    console.print(f"outputs in {out}/: {', '.join(outputs)}")


def _times(row: dict[str, float]) -> list[str]:
    return [f"{row[key]:.2f}" for key in ("median", "p90", "p99", "max")]


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
