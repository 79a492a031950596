"""Explains in one line what went wrong in a model's code."""

from __future__ import annotations

import traceback
from pathlib import Path

from shmio.errors import ShmioError
from shmio.layout.topic import shorten
from shmio.logs import printable


def explain(error: BaseException, module: str) -> str:
    """Return what was raised and at which line, preferring a line of the module."""
    if isinstance(error, SyntaxError) and error.filename:
        return _line(f"{error.msg} ({Path(error.filename).name}, line {error.lineno})")
    frames = list(traceback.walk_tb(error.__traceback__))
    own = [place for place in frames if place[0].f_globals.get("__name__") == module]
    where = ""
    if frames:
        frame, line = (own or frames)[-1]
        where = f" ({Path(frame.f_code.co_filename).name}, line {line})"
    what = str(error) if isinstance(error, ShmioError) else f"{type(error).__name__}: {error}"
    return _line(f"{what}{where}")


def _line(text: str) -> str:
    return shorten(printable(" ".join(text.split())), 400)
