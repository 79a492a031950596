"""Every error shmio raises on purpose, with one root.

::

    ShmioError
    ├── ConfigError        the configuration is wrong; names the key
    ├── LayoutError        a data-block source is wrong; carries diagnostics with file, line, column
    ├── ValueRangeError    a value does not fit its register's type
    ├── PathError          no such source or register
    ├── ConflictError      a name is in use for something else
    ├── WrongInstanceError the running instance of this name was started from another configuration file
    ├── SegmentError       the shared memory cannot be used
    │   ├── NotRunningError      no running instance of that name
    │   │   └── UnfinishedError      its segment is just being made, or its maker died
    │   ├── AlreadyRunningError  another supervisor holds the instance
    │   └── FormatError          the segment's format is not one this version knows
    ├── CommandError       a command cannot be sent to its source, or was not carried out
    ├── TimeError          time cannot be moved, or a step failed
    ├── QualityError       the value exists but is not good
    ├── ConnectorError     the device did not answer as it should; carries a reason code
    ├── ModelError         a simulation model is declared wrongly, or its code failed; names it, and the line
    ├── RecordingError     a recording cannot be written, or is none that this version can read
    ├── MissingLibraryError  an optional library is not installed; names the command that does it
    ├── EndpointError      an address cannot be served
    ├── RemoteError        an instance cannot be reached by gRPC, or does not answer as it should
    │   ├── LostError            nothing serves there at present; it may come back
    │   └── UnknownClientError   it wants to know who asks
    └── ControlError       the supervisor refused or did not answer
        └── UnreachableError     its socket cannot be connected to

The command-line tools print the message of any of these as one line and exit with status 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shmio.layout.model import Diagnostic


class ShmioError(Exception):
    """Root of all errors that shmio raises on purpose."""


class ConfigError(ShmioError):
    """The configuration cannot be used; the message names the full key and the remedy."""


class LayoutError(ShmioError):
    """A layout source cannot be compiled; ``str()`` is one line for each diagnostic.

    ``diagnostics`` holds them as objects with file, line and column, warnings included; it is empty when the
    error is not about a source text.
    """

    def __init__(self, message: str, diagnostics: Sequence[Diagnostic] = ()) -> None:
        super().__init__(message)
        self.diagnostics = tuple(diagnostics)

    def __reduce__(self) -> tuple[type[LayoutError], tuple[str, tuple[Diagnostic, ...]]]:
        return type(self), (str(self), self.diagnostics)


class ValueRangeError(ShmioError, ValueError):
    """A value does not fit the type of its register."""


class PathError(ShmioError, LookupError):
    """No source or register has this path."""


class ConflictError(ShmioError):
    """A name, such as a shadow's path, is in use for something else."""


class WrongInstanceError(ShmioError):
    """An instance of this name runs, but not from the given configuration file; the message has both paths."""


class SegmentError(ShmioError):
    """The shared-memory segment cannot be created, opened or used."""


class NotRunningError(SegmentError):
    """No running instance has this name."""


class UnfinishedError(NotRunningError):
    """The instance's segment is just being made, or its maker died before it was whole."""


class AlreadyRunningError(SegmentError):
    """Another supervisor holds this instance; the message has its pid."""


class FormatError(SegmentError):
    """The segment's magic, ABI version or structure is not one this version knows."""


class CommandError(ShmioError):
    """A command cannot be sent to its source, or the source or its device did not carry it out; says which and why."""


class TimeError(ShmioError):
    """Another program moves time, or a step failed; names who it is, or who did not answer, and why."""


class QualityError(ShmioError):
    """The register has no good value at present; the message gives the reason."""


class ConnectorError(ShmioError):
    """The device is absent or did not answer as the protocol demands.

    The base loop drops the connection on any of these. ``str()`` becomes the frame's reason text.
    """


class MissingLibraryError(ShmioError, ImportError):
    """An optional library is not installed; the message names the command that installs it."""


class EndpointError(ShmioError):
    """An address cannot be listened on, or its TLS files cannot be used."""


class ModelError(ShmioError):
    """A simulation model is declared wrongly, or its code failed; the message has the model's name, and the line."""


class RemoteError(ShmioError):
    """An instance's endpoint cannot be reached, does not let us in, or does not answer as it should; names it."""


class LostError(RemoteError):
    """Nothing serves at this address, or the connection to it was lost; it may come back."""


class UnknownClientError(RemoteError):
    """The endpoint wants a token, and was shown none, or one that it does not know."""


class RecordingError(ShmioError):
    """A recording cannot be written, or a file is no recording that this version can read; names the file."""


class ControlError(ShmioError):
    """The supervisor refused a control request or did not answer it."""


class UnreachableError(ControlError):
    """The supervisor's control socket cannot be connected to."""
