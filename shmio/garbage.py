"""Garbage collection while a process starts.

What a process creates at its start lives as long as the process: modules, layouts, tables. The
collector would go through all of it again and again, and find nothing.
"""

from __future__ import annotations

import gc


def pause() -> None:
    """Collect nothing until :func:`resume`."""
    gc.disable()


def resume() -> None:
    """Collect again, but only what is created from now on. Without :func:`pause`, do nothing."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()
