"""A source whose registers a program elsewhere computes, step by step."""

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
"""How often to check the model while waiting: a process that dies causes no wake-up."""
STOPPED: Final = "the source was stopped"


class Remote(Computed):
    """``connector = "remote"``: asks the model connected by Simulate of shmio.v1 for each step.

    Without a model a step fails at once; with one that does not answer, after ``timeout_ms``.
    Registers that the model does not compute show what is commanded or connected, from the next
    step on.
    """

    class Options(msgspec.Struct, forbid_unknown_fields=True):
        """Its keys. ``outputs`` and ``inouts`` are patterns; ``timeout_ms`` is real time.

        At least one pattern is needed. The limit of ``timeout_ms`` is below the 10 s that a step
        waits for its sources.
        """

        outputs: list[str] = []
        inouts: list[str] = []
        connections: dict[str, str] = {}
        timeout_ms: Annotated[float, msgspec.Meta(gt=0, le=9000)] = 1000.0

    def __init__(self, options: Options, layout: Layout) -> None:
        """Create the source.

        Raises:
            ConfigError: Nothing is computed, or the layout has no such registers.

        """
        if not options.outputs and not options.inouts:
            raise ConfigError(
                'outputs: this key is needed: patterns of the registers that the model computes, such as ["axes/**"]'
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
        self._last_model: ConnectedModel | None = None  # the model connected when begin() or step() last looked
        self._stopped = False

    @property
    def connections(self) -> Mapping[str, str]:
        """The connections as configured."""
        return self._options.connections

    @property
    def inputs(self) -> tuple[str, ...]:
        """The paths of all registers except outputs."""
        return self._inputs

    def attach(self, writer: BlockWriter) -> None:
        """Find the channel to the model."""
        link = writer.block.model_channel
        if link is None:
            raise SegmentError(f"source {writer.block.source}: its block has no link to a model")
        self._writer = writer
        self._link: ModelChannel = link
        self._link.asked.begin()

    def connect(self, values: Mapping[str, Value], doubt: str) -> None:
        """Command the connected registers."""
        self._doubt = doubt
        for path, value in values.items():
            try:
                codec(find(self._layout, path), self._layout.byte_order).encode_into(value, self._images.commanded)
            except (PathError, ValueRangeError) as error:
                raise ConnectorError(f"input {path}: {error}") from None

    def resume(self, image: bytes) -> None:
        """Continue from the registers. The model itself keeps its other state."""
        self._images.resume(image)

    def begin(self) -> bytes:
        """Return the present image.

        Raises:
            ConnectorError: No model is connected.

        """
        self._last_model = self._link.model()
        self._connected(self._last_model)
        return bytes(self._images.shown)

    def news(self) -> bool:
        """Return whether a model has connected, changed or left."""
        return self._link.model() != self._last_model

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Command registers; outputs refuse."""
        return self._images.write(writes)

    def step(self, time_ns: int, dt_ns: int) -> bytes:
        """Have the model compute a step.

        Raises:
            ConnectorError: There is no model, or it does not answer.
            ModelError: The model failed.

        """
        self._last_model = self._link.model()
        model = self._connected(self._last_model)
        until_ns = time.monotonic_ns() + round(1e9 * self.timeout_s)
        images = self._images
        shown = images.with_given(images.shown)
        ask = ModelRequest(0, self._writer.cycle, time_ns, dt_ns, until_ns, self._doubt, bytes(images.commanded), shown)
        answer = self._await(self._link.ask(ask, self._writer.now_ns()), model, until_ns)
        if answer.failure is not None:
            raise ModelError(f"model {model.name!r}: {answer.failure or 'it gave no reason'}")
        images.shown[:] = images.with_given(answer.image)
        return bytes(images.shown)

    def interrupt(self) -> None:
        """End the wait for an answer."""
        self._stopped = True
        self._link.answered.wake()

    def _connected(self, model: ConnectedModel | None) -> ConnectedModel:
        if model is None:
            source = self._writer.block.source
            raise ConnectorError(
                f'no model is connected: a program joins by simulate("{source}", …) of shmio.client, or Simulate of '
                "shmio.v1"
            )
        return model

    def _await(self, number: int, model: ConnectedModel, until_ns: int) -> ModelAnswer:
        """Wait for the answer to a request."""
        link = self._link
        while True:
            seen = link.answered.doorbell()  # before looking
            gone = link.model() != model  # before looking, too: it may answer, and leave
            answer = link.answer_to(number)
            if answer is not None:
                return answer
            if self._stopped:
                raise ConnectorError(STOPPED)
            if gone:
                raise ConnectorError(
                    f"model {model.name!r} disconnected before it answered; the next step works once one is connected"
                )
            rest_ns = until_ns - time.monotonic_ns()
            if rest_ns <= 0:
                raise ConnectorError(
                    f"model {model.name!r} did not answer within {self._options.timeout_ms:g} ms: see whether it "
                    "hangs, or raise timeout_ms"
                )
            link.answered.wait(seen, min(rest_ns, TURN_NS))
