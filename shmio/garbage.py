"""Garbage collection while a process starts, or a command makes its output.

The objects that a process creates at its start, such as modules, layouts and tables, live as long as
the process. The collector would go through all of them again and again, and free nothing.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


def pause() -> None:
    """Switch garbage collection off until :func:`resume`."""
    gc.disable()


def resume() -> None:
    """Switch garbage collection on again, except for all present objects; do nothing if it is on."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()


@contextmanager
def paused() -> Iterator[None]:
    """Switch garbage collection off during a ``with`` block. Objects created in it are collected later."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
