"""The journal of a search: a file with a JSON object on each line.

The first line describes the search; the others have the results of trials, and stored cases. A
search that was interrupted at any moment can continue from this file. If the last line is incomplete,
it is dropped.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Self

import msgspec

from shmio.errors import ConfigError, RecordingError
from shmio.falsification.trial import Result

NAME: Final = "trials.jsonl"
MAX_LINE_BYTES: Final = 1 << 24


class Beginning(msgspec.Struct):
    """Everything that determines the trials of a search, except their number.

    Attributes:
        shmio: Version of shmio.
        search: Name of the strategy.
        seed: Seed of the strategy.
        jobs: Number of trials that run at once.
        grid: Number of values of each range, if the search is on a grid; else None.
        campaign: The campaign's tables, with their ranges.
        duration_s: Duration of a trial on the instance's clock, in s.
        step_ms: Length of a step, in ms; None: the shortest period of a source.
        files: Digests of everything else that the trials depend on, by label.

    """

    shmio: str
    search: str
    seed: int
    jobs: int
    grid: list[int] | None
    campaign: dict[str, Any]
    duration_s: float
    step_ms: float | None
    files: dict[str, str]


class Line(msgspec.Struct, omit_defaults=True):
    """A line after the first: either the result of a trial, or a stored case.

    Attributes:
        point: For a result, the point of the trial.
        result: For a result, the result of the trial.
        case: For a case, the name of its folder.
        trial: For a case, the number of the trial that was shrunk to it.
        shrunk: For a case, what it consists of, to recognise the same case again.

    """

    point: dict[str, Any] | None = None
    result: Result | None = None
    case: str | None = None
    trial: int | None = None
    shrunk: dict[str, Any] | None = None


class Journal:
    """The journal of a search, open for writing. Only one search at a time can have a file open."""

    def __init__(self, folder: Path, beginning: Beginning, *, resume: bool) -> None:
        """Create the file, or open an existing one to go on.

        Args:
            folder: Folder of the search; it is created.
            beginning: The beginning of this search.
            resume: Whether to go on with a search.

        Raises:
            ConfigError: There is a search already, there is none to go on with, it began in another
                way, another process has it open, or the folder cannot be used.
            RecordingError: The file cannot be written.

        """
        self.file = folder / NAME
        try:
            if folder.exists() and not folder.is_dir():
                raise ConfigError(f"-o {folder}: this is a file; name a new or an empty folder")
            if resume and not self.file.exists():
                raise ConfigError(f"--resume: {self.file} does not exist: there is no search to continue")
            folder.mkdir(parents=True, exist_ok=True)
            if not self.file.exists() and any(folder.iterdir()):
                raise ConfigError(f"-o {folder}: this folder has other files; give a new or an empty folder")
            self._fd = os.open(self.file, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise ConfigError(f"-o {folder}: {error.filename or self.file}: {error.strerror}") from None
        try:
            self._lock()
            self._begin(beginning, resume=resume)
        except BaseException:
            os.close(self._fd)
            raise

    def _lock(self) -> None:
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"{self.file}: another search is using this file; wait for its end, or give another folder with -o"
            ) from None

    def _begin(self, beginning: Beginning, *, resume: bool) -> None:
        lines = self._complete()
        first = next(lines, b"")
        if first and not resume:
            raise ConfigError(
                f"{self.file}: this file has a search already; continue with --resume, or give another folder with -o"
            )
        if not first:
            self._append(msgspec.json.encode(beginning))
            return
        try:
            before = msgspec.json.decode(first, type=Beginning)
        except msgspec.DecodeError as error:
            raise ConfigError(f"{self.file}: it is not the file of a search: {error}") from None
        for what in differences(msgspec.to_builtins(before), msgspec.to_builtins(beginning)):
            raise ConfigError(f"--resume: {what}; undo the change, or begin a new search in another folder with -o")

    def _complete(self) -> Iterator[bytes]:
        """Yield the complete lines. Cut off one that was not written to its end."""
        end = 0
        with open(self._fd, "rb", closefd=False) as stream:
            stream.seek(0)
            while (line := stream.readline(MAX_LINE_BYTES)).endswith(b"\n"):
                end += len(line)
                yield line
        os.ftruncate(self._fd, end)

    def lines(self) -> Iterator[Line]:
        """Yield the lines after the first line: results and cases.

        Raises:
            ConfigError: A line is damaged.

        """
        for number, line in enumerate(self._complete(), 1):
            if number > 1:
                try:
                    yield msgspec.json.decode(line, type=Line)
                except msgspec.DecodeError as error:
                    raise ConfigError(f"{self.file}:{number}: this line is damaged: {error}") from None

    def add(self, line: Line) -> None:
        """Write a line.

        Raises:
            RecordingError: The line cannot be written.

        """
        self._append(msgspec.json.encode(line))

    def _append(self, line: bytes) -> None:
        data = line + b"\n"
        try:
            while data:
                data = data[os.write(self._fd, data) :]
        except OSError as error:
            raise RecordingError(
                f"{self.file}: {error.strerror}: the search stops here; make room, and continue with --resume"
            ) from None

    def close(self) -> None:
        """Close the file, so that another search can open it."""
        os.close(self._fd)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def differences(before: Any, now: Any, key: str = "") -> Iterator[str]:
    """Yield a text for each key whose value differs between ``before`` and ``now``, which have the key ``key``."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for name in {**before, **now}:
            inner = f"{key}.{name}".lstrip(".")
            yield from differences(before.get(name), now.get(name), inner)
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for index, (one, other) in enumerate(zip(before, now, strict=True)):
            yield from differences(one, other, f"{key}[{index}]")
    elif before != now:
        yield f"{key} is {_short(now)}, but was {_short(before)} when the search began"


def _short(value: Any) -> str:
    text = "not given" if value is None else msgspec.json.encode(value).decode()
    return text if len(text) <= 100 else f"{text[:97]}…"
