"""Tells what a model declares, in a process of its own: a model is anybody's code, and may have changed since.

Reads an object of ``options`` and ``layout`` (or null) on standard input, and writes one of ``layout`` and ``inputs``,
or of ``error``.
"""

from __future__ import annotations

import os
import sys

import msgspec

from shmio.connectors.models.simulation import Simulation, make
from shmio.errors import ShmioError
from shmio.layout.model import Layout


class Request(msgspec.Struct):
    """What to look at. ``layout``: the document of one, if the model is to run on that."""

    options: Simulation.Options
    layout: str | None


class Answer(msgspec.Struct):
    """What was found: the block's layout, as a document, and the inputs that can be connected; or what is wrong."""

    layout: str = ""
    inputs: tuple[str, ...] = ()
    error: str = ""


def main() -> int:
    """Answer one request; the exit status."""
    answer_fd = os.dup(1)
    os.dup2(2, 1)  # what a model prints is no answer
    request = msgspec.json.decode(sys.stdin.buffer.read(), type=Request)
    try:
        runner = make(request.options, None if request.layout is None else Layout.from_json(request.layout.encode()))
        answer = Answer(runner.layout.to_json().decode(), runner.inputs)
    except ShmioError as error:
        answer = Answer(error=str(error))
    with os.fdopen(answer_fd, "wb") as stream:
        stream.write(msgspec.json.encode(answer))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
