"""Commands that record, play and replay."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .application import ends_in_order
from .options import Device, Profile, Settings

if TYPE_CHECKING:
    from ..datamesh.recording import RecordedEvent


__all__ = ["commands"]

commands = typer.Typer()


@commands.command()
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

    Example: `warploom record --source "sim:street?seed=7" --out street.mcap`
    """
    from ..components.recording import record_source

    if compression not in ("lz4", "zstd", "none"):
        raise typer.BadParameter(f"{compression!r} is none of lz4, zstd, none", param_hint="--compression")
    with ends_in_order():
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
    if summary.failure is not None:
        raise typer.Exit(1)


@commands.command()
def play(
    file: Annotated[Path, typer.Argument(help="A recording made by `record`.")],
    rate: Annotated[float | None, typer.Option(help="Speed; 2 is twice as fast as it was.")] = 1.0,
    fast: Annotated[bool, typer.Option("--fast", help="As fast as it goes, without losing anything.")] = False,
    seek: Annotated[float, typer.Option(min=0.0, help="Begin so long after the recording's beginning [s].")] = 0.0,
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
    from ..components.recording import play_recording

    if rate is not None and rate <= 0:
        raise typer.BadParameter(f"{rate} is not above 0", param_hint="--rate")
    with ends_in_order():
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
    if summary.recorded is not None and summary.recorded.failure is not None:
        raise typer.Exit(1)


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


@commands.command()
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
    from ..components.recording import replay_lines, replay_recording

    good = True
    for number, result, changed in replay_recording(
        file, profile=profile, device=device, settings=settings or (), workers=workers or ()
    ):
        good = good and result.good
        for line in replay_lines(number, result, changed):
            typer.echo(line)
    if verify and not good:
        raise typer.Exit(1)
