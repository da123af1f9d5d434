"""Records what a pipeline commits, plays recordings, and replays them: the same components must give the same bytes."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from ..dag import Process
from ..dag.replay import Drain, Replay, ReplayResult, produced_topics
from ..dag.run_log import RunLog
from ..datamesh import DataMesh
from ..datamesh.playback import Player
from ..datamesh.recording import RecordedEvent, Recorder
from ..datamesh.recording_reader import Recording
from ..errors import ConfigError, SourceError
from .machine import describe_machine
from .pipeline import LIDAR_TOPIC, Pipeline
from .sources import open_source

__all__ = ["PlaySummary", "RecordSummary", "play_recording", "record_source", "replay_lines", "replay_recording"]

_SHOWN = 20


@dataclass
class RecordSummary:
    """What was recorded."""

    path: Path
    frames: int = 0
    commits: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    """Commits that are not in the file, by reason."""
    failure: str | None = None
    """Why the recording broke off; None where it did not."""
    losses: dict[str, dict[str, int]] = field(default_factory=dict)
    """What the run lost: topic or component → reason → how many."""

    def lines(self) -> list[str]:
        """The same to read."""
        size = self.path.stat().st_size / 1e6
        lines = [f"{self.path}: {self.frames} frames, {self.commits} commits, {size:.1f} MB"]
        if self.failure is not None:
            lines.append(f"the recording broke off: {self.failure}; the run went on without it")
        lines += [f"{count} commits were not recorded: {reason}" for reason, count in self.dropped.items()]
        lines += [f"lost: {place}: {reason} {n}" for place, why in self.losses.items() for reason, n in why.items()]
        return lines


def recorder_for(
    pipeline: Pipeline,
    path: Path,
    *,
    source: str,
    settings: Sequence[str] = (),
    when_full: str = "block",
    digest_only: Iterable[str] = (),
    compression: str = "lz4",
) -> Recorder:
    """A recorder whose file says what ran: profile, modules, settings, device and versions.

    Raises:
        SinkError: The file cannot be created.
    """
    machine = describe_machine()
    metadata = {
        "source": source,
        "profile": pipeline.profile.profile,
        "device": pipeline.device,
        "settings": json.dumps(list(settings)),
        "inference_threads": str(pipeline.profile.threads.inference),
        "versions": json.dumps(machine["versions"]),
        "machine": json.dumps({key: machine[key] for key in ("system", "python", "processor", "cores")}),
    }
    attachments = {file.name: file.read_bytes() for file in pipeline.files}
    return Recorder(
        path,
        compression=compression,
        when_full=when_full,
        metadata=metadata,
        attachments=attachments,
        digest_only=digest_only,
    )


def _record(recorder: Recorder, process: Process, pipeline: Pipeline, topics: Iterable[str]) -> None:
    """Records topics of a process that has not started, and the log of its run."""
    recorder.watch(process.mesh, topics)
    log = RunLog(recorder.log)
    log.watch(process)
    pipeline.on_timing(log.on_timing)


def all_topics(process: Process) -> list[str]:
    """The topics that the components of a process read or write."""
    read = {handle.topic for component in process.components.values() for handle in component.inputs.values()}
    return sorted(read | produced_topics(process))


def _chosen(process: Process, topics: Sequence[str], what: str) -> list[str]:
    known = all_topics(process)
    for topic in topics:
        if topic not in known:
            raise ConfigError(f"{what} {topic!r}: no component reads or writes it; there are: {', '.join(known)}")
    return list(topics) or known


def record_source(
    uri: str,
    out: Path,
    *,
    profile: str = "cpu",
    device: str | None = None,
    settings: Sequence[str] = (),
    frames: int | None = None,
    realtime: bool = False,
    topics: Sequence[str] = (),
    digest_only: Sequence[str] = (),
    compression: str = "lz4",
    on_frame: Callable[[], None] = lambda: None,
) -> RecordSummary:
    """Perceives a source and records the topics.

    Args:
        uri: The source, as `sources.open_source` takes it.
        out: The recording; a file of that name is replaced.
        profile: Hardware profile, by name or path.
        device: Compute device in place of the profile's.
        settings: Changes by dotted key, as texts `key=value`.
        frames: Stop after so many; None takes all.
        realtime: Feed the frames at their own pace; what is too slow is dropped, and counted.
        topics: What to record; all topics where there are none.
        digest_only: Topics of which only hashes are kept.
        compression: lz4, zstd or none.
        on_frame: Called after each frame.

    Raises:
        ConfigError: Profile, settings, topics or source make no sense, or there is nothing at the source.
        SourceError: The source broke off.
        SinkError: The recording cannot be created.
    """
    try:
        source = open_source(uri, device=device)
    except SourceError as error:
        raise ConfigError(f"--source {error}") from error
    summary = RecordSummary(out)
    with ExitStack() as stack:
        pipeline = stack.enter_context(Pipeline.from_profile(profile, device=device, settings=settings))
        recorder: Recorder | None = None

        def watch(process: Process) -> None:
            nonlocal recorder
            chosen = _chosen(process, topics, "--topic")
            _chosen(process, digest_only, "--digest-only")
            recorder = recorder_for(
                pipeline,
                out,
                source=uri,
                settings=settings,
                when_full="drop" if realtime else "block",
                digest_only=digest_only,
                compression=compression,
            )
            stack.push(recorder)
            _record(recorder, process, pipeline, chosen)

        perceived = pipeline.run(itertools.islice(source, frames), realtime=realtime, watch=watch)
        stack.callback(perceived.close)
        for _ in perceived:
            summary.frames += 1
            on_frame()
        perceived.close()
        assert recorder is not None
        recorder.close()
        summary.commits, summary.dropped = recorder.written, dict(recorder.dropped)
        summary.failure, summary.losses = recorder.failure, pipeline.losses
    return summary


def _pipeline_of(
    recording: Recording, profile: str | None, device: str | None, settings: Sequence[str], workers: int | None
) -> Pipeline:
    """The pipeline that was recorded, or another one where the caller names it."""
    name = profile or recording.metadata.get("profile", "cpu")
    recorded = json.loads(recording.metadata.get("settings", "[]")) if profile is None else []
    return Pipeline.from_profile(name, device=device, settings=[*recorded, *settings], workers=workers)


def changed_files(recording: Recording, pipeline: Pipeline) -> list[str]:
    """Names of the configuration files that are not what they were when the recording was made."""
    return [
        file.name
        for file in pipeline.files
        if recording.attachments.get(file.name, file.read_bytes()) != file.read_bytes()
    ]


def replay_recording(
    path: Path,
    *,
    profile: str | None = None,
    device: str | None = None,
    settings: Sequence[str] = (),
    workers: Sequence[int] = (),
) -> Iterator[tuple[int | None, ReplayResult, list[str]]]:
    """Runs the components again on the recorded source topics and compares every commit with the recording.

    Args:
        path: The recording.
        profile: What runs; by default the profile and the settings that were recorded.
        device: Compute device in place of the profile's.
        settings: Further changes by dotted key, as texts `key=value`.
        workers: Run it once with each of these numbers of engine workers and frames in flight; by default once, as
            the modules say.

    Yields:
        The number of workers, the result, and the names of configuration files that have changed since.

    Raises:
        ConfigError: The profile cannot be used, or reads topics that are not in the recording.
        SourceError: The recording cannot be read.
    """
    recording = Recording(path)
    for number in workers or (None,):
        with _pipeline_of(recording, profile, device, settings, number) as pipeline:
            result = Replay(recording, pipeline.take_process(offline=True)).run()
            yield number, result, changed_files(recording, pipeline)


def replay_lines(workers: int | None, result: ReplayResult, changed: Sequence[str]) -> list[str]:
    """What a replay gave, to read."""
    who = "as configured" if workers is None else f"{workers} workers"
    fed = ", ".join(f"{count} of {topic}" for topic, count in sorted(result.fed.items())) or "nothing"
    lines = [f"{who}: given {fed}"]
    lines += [f"  {name} is not what it was when the recording was made" for name in changed]
    lines += [
        f"  {topic}: its message has other fields than when the recording was made; compared with those of today"
        for topic in result.other_fields
    ]
    lines += [f"  {topic}: {count} commits equal" for topic, count in sorted(result.equal.items())]
    lines += [f"  {d.topic} at {d.version} (epoch {d.epoch}): {d.what}" for d in result.differences[:_SHOWN]]
    if result.different > _SHOWN:
        lines.append(f"  … and {result.different - _SHOWN} more")
    if result.broken:
        lines.append(f"  the recording was read up to its break: {result.broken}")
    if result.hung:
        lines.append(f"  the replay hung: {result.hung}")
    if result.good:
        lines.append(f"  bit-exact: all {result.equal.total()} commits have the recorded hashes")
    else:
        lines.append(f"  NOT bit-exact: {result.different} differences, {result.equal.total()} commits equal")
    return lines


def _held_by(recording: Recording) -> dict[str, dict[int, tuple[int, int]]]:
    """The topics of which values are in a recording; of each, by epoch, the lowest and the highest version."""
    held: dict[str, dict[int, tuple[int, int]]] = {}
    for event in recording:
        if event.payload is not None:
            versions = held.setdefault(event.topic, {})
            first, last = versions.get(event.epoch, (event.version, event.version))
            versions[event.epoch] = min(first, event.version), max(last, event.version)
    return dict(sorted(held.items()))


def _first_epoch(held: Iterable[Mapping[int, tuple[int, int]]]) -> tuple[int, int]:
    """The lowest and the highest version of some topics in the first epoch that one of them has."""
    spans = list(held)
    first = min((epoch for span in spans for epoch in span), default=0)
    within = [span[first] for span in spans if first in span]
    return min((low for low, _ in within), default=0), max((high for _, high in within), default=0)


@dataclass
class PlaySummary:
    """What was played."""

    published: dict[str, int]
    """Commits, by topic."""
    skipped: dict[str, int]
    """Commits that could not be, as the recording keeps their hashes alone."""
    seconds: float
    broken: str | None
    recorded: RecordSummary | None = None


def play_recording(
    path: Path,
    *,
    profile: str | None = None,
    device: str | None = None,
    settings: Sequence[str] = (),
    topics: Sequence[str] = (),
    rate: float | None = 1.0,
    seek: float = 0.0,
    loops: int | None = 1,
    record: Path | None = None,
    on_event: Callable[[RecordedEvent], bool] = lambda event: True,
) -> PlaySummary:
    """Publishes a recording; with a profile its modules run on what is published.

    Args:
        path: The recording.
        profile: Its modules get the topics that none of them produces; None: the topics are published to nobody.
        device: Compute device in place of the profile's.
        settings: Changes by dotted key, as texts `key=value`.
        topics: What to publish; by default all that nobody else produces.
        rate: Speed, > 0; None: as fast as the modules take it, which then lose nothing.
        seek: Where to begin [s], after the lowest version of the first epoch, whichever topics of it are played.
        loops: How often; None: until interrupted.
        record: Record all topics, those of the modules too, into this file.
        on_event: Called before each event is published; False ends the playing.

    Raises:
        ConfigError: The profile or a topic makes no sense.
        SourceError: The recording cannot be read.
        SinkError: The new recording cannot be created.
    """
    if profile is None and (settings or device is not None):
        what = "--set" if settings else "--device"
        raise ConfigError(f"{what} changes nothing without --profile: a recording alone is published as it is")
    recording = Recording(path)
    held = _held_by(recording)
    with ExitStack() as stack:
        mesh, process, pipeline = DataMesh(), None, None
        if profile is not None:
            pipeline = stack.enter_context(Pipeline.from_profile(profile, device=device, settings=settings))
            process = pipeline.take_process(offline=rate is None)
            mesh = process.mesh
        produced = produced_topics(process) if process is not None else set()
        for topic in topics:
            if topic not in held or topic in produced:
                why = "a module produces it" if topic in produced else f"it holds {', '.join(held) or 'nothing'}"
                raise ConfigError(f"{path}: topic {topic!r} cannot be played: {why}")
        playable = [topic for topic in held if topic not in produced and not topic.startswith("warploom/")]
        played = list(topics) or playable
        beginning, end = _first_epoch([held[topic] for topic in playable])
        if playable and end - beginning < seek * 1e9:
            span = (end - beginning) / 1e9
            raise ConfigError(f"{path}: --seek {seek:g} is beyond its end, {span:.2f} s after its beginning")
        drain = Drain(process, played) if process is not None else None
        recorder = None
        if record is not None:
            if record.exists() and record.samefile(path):
                raise ConfigError(f"{record}: a recording cannot be recorded into itself")
            recorder = (
                recorder_for(pipeline, record, source=str(path), settings=settings) if pipeline else Recorder(record)
            )
            stack.push(recorder)
            if process is not None and pipeline is not None:
                _record(recorder, process, pipeline, {*played, *all_topics(process)})
            else:
                recorder.watch(mesh, played)
        player = Player(
            recording,
            mesh,
            played,
            rate=rate,
            seek=seek,
            beginning=beginning,
            loops=loops,
            before_epoch=drain.wait if drain is not None else lambda: None,
            on_event=on_event,
        )
        started = time.perf_counter()
        if process is not None:
            process.start()
        try:
            player.play()
        finally:
            if process is not None:
                process.stop()
        seconds = time.perf_counter() - started
        summary = PlaySummary(dict(player.published), dict(player.skipped), seconds, recording.broken)
        if recorder is not None and record is not None:
            recorder.close()
            summary.recorded = RecordSummary(
                record, player.published.get(LIDAR_TOPIC, 0), recorder.written, dict(recorder.dropped),
                recorder.failure, mesh.losses.as_dict(),
            )  # fmt: skip
    return summary
