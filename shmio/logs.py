"""Logging: the formats of lines, rotating files, and a rate limit for each kind of record.

A record is one line with the name of the process; extra fields follow as ``key=value``::

    2026-11-21T05:20:01.123456Z INFO    cell[1234] quality good source=cell cycle=1207

With ``[instance] log_format = "json"`` the line is a JSON object with the same fields.
"""

from __future__ import annotations

import json
import logging
import logging.handlers
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from shmio.errors import ConfigError
from shmio.times import utc_text
from shmio.wording import printable

if TYPE_CHECKING:
    import asyncio

MAX_FILE_BYTES = 5_000_000
KEPT_FILES = 3


class LineFormatter(logging.Formatter):
    """Formats a record as one line, followed by the record's traceback, indented, if there is one.

    Control characters in the line are escaped.
    """

    def __init__(self, process: str, source: str | None) -> None:
        super().__init__()
        self._process = f"{process}[{os.getpid()}]"
        self._always = {} if source is None else {"source": source}

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's line, with its traceback if there is one."""
        fields = self._always | getattr(record, "fields", {})
        message = printable(with_fields(record.getMessage(), fields))
        line = f"{utc_text(record.created)} {record.levelname:<7} {self._process} {message}"
        if record.exc_info:
            line += "\n    " + self.formatException(record.exc_info).replace("\n", "\n    ")
        return line


class JsonFormatter(logging.Formatter):
    """Formats a record as a JSON object in one line."""

    def __init__(self, process: str, source: str | None) -> None:
        super().__init__()
        self._process = process
        self._always = {} if source is None else {"source": source}

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's line."""
        fields = self._always | getattr(record, "fields", {})
        line = {
            "time": utc_text(record.created),  # first, as in a line of text: a reader sorts by it
            "level": record.levelname,
            "process": self._process,
            "pid": os.getpid(),
            "message": record.getMessage(),
            "fields": {key: _plain(value) for key, value in fields.items()},
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line)  # all characters as ASCII, whatever a device has sent


def _plain(value: object) -> object:
    """Return a number, a bool or a text unchanged; return any other value as text."""
    if isinstance(value, (bool, str)) or type(value) is int or (type(value) is float and math.isfinite(value)):
        return value
    return str(value)


FORMATTERS: Final[Mapping[str, Callable[[str, str | None], logging.Formatter]]] = {
    "text": LineFormatter,
    "json": JsonFormatter,
}
"""The class of the formatter for each value of ``[instance] log_format``."""


class RotatingLog(logging.handlers.RotatingFileHandler):
    """A rotating log file.

    With ``streams``, standard output and standard error always go to the newest file.
    """

    def __init__(self, file: Path, *, streams: bool, patient: bool) -> None:
        """Open the file.

        If that fails, raise OSError, or with ``patient`` try again at each record.
        """
        self._streams = False  # the caller redirects the streams to the first file
        super().__init__(file, maxBytes=MAX_FILE_BYTES, backupCount=KEPT_FILES - 1, delay=True)
        try:
            self.stream = self._open()
        except OSError:
            if not patient:
                raise
        self._streams = streams

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record; create the file again if somebody removed it."""
        with suppress(OSError):
            if self._removed():
                Path(self.baseFilename).parent.mkdir(parents=True, exist_ok=True)
                self.close()
                self.stream = self._open()
        super().emit(record)

    def _removed(self) -> bool:
        try:
            there = Path(self.baseFilename).stat()
        except FileNotFoundError:
            return True
        return self.stream is not None and not os.path.samestat(there, os.fstat(self.stream.fileno()))

    def _open(self) -> TextIOWrapper:
        """Open a new file and redirect standard output and error to it.

        Otherwise, the traceback of a crash would go to a removed file.
        """
        stream = super()._open()
        if self._streams:
            os.dup2(stream.fileno(), 1)
            os.dup2(stream.fileno(), 2)
        return stream


def setup(
    file: Path,
    process: str,
    *,
    source: str | None = None,
    form: str = "text",
    console: bool = False,
    streams: bool = False,
    patient: bool = False,
) -> logging.Logger:
    """Send this process's records to ``file``, rotated at 5 MB with 3 files kept.

    Args:
        file: The log file.
        process: The process name in each line.
        source: The source name in each line; None for a process that serves no single source.
        form: Format of the lines: ``text`` or ``json``.
        console: True to write records to standard error as well.
        streams: True if standard output and error go to this file. They are redirected to each new file.
        patient: True to try again later if the file cannot be written, instead of raising ConfigError.

    Returns:
        The logger named ``shmio``.

    Raises:
        ConfigError: The file cannot be written.

    """
    try:
        with suppress(OSError) if patient else nullcontext():
            file.parent.mkdir(parents=True, exist_ok=True)
        handlers: list[logging.Handler] = [RotatingLog(file, streams=streams, patient=patient)]
    except OSError as error:
        raise ConfigError(f"instance.log_dir: cannot write {file}: {error.strerror}") from None
    if console:
        handlers.append(logging.StreamHandler(sys.stderr))
    root = logging.getLogger()
    for old in root.handlers[:]:
        root.removeHandler(old)
        old.close()
    for handler in handlers:
        handler.setFormatter(FORMATTERS[form](process, source))
        root.addHandler(handler)
    root.setLevel(logging.INFO)
    logging.captureWarnings(True)
    logging.raiseExceptions = False  # a full disk must not stop the process that logs
    return logging.getLogger("shmio")


def fields(**values: object) -> dict[str, dict[str, object]]:
    """Return extra fields for a record: ``log.info("connected", extra=fields(pdu=960))``."""
    return {"fields": values}


def with_fields(message: str, fields: Mapping[str, object]) -> str:
    """Return a message followed by its extra fields, as ``key=value``."""
    return " ".join([message, *(f"{key}={value}" for key, value in fields.items())])


def log_loop_errors(loop: asyncio.AbstractEventLoop) -> None:
    """Have an event loop log errors of the operating system in one line, without a traceback.

    If no descriptor is free, for example, asyncio accepts no connection for a second, and then tries again.
    """
    loop.set_exception_handler(_log_loop_error)


def _log_loop_error(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    if isinstance(error := context.get("exception"), OSError):
        logging.getLogger("asyncio").error("%s: %s", context["message"], error)
    else:
        loop.default_exception_handler(context)


MAX_LINES: Final = 20
"""Maximum number of records of one kind that :class:`LogRateLimit` passes in an interval."""
TURN_S: Final = 10.0
"""Length of an interval of :class:`LogRateLimit`, in s."""


class LogRateLimit(logging.Filter):
    """Limits the records of each kind, so that no client can fill the log. Any thread may use it.

    Records with the same unformatted text are of one kind. After more than ``MAX_LINES`` of them in
    an interval, the next record that is written says how many were left out. If no other one comes,
    that is the last of those left out: see :meth:`write_last`.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic, *, one_kind: bool = False) -> None:
        """Create the filter.

        With ``one_kind``, all records are of one kind. Use it for loggers of other libraries.
        """
        super().__init__()
        self._clock_s = clock_s
        self._one_kind = one_kind
        self._kinds: dict[str, tuple[float, int]] = {}
        """End of the present interval, and number of records in it, for each kind."""
        self._last: dict[str, logging.LogRecord] = {}
        """The last record of each kind, if it was left out. It may say what is the case since then."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to write the record."""
        now_s, text = self._clock_s(), str(record.msg)
        kind = "" if self._one_kind else text
        until_s, count = self._kinds.get(kind, (0.0, 0))
        if now_s < until_s:
            self._kinds[kind] = until_s, count + 1
            if count >= MAX_LINES:
                self._last[kind] = record
            return count < MAX_LINES
        self._kinds[kind] = now_s + TURN_S, 1
        self._last.pop(kind, None)
        if count > MAX_LINES:
            record.msg = f"{text} ({count - MAX_LINES} similar lines before this one were left out)"
        return True

    def write_last(self, log: logging.Logger) -> None:
        """Write the last record of each kind, if it was left out and its interval is over."""
        for kind in list(self._last):
            until_s, count = self._kinds[kind]
            if self._clock_s() >= until_s and (record := self._last.pop(kind, None)) is not None:
                self._kinds[kind] = until_s, count - 1
                log.handle(record)  # through this filter, which begins the next interval


_limits: Final[list[tuple[logging.Logger, LogRateLimit]]] = []
"""The limits of :func:`rate_limited` that are in effect."""


def write_left_out() -> None:
    """Write the last line of each kind that :func:`rate_limited` has left out. Call this about once a second.

    Otherwise, the log of a source whose quality has often changed would not end with its present quality.
    """
    for log, limit in _limits:
        limit.write_last(log)


@contextmanager
def rate_limited(*loggers: str) -> Iterator[None]:
    """Limit the rate of the lines that clients and devices can cause, by a :class:`LogRateLimit` for each logger.

    All lines of another library's logger are of one kind.

    Args:
        loggers: The names of the loggers.

    """
    limits = [(logging.getLogger(name), LogRateLimit(one_kind=not name.startswith("shmio."))) for name in loggers]
    for log, limit in limits:
        log.addFilter(limit)
    _limits.extend(limits)
    try:
        yield
    finally:
        _limits[:] = [one for one in _limits if one not in limits]
        for log, limit in limits:
            log.removeFilter(limit)
