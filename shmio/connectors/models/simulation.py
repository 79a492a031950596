"""A source whose registers a model computes in its process.

As a program (``python -m``) it describes a model for the supervisor, because a model is foreign code
and may have changed. It reads a ``Request`` from standard input and writes an ``Answer``, both JSON.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import msgspec

from shmio.connectors.base import Computed
from shmio.errors import ConfigError, ModelError, ShmioError
from shmio.layout.document import load_layout
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write
from shmio.simulation.model import layout_of, load
from shmio.simulation.runner import ModelRunner


class Simulation(Computed):
    """``connector = "simulation"``: runs one model on the instance clock."""

    class Options(msgspec.Struct, forbid_unknown_fields=True):
        """Its keys.

        ``model``: ``package.module:Class``; ``folder``: where to look for uninstalled modules.
        """

        model: str
        parameters: dict[str, Any] = {}
        seed: Annotated[int, msgspec.Meta(ge=0)] = 0
        connections: dict[str, str] = {}
        folder: str = "."

    def __init__(self, options: Options, layout: Layout) -> None:
        """Create the model.

        Raises:
            ConfigError: There is no such model, or it does not fit the layout or the parameters.

        """
        self._runner = make(options, layout)
        self._connections = options.connections

    @property
    def connections(self) -> Mapping[str, str]:
        """The connections as configured."""
        return self._connections

    @property
    def inputs(self) -> tuple[str, ...]:
        """The inputs that the model declares."""
        return self._runner.inputs

    def connect(self, values: Mapping[str, Value], doubt: str) -> None:  # noqa: ARG002  no model asks for it
        """Set the values of inputs."""
        self._runner.connect(values)

    def resume(self, image: bytes) -> None:
        """Continue from the registers. Other state of the model is lost with its process."""
        self._runner.resume(image)

    def begin(self) -> bytes:
        """Start the model; return its first image."""
        return self._runner.begin()

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Command registers; outputs refuse."""
        return self._runner.write(writes)

    def step(self, time_ns: int, dt_ns: int) -> bytes:
        """Have the model compute a step."""
        return self._runner.step(time_ns, dt_ns)


def make(options: Simulation.Options, layout: Layout | None) -> ModelRunner:
    """Create the model of these options, on a layout or on the one that it declares.

    Raises:
        ConfigError: The model cannot be created. The message begins with the key.

    """
    try:
        model = load(options.model, options.folder)
        own = layout_of(model) if layout is None else layout
    except (ConfigError, ModelError) as error:
        raise ConfigError(f"model: {error}") from None
    return ModelRunner(model, own, options.parameters, options.seed)


# -- as a program ------------------------------------------------------------------------------------------------------


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
