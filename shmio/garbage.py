"""Garbage collection while a process starts.

The objects that a process creates at its start, such as modules, layouts and tables, live as long as
the process. The collector would go through all of them again and again, and free nothing.
"""

from __future__ import annotations

import gc


def pause() -> None:
    """Switch garbage collection off until :func:`resume`."""
    gc.disable()


def resume() -> None:
    """Switch garbage collection on again, except for all present objects; do nothing if it is on."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()
