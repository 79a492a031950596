"""shmio: shared-memory I/O for digital twins of multi-robot cells.

Programs on the same host start with :func:`attach`, others with :func:`connect`; both return a
:class:`Cell`. :func:`open_dump` reads recordings.
"""

from __future__ import annotations

import importlib

from shmio.version import __version__

TYPE_CHECKING = False  # importing typing takes 10 ms, in which Ctrl-C prints a traceback
if TYPE_CHECKING:
    from typing import Any

    from shmio.client import connect
    from shmio.local.attach import attach
    from shmio.model.cell import Cell
    from shmio.recording.dump import open_dump

_MODULES = {
    "Cell": "shmio.model.cell",
    "attach": "shmio.local.attach",
    "connect": "shmio.client",
    "open_dump": "shmio.recording.dump",
}
"""The module that defines each public name."""

__all__ = ["Cell", "__version__", "attach", "connect", "open_dump"]


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, because most processes of an instance need none."""
    module = _MODULES.get(name)
    if module is None:
        raise AttributeError(f"module 'shmio' has no attribute {name!r}")
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name is None or not module.startswith(error.name):
            raise
        raise ImportError(f"shmio.{name} is not part of shmio-client; run pip install shmio, on Linux") from None
