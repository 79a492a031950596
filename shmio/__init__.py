"""shmio: shared-memory I/O for digital twins of multi-robot cells.

Programs on the same host start with :func:`attach`, others with :func:`connect`; both return a
:class:`Cell`. :func:`open_dump` reads recordings.
"""

from __future__ import annotations

from shmio.version import __version__

TYPE_CHECKING = False  # importing typing takes 10 ms, in which Ctrl-C prints a traceback
if TYPE_CHECKING:
    from typing import Any

    from shmio.client import connect
    from shmio.local.attach import attach
    from shmio.model.cell import Cell
    from shmio.recording.dump import open_dump

__all__ = ["Cell", "__version__", "attach", "connect", "open_dump"]


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, because most processes of an instance need none."""
    if name == "attach":
        from shmio.local.attach import attach  # noqa: PLC0415

        return attach
    if name == "connect":
        from shmio.client import connect  # noqa: PLC0415

        return connect
    if name == "Cell":
        from shmio.model.cell import Cell  # noqa: PLC0415

        return Cell
    if name == "open_dump":
        from shmio.recording.dump import open_dump  # noqa: PLC0415

        return open_dump
    raise AttributeError(f"module 'shmio' has no attribute {name!r}")
