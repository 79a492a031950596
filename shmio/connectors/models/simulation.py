"""A source whose registers a model computes inside the source's process.

The supervisor also runs this module as a program (``python -m``) to learn what a model's block
contains. The program imports the user's code in a fresh process. It reads a ``Request`` from
standard input and writes an ``Answer`` to standard output, both as JSON.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import msgspec

from shmio.connectors.base import Computed
from shmio.errors import ConfigError, ModelError, ShmioError
from shmio.layout.document import load_layout
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write
from shmio.simulation.fmu import DEFAULTS, FmuOptions
from shmio.simulation.loading import load
from shmio.simulation.model import layout_of
from shmio.simulation.runner import ModelRunner


class Simulation(Computed):
    """``connector = "simulation"``: runs one model on the instance clock."""

    class Options(msgspec.Struct, forbid_unknown_fields=True):
        """Keys of the source.

        ``model`` is ``package.module:Class``, or the file of an FMU. Modules that are not installed
        and FMUs are searched for in ``folder``. ``strict`` and ``text_length`` are for FMUs: see
        :class:`~shmio.simulation.fmu.FmuOptions`.
        """

        model: str
        parameters: dict[str, Any] = {}
        seed: Annotated[int, msgspec.Meta(ge=0)] = 0
        connections: dict[str, str] = {}
        folder: str = "."
        strict: bool = False
        text_length: Annotated[int, msgspec.Meta(ge=1, le=16_382)] = DEFAULTS.text_length

    def __init__(self, options: Options, layout: Layout) -> None:
        """Create the model.

        Raises:
            ConfigError: The model does not exist, or does not fit the layout or the parameters.

        """
        self._runner = make(options, layout)
        self._connections = options.connections

    @property
    def connections(self) -> Mapping[str, str]:
        """The topics that connected inputs get their values from, by the paths of the inputs, as configured."""
        return self._connections

    @property
    def inputs(self) -> tuple[str, ...]:
        """The paths of the inputs that the model declares."""
        return self._runner.inputs

    def connect(self, values: Mapping[str, Value], doubt: str) -> None:  # noqa: ARG002  models do not use it
        """Set the values of inputs for the next step."""
        self._runner.connect(values)

    def resume(self, image: bytes) -> None:
        """Continue from the last image.

        The model loses all other state when the process restarts.
        """
        self._runner.resume(image)

    def begin(self) -> bytes:
        """Start the model, and return its first image."""
        return self._runner.begin()

    def save(self) -> bytes:
        """Return the model's state."""
        return self._runner.save()

    def prepare_restore(self, data: bytes) -> Callable[[], None]:
        """Check a state from :meth:`save`, and return the function that restores it."""
        return self._runner.prepare_restore(data)

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Store values of registers; writes to outputs are refused."""
        return self._runner.write(writes)

    def step(self, time_ns: int, dt_ns: int) -> bytes:
        """Compute a step with the model, and return the new image."""
        return self._runner.step(time_ns, dt_ns)

    def close(self) -> None:
        """Release what the model holds."""
        self._runner.close()


def make(options: Simulation.Options, layout: Layout | None) -> ModelRunner:
    """Create the model that the options name.

    ``layout`` is the layout of the source's block; None if the model itself declares its registers.

    Raises:
        ConfigError: The model cannot be created. The message begins with the configuration key that
            is wrong.

    """
    try:
        model = load(options.model, options.folder, FmuOptions(options.strict, options.text_length))
        model, parameters = model.with_parameters(options.parameters)
        own = layout_of(model) if layout is None else layout
    except (ConfigError, ModelError) as error:
        raise ConfigError(f"model: {error}") from None
    return ModelRunner(model, own, parameters, options.seed)


# -- as a program ------------------------------------------------------------------------------------------------------


class Request(msgspec.Struct):
    """A request to describe a model.

    ``layout`` is the layout of the source's block as JSON; None if the model itself declares its
    registers.
    """

    options: Simulation.Options
    layout: str | None


class Answer(msgspec.Struct):
    """The layout of the model's block as JSON, the inputs that can be connected and notices; or an error."""

    layout: str = ""
    inputs: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    error: str = ""


def main() -> int:
    """Answer one request, and return the exit status."""
    answer_fd = os.dup(1)
    os.dup2(2, 1)  # standard output is for the answer: redirect what the model prints
    request = msgspec.json.decode(sys.stdin.buffer.read(), type=Request)
    try:
        runner = make(request.options, None if request.layout is None else load_layout(request.layout.encode()))
        answer = Answer(runner.layout.to_json().decode(), runner.inputs, runner.notices)
    except ShmioError as error:
        answer = Answer(error=str(error))
    with os.fdopen(answer_fd, "wb") as stream:
        stream.write(msgspec.json.encode(answer))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
