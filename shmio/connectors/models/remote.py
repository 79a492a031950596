"""A source whose registers a program elsewhere computes, step by step."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Final

import msgspec

from shmio.connectors.models.computed import Computed
from shmio.errors import ConfigError, ConnectorError, ModelError, PathError, SegmentError, ValueRangeError
from shmio.layout.model import Layout
from shmio.layout.topic import find
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import Write
from shmio.segment import BlockWriter
from shmio.segment.model_channel import ConnectedModel, ModelAnswer, ModelChannel, ModelRequest, model_ports
from shmio.simulation.images import Images

TURN_NS: Final = 50_000_000
"""Who waits for an answer looks by itself, too: the bell of a process that dies is silent."""
STOPPED: Final = "the source was stopped"


class Remote(Computed):
    """``connector = "remote"``: asks the model that is connected by Simulate of shmio.v1 for each step.

    Without one a step fails at once; with one that does not answer, when ``timeout_ms`` are over. Registers that it
    does not compute are shown as they are commanded or connected, from the next step on.
    """

    class Options(msgspec.Struct, forbid_unknown_fields=True):
        """Its keys. ``outputs``, ``inouts``: patterns of registers, at least one; ``timeout_ms`` in real time.

        The time-out is less than the 10 s for which a step waits for its sources.
        """

        outputs: list[str] = []
        inouts: list[str] = []
        connections: dict[str, str] = {}
        timeout_ms: Annotated[float, msgspec.Meta(gt=0, le=9000)] = 1000.0

    def __init__(self, options: Options, layout: Layout) -> None:
        """ConfigError: nothing is computed, or the layout has no such registers."""
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
        self._told: ConnectedModel | None = None  # who was connected when the source said so last
        self._stopped = False

    @property
    def connections(self) -> Mapping[str, str]:
        """As configured."""
        return self._options.connections

    @property
    def inputs(self) -> tuple[str, ...]:
        """All registers but the outputs."""
        return self._inputs

    def attach(self, writer: BlockWriter) -> None:
        """Find the way to the model."""
        link = writer.block.model_channel
        if link is None:
            raise SegmentError(f"source {writer.block.source}: its block has no link to a model")
        self._writer = writer
        self._link: ModelChannel = link
        self._link.asked.begin()

    def connect(self, values: Mapping[str, Value], doubt: str) -> None:
        """Command registers that are connected."""
        self._doubt = doubt
        for path, value in values.items():
            try:
                codec(find(self._layout, path), self._layout.byte_order).encode_into(value, self._images.commanded)
            except (PathError, ValueRangeError) as error:
                raise ConnectorError(f"input {path}: {error}") from None

    def resume(self, image: bytes) -> None:
        """Go on from the registers; what else the model knows, it has itself."""
        self._images.resume(image)

    def begin(self) -> bytes:
        """The image as it is; ConnectorError: no model is connected."""
        self._told = self._link.model()
        self._connected(self._told)
        return bytes(self._images.shown)

    def news(self) -> bool:
        """Whether another model is connected by now, or none."""
        return self._link.model() != self._told

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Command registers; outputs refuse."""
        return self._images.write(writes)

    def step(self, time_ns: int, dt_ns: int) -> bytes:
        """Have the model compute. ConnectorError: there is none, or no answer comes; ModelError: it has failed."""
        self._told = self._link.model()
        model = self._connected(self._told)
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
        """Wait for no answer any more."""
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
        """The answer to an ask."""
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
                    f"model {model.name!r} was gone before it had answered; the next step works when one is connected"
                )
            rest_ns = until_ns - time.monotonic_ns()
            if rest_ns <= 0:
                raise ConnectorError(
                    f"model {model.name!r} did not answer within {self._options.timeout_ms:g} ms: see whether it "
                    "hangs, or raise timeout_ms"
                )
            link.answered.wait(seen, min(rest_ns, TURN_NS))
