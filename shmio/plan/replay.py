"""Implements the mode ``replay``: replaces the sources in a configuration by those of a recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from shmio.config import RESERVED_SOURCES, Config, Mqtt, MqttTopic, Source
from shmio.config.model import NAME_RULE, Replay
from shmio.config.read import SECTION_PROCESSES, convert
from shmio.errors import ConfigError, RecordingError
from shmio.segment import Origin

if TYPE_CHECKING:
    from shmio.connectors.replay.recording import Recording

LEAD_NS: Final = 2_000_000_000
"""Time in ns by which the instance's clock starts before the start of the recording, if possible.

In this time, the processes start.
"""


class Replayed(NamedTuple):
    """A configuration that was changed for the mode ``replay``."""

    config: Config
    origin: Origin
    notices: list[str]
    """Lines that say what was removed from the configuration or added to it."""


class Recordings:
    """Opens the recordings that a configuration plays.

    The last recording stays open until another is needed, so that consecutive sources with the same
    recording share it. Use an object as a context manager.
    """

    def __init__(self) -> None:
        self._files: Sequence[str] = ()
        self._recording: Recording | None = None

    def get(self, files: Sequence[str]) -> Recording:
        """Return the recording in these files. The next call may close this recording.

        Raises:
            RecordingError: The recording cannot be opened.

        """
        from shmio.connectors.replay.recording import Recording  # noqa: PLC0415  most configurations play none

        if self._recording is None or files != self._files:
            self.close()
            self._recording, self._files = Recording(files), files
        return self._recording

    def close(self) -> None:
        """Close the open recording, if any."""
        if self._recording is not None:
            self._recording.close()
            self._recording = None

    def __enter__(self) -> Recordings:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def replayed(config: Config, keys: Mapping[str, Any], recordings: Recordings) -> Replayed:
    """Return the configuration with the recording's sources instead of its own.

    Raises:
        ConfigError: The recording cannot be played; the message begins with the key.

    """
    section = _section(config, keys)
    files = [str(config.path(file)) for file in _listed(section.file)]
    if not files:
        raise ConfigError(
            'replay.file: name the recording to play, by --from FILE.mem or by file = "FILE.mem" in [replay]'
        )
    try:
        recording = recordings.get(files)
    except RecordingError as error:
        raise ConfigError(f"replay.file: {error}") from None
    try:
        span = recording.span(section.start, section.end)
    except RecordingError as error:
        raise ConfigError(f"replay.{error}") from None
    names = recording.sources
    _check_names(names, files[0])
    notices = list(_notices(config, section, names))
    there = {source.name: source for source in config.source}
    order = [*(name for name in there if name in names), *(name for name in names if name not in there)]
    sources = [_source(name, there.get(name), section, files) for name in order]
    grpc = config.grpc
    if grpc is not None and grpc.default_source not in (None, *names):
        grpc = msgspec.structs.replace(grpc, default_source=None)
    changed = msgspec.structs.replace(
        config,
        source=sources,
        emulator=[],
        injection=[] if section.injections == "keep" else config.injection,
        recorder=config.recorder if section.record else None,
        grpc=grpc,
        mqtt=_mqtt(config, names),
    )
    lead_ns = 0 if config.instance.clock == "stepped" else LEAD_NS
    return Replayed(changed, Origin(max(0, span.begin_ns - lead_ns), recording.utc_ns), notices)


def _section(config: Config, keys: Mapping[str, Any]) -> Replay:
    section = msgspec.to_builtins(config.replay or Replay())
    whole = convert(msgspec.to_builtins(config) | {"replay": section | dict(keys)}, Config)
    return whole.replay or Replay()


def _notices(config: Config, section: Replay, names: list[str]) -> Iterator[str]:
    own = [source.name for source in config.source]
    for name in own:
        if name not in names:
            yield f"source {name} is left out: the recording does not contain it; it contains {', '.join(names)}"
    for emulator in config.emulator:
        yield f"emulator {emulator.name} is left out: a replay reads no device"
    if config.injection and section.injections == "keep":
        yield (
            "the configuration's injections are left out: those of the recording are kept; "
            'replay.injections = "leave out" does the opposite'
        )
    if config.grpc and config.grpc.default_source not in (None, *names):
        yield f"grpc.default_source is left out: the recording has no source {config.grpc.default_source}"
    for index, rule in enumerate(config.mqtt.topic if config.mqtt else ()):
        for name in _gone(config, rule, names):
            yield f"mqtt.topic[{index}].match: {name} is left out: the recording has no such source"
    if section.record and config.recorder is None:
        raise ConfigError("replay.record: this needs a [recorder] section, which says where to record")
    wanted = config.recorder.sources if section.record and config.recorder else []
    if wanted and not set(wanted) & set(names):
        raise ConfigError(
            f"replay.record: nothing would be recorded: the recording has {', '.join(names)}, but recorder.sources "
            f"names only {', '.join(wanted)}"
        )


def _mqtt(config: Config, names: list[str]) -> Mqtt | None:
    """Return ``[mqtt]`` without rules for frames of omitted sources."""
    if config.mqtt is None:
        return None
    rules = []
    for rule in config.mqtt.topic:
        gone = _gone(config, rule, names)
        match = [pattern for pattern in rule.patterns if pattern not in gone]
        if match:
            rules.append(msgspec.structs.replace(rule, match=match) if gone else rule)
    return msgspec.structs.replace(config.mqtt, topic=rules)


def _gone(config: Config, rule: MqttTopic, names: list[str]) -> list[str]:
    """Return the configured sources that a rule for frames names and the recording lacks."""
    own = {source.name for source in config.source} - set(names)
    return [pattern for pattern in rule.patterns if rule.payload == "frames" and pattern in own]


def _source(name: str, own: Source | None, section: Replay, files: list[str]) -> Source:
    keys = ("start", "end", "speed", "loop", "paused", "injections")
    options = {key: getattr(section, key) for key in keys}
    return Source(
        name=name,
        connector="replay",
        writable=own.writable if own else [],
        allow_nonfinite=own.allow_nonfinite if own else (),
        realtime_priority=own.realtime_priority if own else None,
        options={"file": files, "source": name, "own_clock": True, **options},
    )


def _check_names(names: list[str], file: str) -> None:
    """Check the names of the sources in a recording.

    Raises:
        ConfigError: A name is invalid or reserved.

    """
    for name in names:
        try:
            msgspec.convert({"name": name, "connector": "replay"}, Source)
        except msgspec.ValidationError:
            raise ConfigError(
                f"replay.file: {file} has a source {name!r}, which is not a valid name: {NAME_RULE}"
            ) from None
        if name.lower() in RESERVED_SOURCES | SECTION_PROCESSES:
            raise ConfigError(f"replay.file: {file} has a source {name!r}, and that name is reserved")


def _listed(value: str | list[str] | None) -> list[str]:
    return [value] if isinstance(value, str) else value or []
