"""The replay source: its keys, and its recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import msgspec

from shmio.config.model import ReplayedInjections
from shmio.connectors.base import Replayed
from shmio.connectors.replay.recorded_source import RecordedSource
from shmio.connectors.replay.recording import Recording, Span
from shmio.errors import ConfigError, RecordingError
from shmio.layout.model import Layout
from shmio.segment.playhead import MAX_SPEED, MIN_SPEED

File = Annotated[str, msgspec.Meta(min_length=1)]


class Replay(Replayed):
    """``connector = "replay"``: plays one source of a recording.

    Nothing is written to any device.
    """

    class Options(msgspec.Struct, forbid_unknown_fields=True):
        """Its keys. With ``own_clock`` the whole instance has the clock of the recording."""

        file: File | Annotated[list[File], msgspec.Meta(min_length=1)]
        source: str | None = None
        start: float | str | None = None
        end: float | str | None = None
        speed: Annotated[float, msgspec.Meta(ge=MIN_SPEED, le=MAX_SPEED)] = 1.0
        loop: bool = False
        paused: bool = False
        injections: ReplayedInjections = "keep"
        own_clock: bool = False

    def __init__(self, options: Options, name: str) -> None:
        """Open the recording.

        Raises:
            ConfigError: It cannot be played. The message begins with the key.

        """
        self.options = options
        try:
            self.recording = Recording(files(options))
        except RecordingError as error:
            raise ConfigError(f"file: {error}") from None
        try:
            self.span, self.recorded = chosen(self.recording, options, name)
        except ConfigError:
            self.recording.close()
            raise

    @property
    def layout(self) -> Layout:
        """The layout of the recorded frames."""
        return self.recorded.block.layout

    @property
    def keep(self) -> bool:
        """Whether recorded injections are shown."""
        return self.options.injections == "keep"

    def close(self) -> None:
        """Close the files."""
        self.recording.close()


def files(options: Replay.Options) -> Sequence[str]:
    """Return the files of the recording."""
    return [options.file] if isinstance(options.file, str) else options.file


def chosen(recording: Recording, options: Replay.Options, name: str) -> tuple[Span, RecordedSource]:
    """Return the part to play, and the recorded source.

    Raises:
        ConfigError: There is nothing to play. The message begins with the key.

    """
    try:
        span = recording.span(options.start, options.end)
    except RecordingError as error:
        raise ConfigError(str(error)) from None
    try:
        return span, recording.recorded(options.source or name, span)
    except RecordingError as error:
        raise ConfigError(f"source: {error}") from None
