"""The command `warploom`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .errors import ConfigError, DeviceError, ModelError, WarploomError

if TYPE_CHECKING:
    from .datamesh.recording import RecordedEvent

__all__ = ["app", "main"]

app = typer.Typer(
    name="warploom",
    help="Perception for vehicles and robots: from LiDAR points to tracked objects, on a GPU or a plain CPU.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)

Profile = Annotated[str, typer.Option("--profile", help="Hardware profile: a name, or the path of a YAML file.")]
Device = Annotated[str | None, typer.Option("--device", help="Compute device in place of the profile's: cpu, cuda:0 …")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Change a setting by its dotted key, such as perception.cluster.radius=0.6."
    ),
]

TraceFile = Annotated[
    Path | None, typer.Option("--trace", metavar="FILE", help="Write a trace of the run, for ui.perfetto.dev.")
]
MetricsPort = Annotated[
    int | None,
    typer.Option("--metrics-port", min=0, max=65535, help="Answer Prometheus on this port of 127.0.0.1; 0: any."),
]


evaluation = typer.Typer(help="Measure what is found on data sets.", no_args_is_help=True)
app.add_typer(evaluation, name="eval")


@app.callback()
def _root(
    log_level: Annotated[str, typer.Option("--log-level", help="debug, info, warning or error.")] = "warning",
    log_dir: Annotated[
        Path | None,
        typer.Option("--log-dir", envvar="WARPLOOM_LOG_DIR", help="Folder for a log file of this process, rotated."),
    ] = None,
) -> None:
    from .dag.logs import start_logging

    try:
        start_logging(log_level, log_dir)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--log-level") from error


@app.command()
def demo(
    seconds: Annotated[float, typer.Option(min=0.1, max=600.0, help="Simulated time.")] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated street.")] = 7,
    out: Annotated[Path, typer.Option(help="Folder for the outputs.")] = Path("warploom-demo"),
    profile: Profile = "cpu",
    device: Device = None,
    settings: Settings = None,
    trace: TraceFile = None,
    metrics_port: MetricsPort = None,
) -> None:
    """Drive a simulated street and track what is on it, with the truth beside it.

    Example: `warploom demo --seconds 10 --seed 3`
    """
    from .components.running import run_to_folder

    source = f"sim:street?seed={seed}&duration={seconds}"
    run_to_folder(
        source,
        profile=profile,
        device=device,
        settings=settings or (),
        out=out,
        picture=True,
        trace=trace,
        metrics_port=metrics_port,
    )


@app.command()
def run(
    source: Annotated[
        str, typer.Option("--source", help="kitti:DIR, sim:street?seed=7, or a scan or a folder of scans.")
    ],
    profile: Profile = "cpu",
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after this many frames.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for objects.jsonl, report.json and run.mcap.")] = Path(
        "warploom-out"
    ),
    device: Device = None,
    settings: Settings = None,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Feed frames at their own pace; late ones are dropped.")
    ] = False,
    mcap: Annotated[bool, typer.Option(help="Write run.mcap.")] = True,
    trace: TraceFile = None,
    metrics_port: MetricsPort = None,
    check: Annotated[
        bool, typer.Option("--check", help="Look whether data are written to after their commit, and count them.")
    ] = False,
) -> None:
    """Perceive the frames of a recording or of the simulator.

    Example: `warploom run --source kitti:scans/ --out out --set perception.cluster.radius=0.6`
    """
    from .components.running import run_to_folder

    run_to_folder(
        source,
        profile=profile,
        device=device,
        settings=[*(settings or ()), *(["profile.check=true"] if check else [])],
        out=out,
        frames=frames,
        realtime=realtime,
        mcap=mcap,
        trace=trace,
        metrics_port=metrics_port,
    )


@app.command()
def info(
    file: Annotated[str | None, typer.Argument(help="A scan, a folder of scans, or a recording.")] = None,
) -> None:
    """Tell what a file holds; without one, the machine and the versions.

    Example: `warploom info scans/`
    """
    if file is None:
        from .components.machine import describe_machine, machine_lines

        lines = machine_lines(describe_machine())
    else:
        from .components.sources import describe, describe_lines

        lines = describe_lines(describe(file))
    for line in lines:
        typer.echo(line)


@app.command()
def check(
    file: Annotated[str, typer.Argument(help="A profile or a module: the path of a YAML file, or a name.")],
    settings: Settings = None,
) -> None:
    """Validate a profile or a module file, with all that it names, without running it.

    Example: `warploom check conf/modules/perception.yaml`
    """
    from .components.checking import check_file

    for line in check_file(file, settings or ()):
        typer.echo(line)


@app.command()
def graph(
    file: Annotated[str, typer.Argument(help="A module or a profile: a YAML file, or a name.")] = "perception",
    form: Annotated[str, typer.Option("--format", help="text, mermaid or svg.")] = "text",
    settings: Settings = None,
) -> None:
    """Draw the components of a module file, or of all those of a profile, and the vertices of their graphs.

    Example: `warploom graph perception --format svg > perception.svg`
    """
    from .components.checking import FORMATS, draw_file

    if form not in FORMATS:
        raise typer.BadParameter(f"{form!r} is neither text nor mermaid nor svg", param_hint="--format")
    typer.echo(draw_file(file, form, settings or ()).rstrip())


@app.command()
def bench(
    filters: Annotated[
        list[str] | None,
        typer.Option("--filter", metavar="TEXT", help="Only benchmarks with this in their name; may be repeated."),
    ] = None,
    device: Annotated[str, typer.Option("--device", help="Where ours computes: cpu, cuda:0 …")] = "cpu",
    compare: Annotated[
        Path | None, typer.Option("--compare", metavar="OLD.json", help="An earlier run's benchmark.json.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for benchmark.json, benchmarks.md and its plots.")] = Path(
        "warploom-bench"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="Few rounds, no large clouds, no long runs.")] = False,
) -> None:
    """Time the kernels beside those peers that are installed.

    Example: `warploom bench --filter voxelize --filter "cluster 120k" --compare old/benchmark.json`
    """
    from .bench.run import run_benchmarks

    run_benchmarks(filters=filters or (), device=device, compare=compare, out=out, quick=quick)


@evaluation.command("tracking")
def eval_tracking(
    data: Annotated[Path, typer.Option("--data", help="KITTI's tracking set: label_02/, calib/, oxts/.")],
    detections: Annotated[
        Path,
        typer.Option("--detections", help="Folder of SSSS.txt with the detections of a type, or its name in DATA."),
    ],
    sequences: Annotated[
        str, typer.Option("--sequences", help="Such as 0001,0012; by default all with labels and detections.")
    ] = "",
    out: Annotated[Path, typer.Option(help="Folder for result files, summary.json and recall.png.")] = Path(
        "warploom-eval"
    ),
    tracker: Annotated[
        str, typer.Option("--tracker", help="The tracker's settings: a YAML file, or a name in conf/trackers.")
    ] = "pointrcnn",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change one by its dotted key, such as vehicle.coast=2.0."),
    ] = None,
) -> None:
    """Track detections on KITTI's tracking set, and score the tracks: sAMOTA, MOTA and HOTA.

    Example: `warploom eval tracking --data kitti_tracking --detections pointrcnn_Car --out car`
    """
    from .components.evaluation.tracking import evaluate_tracking, lines_of
    from .components.perception.tracker_settings import load_tracker

    config = load_tracker(tracker, settings or ())
    names = [name for name in sequences.split(",") if name]
    for line in lines_of(evaluate_tracking(data, detections, out, sequences=names, config=config)):
        typer.echo(line)


@app.command()
def record(
    source: Annotated[str, typer.Option("--source", help="As for `run`.")],
    out: Annotated[Path, typer.Option(help="The recording.")] = Path("recording.mcap"),
    profile: Profile = "cpu",
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after this many frames.")] = None,
    topics: Annotated[list[str] | None, typer.Option("--topic", help="A topic to record; by default all.")] = None,
    digest_only: Annotated[
        list[str] | None, typer.Option("--digest-only", metavar="TOPIC", help="Keep only the hashes of this topic.")
    ] = None,
    compression: Annotated[str, typer.Option(help="lz4, zstd or none.")] = "lz4",
    device: Device = None,
    settings: Settings = None,
    realtime: Annotated[bool, typer.Option("--realtime", help="Feed frames at their own pace.")] = False,
) -> None:
    """Perceive a source and record every topic, lossless, for `play` and `replay`.

    Example: `warploom record --source sim:street?seed=7 --out street.mcap`
    """
    from .components.recording import record_source

    if compression not in ("lz4", "zstd", "none"):
        raise typer.BadParameter(f"{compression!r} is none of lz4, zstd, none", param_hint="--compression")
    summary = record_source(
        source,
        out,
        profile=profile,
        device=device,
        settings=settings or (),
        frames=frames,
        realtime=realtime,
        topics=topics or (),
        digest_only=digest_only or (),
        compression=compression,
    )
    for line in summary.lines():
        typer.echo(line)


@app.command()
def play(
    file: Annotated[Path, typer.Argument(help="A recording made by `record`.")],
    rate: Annotated[float | None, typer.Option(help="Speed; 2 is twice as fast as it was.")] = 1.0,
    fast: Annotated[bool, typer.Option("--fast", help="As fast as it goes, without losing anything.")] = False,
    seek: Annotated[float, typer.Option(min=0.0, help="Begin here [s].")] = 0.0,
    loop: Annotated[int, typer.Option(min=0, help="Play it so often; 0: until interrupted.")] = 1,
    step: Annotated[bool, typer.Option("--step", help="Wait for Enter before each version; q ends.")] = False,
    topics: Annotated[list[str] | None, typer.Option("--topic", help="A topic to play; by default all.")] = None,
    profile: Annotated[str | None, typer.Option("--profile", help="Run the modules of this profile on it.")] = None,
    record: Annotated[Path | None, typer.Option("--record", help="Record all topics into this file.")] = None,
    device: Device = None,
    settings: Settings = None,
) -> None:
    """Publish a recording at its own pace or any other, and tell each commit.

    Example: `warploom play street.mcap --rate 0.5 --seek 2 --loop 3`
    """
    from .components.recording import play_recording

    if rate is not None and rate <= 0:
        raise typer.BadParameter(f"{rate} is not above 0", param_hint="--rate")
    summary = play_recording(
        file,
        profile=profile,
        device=device,
        settings=settings or (),
        topics=topics or (),
        rate=None if fast or step else rate,
        seek=seek,
        loops=loop or None,
        record=record,
        on_event=_teller(step),
    )
    counts = ", ".join(f"{count} of {topic}" for topic, count in summary.published.items()) or "nothing"
    typer.echo(f"played {counts} in {summary.seconds:.2f} s")
    for topic, count in summary.skipped.items():
        typer.echo(f"{count} of {topic} could not be played: their values are not in the recording")
    if summary.broken:
        typer.echo(f"{file}: {summary.broken}; what comes before was played")
    for line in summary.recorded.lines() if summary.recorded else ():
        typer.echo(line)


def _teller(step: bool) -> Callable[[RecordedEvent], bool]:
    """Prints each event; with `step` waits for Enter before each new version."""
    last: int | None = None

    def tell(event: RecordedEvent) -> bool:
        nonlocal last
        if step and event.version != last:
            last = event.version
            if typer.prompt(f"{event.version}", default="", show_default=False, prompt_suffix=" > ") == "q":
                return False
        size = "nothing" if event.payload is None else f"{len(event.payload):,} bytes"
        typer.echo(f"{event.version} {event.topic} {size}")
        return True

    return tell


@app.command()
def replay(
    file: Annotated[Path, typer.Argument(help="A recording made by `record`.")],
    verify: Annotated[bool, typer.Option("--verify", help="Fail unless every commit is what was recorded.")] = False,
    workers: Annotated[
        list[int] | None, typer.Option("--workers", min=1, max=64, help="Run it with so many threads; may be repeated.")
    ] = None,
    profile: Annotated[
        str | None, typer.Option("--profile", help="Run this profile in place of the one that was recorded.")
    ] = None,
    device: Device = None,
    settings: Settings = None,
) -> None:
    """Run the components again on a recording's sensor data and compare all they commit with it, bit for bit.

    Example: `warploom replay street.mcap --verify --workers 1 --workers 2 --workers 8`
    """
    from .components.recording import replay_lines, replay_recording

    good = True
    for number, result, changed in replay_recording(
        file, profile=profile, device=device, settings=settings or (), workers=workers or ()
    ):
        good = good and result.good
        for line in replay_lines(number, result, changed):
            typer.echo(line)
    if verify and not good:
        raise typer.Exit(1)


def main() -> None:
    """Runs the command: exit code 0 when it is done, 2 for bad usage or configuration, 1 when it failed."""
    try:
        app()
    except (ConfigError, DeviceError, ModelError) as error:
        typer.echo(f"warploom: {error}", err=True)
        sys.exit(2)
    except WarploomError as error:
        typer.echo(f"warploom: {error}", err=True)
        sys.exit(1)
    except KeyboardInterrupt:
        typer.echo("warploom: interrupted", err=True)
        sys.exit(130)
