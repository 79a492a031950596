"""shmio: shared-memory I/O for digital twins of multi-robot cells.

Programs on the same host start with :func:`attach`; :func:`open_dump` reads recordings.
"""

from __future__ import annotations

from shmio.version import __version__

TYPE_CHECKING = False  # typing's own costs every command 10 ms, in which Ctrl-C would print a traceback
if TYPE_CHECKING:
    from typing import Any

    from shmio.local.attach import attach
    from shmio.recording.dump import open_dump

__all__ = ["__version__", "attach", "open_dump"]


def __getattr__(name: str) -> Any:
    """Import a public function on first use: most processes of an instance need neither."""
    if name == "attach":
        from shmio.local.attach import attach  # noqa: PLC0415

        return attach
    if name == "open_dump":
        from shmio.recording.dump import open_dump  # noqa: PLC0415

        return open_dump
    raise AttributeError(f"module 'shmio' has no attribute {name!r}")
