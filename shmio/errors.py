"""The errors that shmio raises on purpose, below one root class.

::

    ShmioError
    ├── ConfigError        the configuration is wrong; the message names the key
    │   └── DeclarationError     a declared injection is wrong; also a subclass of ValueRangeError
    ├── LayoutError        a layout source is wrong; ``diagnostics`` has file, line and column
    ├── ValueRangeError    a value does not fit its register's type
    │   └── CharacterError       the register's encoding lacks a character of the text
    ├── PathError          no such source or register
    ├── ConflictError      a name is in use for something else
    ├── WrongInstanceError the running instance of this name has another configuration file
    ├── SegmentError       the shared memory cannot be used
    │   ├── NotRunningError      no running instance of that name
    │   │   └── UnfinishedError      the segment is being created, or its creator died
    │   ├── AlreadyRunningError  the instance already has a supervisor
    │   └── FormatError          this version cannot read the segment's format
    ├── CommandError       a command cannot be sent to its source, or was not carried out
    │   ├── TimeError            the instance's clock cannot be moved, or a step failed
    │   └── SnapshotError        a snapshot cannot be saved or restored
    ├── QualityError       the quality of the value is bad
    ├── ConnectorError     the device did not answer as it should
    ├── ModelError         a simulation model is declared wrongly, or its code failed
    ├── RecordingError     a recording cannot be written, or this version cannot read it
    ├── MissingLibraryError  an optional library is not installed; the message has the command for it
    ├── EndpointError      an endpoint cannot use its address, or has reached a limit
    ├── RemoteError        an instance cannot be reached by gRPC, or does not answer as it should
    │   ├── LostError            nothing serves this address at present; also a subclass of NotRunningError
    │   └── UnknownClientError   the endpoint requires a token, and the client presented no valid one
    └── ControlError       the supervisor refused or did not answer
        └── UnreachableError     shmio cannot connect to the supervisor's socket

Some modules define further errors; those that can reach a program are subclasses of these. If a
program calls shmio wrongly, Python's own errors are possible too, such as TypeError.

The command-line tools print the message of any of these errors and exit with status 1. The exception
is ``shmio-campaign``, where 1 means that an expectation failed: it exits with 2 after ConfigError,
LayoutError, MissingLibraryError, PathError, SnapshotError and ValueRangeError, and with 3 after any
other error.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import msgspec


class ShmioError(Exception):
    """Root of the errors that shmio raises on purpose."""


class ConfigError(ShmioError):
    """The configuration cannot be used; the message names the full key and the remedy."""


class Diagnostic(msgspec.Struct, frozen=True):
    """An error or warning about a layout source.

    ``str()`` is ``file:line:column: severity: message``.
    """

    file: str
    line: int
    column: int
    message: str
    severity: Literal["error", "warning"] = "error"

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}: {self.severity}: {self.message}"


class LayoutError(ShmioError):
    """A layout source cannot be compiled; ``str()`` is one line for each diagnostic.

    ``diagnostics`` has errors and warnings as objects with file, line and column. It is empty if
    the error is not about a source text.
    """

    def __init__(self, message: str, diagnostics: Sequence[Diagnostic] = ()) -> None:
        super().__init__(message)
        self.diagnostics = tuple(diagnostics)

    def __reduce__(self) -> tuple[type[LayoutError], tuple[str, tuple[Diagnostic, ...]]]:
        return type(self), (str(self), self.diagnostics)


class ValueRangeError(ShmioError, ValueError):
    """A value does not fit the type of its register."""


class CharacterError(ValueRangeError):
    """The encoding of a register lacks a character of a text.

    Attributes:
        character: The character.
        place: Its place in the text; the first character has place 1.

    """

    def __init__(self, message: str, character: str = "", place: int = 0) -> None:
        super().__init__(message)
        self.character, self.place = character, place

    def __reduce__(self) -> tuple[type[CharacterError], tuple[str, str, int]]:
        return type(self), (str(self), self.character, self.place)


class DeclarationError(ConfigError, ValueRangeError):
    """A declared injection is wrong; the message names the key."""


class PathError(ShmioError, LookupError):
    """No source or register has this path."""


class ConflictError(ShmioError):
    """A name, such as a shadow's path, is already used for something else."""


class WrongInstanceError(ShmioError):
    """The running instance of this name has another configuration file; the message names both."""


class SegmentError(ShmioError):
    """The shared-memory segment cannot be created, opened or used."""


class NotRunningError(SegmentError):
    """No running instance has this name."""


class UnfinishedError(NotRunningError):
    """The instance's segment is incomplete: it is being created, or its creator died."""


class AlreadyRunningError(SegmentError):
    """The instance already has a supervisor; the message has its pid."""


class FormatError(SegmentError):
    """The segment has a magic number, ABI version or structure that this version cannot read."""


class CommandError(ShmioError):
    """A command could not be sent, or was not carried out by the source or its device.

    The message says what failed, and why.
    """


class TimeError(CommandError):
    """Another program controls the instance's clock, or a step failed.

    The message names that program, or the process that failed, and the reason.
    """


class SnapshotError(CommandError):
    """A snapshot cannot be saved or restored; the message names what prevents it."""


class QualityError(ShmioError):
    """The quality of a register or source is bad; the message gives the reason."""


class ConnectorError(ShmioError):
    """The device is absent or did not answer as the protocol demands.

    The poll loop then closes the connection. The reason of the next frame is the text of the error.
    """


class MissingLibraryError(ShmioError, ImportError):
    """An optional library is not installed; the message names the command that installs it."""


class EndpointError(ShmioError):
    """An endpoint cannot use its address or TLS files, or has reached its limit of clients."""


class ModelError(ShmioError):
    """A simulation model is declared wrongly, or its code failed; the message says where."""


class RemoteError(ShmioError):
    """An instance's endpoint is unreachable, refuses the client, or answers unexpectedly.

    The message names the endpoint.
    """


class LostError(RemoteError, NotRunningError):
    """Nothing serves this address, or the connection was lost; the instance may come back."""


class UnknownClientError(RemoteError):
    """The endpoint requires a token, and the client presented none or an unknown one."""


class RecordingError(ShmioError):
    """A recording cannot be written, or this version cannot read it; the message names the file."""


class ControlError(ShmioError):
    """The supervisor refused a control request or did not answer it."""


class UnreachableError(ControlError):
    """shmio cannot connect to the supervisor's control socket."""
