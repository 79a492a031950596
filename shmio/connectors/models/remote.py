"""A source whose registers a connected program computes step by step."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Final

import msgspec

from shmio.connectors.base import Computed
from shmio.errors import ConfigError, ConnectorError, ModelError, PathError, SegmentError, ValueRangeError
from shmio.layout.model import Layout
from shmio.layout.topic import find
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import Write
from shmio.segment import BlockWriter
from shmio.segment.model_channel import ConnectedModel, ModelAnswer, ModelChannel, ModelRequest, model_ports
from shmio.simulation.images import Images

TURN_NS: Final = 50_000_000
"""Period in ns at which a waiting source checks that the model's process is alive.

The death of a process causes no wake-up.
"""
STOPPED: Final = "the source was stopped"


class Remote(Computed):
    """``connector = "remote"``: a program connected by Simulate of shmio.v1 computes each step.

    A step fails at once if no program is connected, and after ``timeout_ms`` if the program does
    not answer. A register that the program does not compute has the value that was last written to
    it, or last read from its connected topic. Readers see a new value after the next step.
    """

    class Options(msgspec.Struct, forbid_unknown_fields=True):
        """Keys of the source.

        ``outputs`` and ``inouts`` are patterns of the registers that the model computes; at least
        one pattern is needed. ``timeout_ms`` is real time, and must be less than the 10 s for which
        a step waits for its sources.
        """

        outputs: list[str] = []
        inouts: list[str] = []
        connections: dict[str, str] = {}
        timeout_ms: Annotated[float, msgspec.Meta(gt=0, le=9000)] = 1000.0

    def __init__(self, options: Options, layout: Layout) -> None:
        """Create the source.

        Raises:
            ConfigError: There is no pattern, or a pattern matches no register of the layout.

        """
        if not options.outputs and not options.inouts:
            raise ConfigError(
                'outputs: name the registers that the model computes, such as ["axes/**"], here or in inouts'
            )
        ends = model_ports(layout, options.outputs, options.inouts)
        inputs = {register.path for register in ends.inputs}
        self._images = Images(
            layout,
            [register for register in ends.outputs if register.path not in inputs],
            [register for register in ends.outputs if register.path in inputs],
        )
        self._inputs = tuple(register.path for register in ends.inputs)
        self._layout = layout
        self._options = options
        self.timeout_s = options.timeout_ms / 1000
        self._doubt = ""
        self._last_model: ConnectedModel | None = None  # as last seen by begin() or step()
        self._stopped = False

    @property
    def connections(self) -> Mapping[str, str]:
        """The topics that connected inputs get their values from, by the paths of the inputs, as configured."""
        return self._options.connections

    @property
    def inputs(self) -> tuple[str, ...]:
        """The paths of all registers that are not outputs."""
        return self._inputs

    def attach(self, writer: BlockWriter) -> None:
        """Find the model channel in the source's block. The channel carries requests to the model, and answers."""
        link = writer.block.model_channel
        if link is None:
            raise SegmentError(f"source {writer.block.source}: its block has no link to a model")
        self._writer = writer
        self._link: ModelChannel = link
        self._link.asked.begin()

    def connect(self, values: Mapping[str, Value], doubt: str) -> None:
        """Write the values of connected inputs into their registers."""
        self._doubt = doubt
        for path, value in values.items():
            try:
                codec(find(self._layout, path), self._layout.byte_order).encode_into(value, self._images.commanded)
            except (PathError, ValueRangeError) as error:
                raise ConnectorError(f"input {path}: {error}") from None

    def resume(self, image: bytes) -> None:
        """Continue from the last image.

        The program that runs the model keeps all other state of the model.
        """
        self._images.resume(image)

    def begin(self) -> bytes:
        """Return the present image, if a model is connected.

        Raises:
            ConnectorError: No model is connected.

        """
        self._last_model = self._link.model()
        self._connected(self._last_model)
        return bytes(self._images.shown)

    def has_changed(self) -> bool:
        """Return whether a model has connected, disconnected or been replaced."""
        return self._link.model() != self._last_model

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Store values of registers; writes to outputs are refused."""
        return self._images.write(writes)

    def step(self, time_ns: int, dt_ns: int) -> bytes:
        """Request a step from the model, and return the new image.

        Raises:
            ConnectorError: No model is connected, or it does not answer.
            ModelError: The model reported a failure.

        """
        self._last_model = self._link.model()
        model = self._connected(self._last_model)
        until_ns = time.monotonic_ns() + round(1e9 * self.timeout_s)
        images = self._images
        shown = images.with_given(images.shown)
        ask = ModelRequest(0, self._writer.cycle, time_ns, dt_ns, until_ns, self._doubt, bytes(images.commanded), shown)
        answer = self._await(self._link.ask(ask, self._writer.now_ns()), model, until_ns)
        if answer.failure is not None:
            raise ModelError(f"model {model.name!r}: {answer.failure or 'it failed without giving a reason'}")
        images.shown[:] = images.with_given(answer.image)
        return bytes(images.shown)

    def interrupt(self) -> None:
        """End a :meth:`step` that waits for an answer."""
        self._stopped = True
        self._link.answered.wake()

    def _connected(self, model: ConnectedModel | None) -> ConnectedModel:
        if model is None:
            source = self._writer.block.source
            raise ConnectorError(
                f'no model is connected; connect one with simulate("{source}", …) of shmio.client, or with Simulate '
                "of shmio.v1"
            )
        return model

    def _await(self, number: int, model: ConnectedModel, until_ns: int) -> ModelAnswer:
        """Wait for the answer to a request."""
        link = self._link
        while True:
            seen = link.answered.doorbell()  # before the check, so that no wake-up is missed
            gone = link.model() != model  # before the check: a model may answer, then disconnect
            answer = link.answer_to(number)
            if answer is not None:
                return answer
            if self._stopped:
                raise ConnectorError(STOPPED)
            if gone:
                raise ConnectorError(
                    f"model {model.name!r} disconnected before it answered; the next step works once a model is "
                    "connected"
                )
            rest_ns = until_ns - time.monotonic_ns()
            if rest_ns <= 0:
                raise ConnectorError(
                    f"model {model.name!r} did not answer within {self._options.timeout_ms:g} ms; check whether it "
                    "hangs, or raise timeout_ms"
                )
            link.answered.wait(seen, min(rest_ns, TURN_NS))
