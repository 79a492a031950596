"""Describes a model in a process of its own, because a model is foreign code and may have changed.

Reads a JSON object with ``options`` and ``layout`` (or null) from standard input, and writes one
with ``layout`` and ``inputs``, or with ``error``.
"""

from __future__ import annotations

import os
import sys

import msgspec

from shmio.connectors.models.simulation import Simulation, make
from shmio.errors import ShmioError
from shmio.layout.document import load_layout


class Request(msgspec.Struct):
    """The model to describe.

    ``layout`` is the JSON document of a layout, if the model is to run on one.
    """

    options: Simulation.Options
    layout: str | None


class Answer(msgspec.Struct):
    """The block's layout as a document and the inputs that can be connected, or an error."""

    layout: str = ""
    inputs: tuple[str, ...] = ()
    error: str = ""


def main() -> int:
    """Answer one request; return the exit status."""
    answer_fd = os.dup(1)
    os.dup2(2, 1)  # what a model prints is no answer
    request = msgspec.json.decode(sys.stdin.buffer.read(), type=Request)
    try:
        runner = make(request.options, None if request.layout is None else load_layout(request.layout.encode()))
        answer = Answer(runner.layout.to_json().decode(), runner.inputs)
    except ShmioError as error:
        answer = Answer(error=str(error))
    with os.fdopen(answer_fd, "wb") as stream:
        stream.write(msgspec.json.encode(answer))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
