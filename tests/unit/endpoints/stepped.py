"""Sources that use the instance's clock: threads that publish a frame for each step."""

from __future__ import annotations

import asyncio
import struct
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager

from shmio.connectors.commands import CommandProcessor
from shmio.connectors.injection_layers import Owner
from shmio.connectors.output import Image, Output
from shmio.layout.model import Layout, Register
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Provenance, Quality, Segment, Write
from tests.unit.endpoints.harness import STALE_NS, Endpoint, endpoint

LAYOUT = Layout(
    "SIM",
    None,
    416,
    False,
    (
        Register("count", "DINT", (), 0, None, 4, 1),
        Register("doubled", "DINT", (), 4, None, 4, 1),
        Register("goal", "DINT", (), 8, None, 4, 1),
        Register("reached", "DINT", (), 12, None, 4, 1),
        Register("row", "DINT", ((1, 100),), 16, None, 400, 100),
    ),
)
_NUMBERS = struct.Struct(">4i")
_FAR_NS = 10_000_000_000


class Model:
    """A source that counts steps. ``reached`` takes the value of ``goal`` one step after ``goal`` was written."""

    def __init__(self, segment: Segment, source: str) -> None:
        self.image = bytearray(LAYOUT.size)
        self.mute = False
        """True while steps are not answered."""
        self.failure = ""
        self.writer = segment.writer(source)
        self.output = Output(self.writer)
        self.processor = CommandProcessor(
            self.output, ["goal"], time.monotonic_ns, armed=True, owner_of=lambda writer: Owner(writer, 1)
        )
        self._clock = segment.clock
        self._bell = segment.clock.slot_bell(segment.processes.find(source).index)
        self._stopping = False
        self._done = self._clock.read().step
        self.publish(self._done)
        self.processor.open()
        self._threads = [threading.Thread(target=run) for run in (self.processor.run, self._run)]
        for thread in self._threads:
            thread.start()

    def publish(self, cycle: int) -> None:
        quality = Quality.BAD if self.failure else Quality.GOOD
        self.output.publish(
            Image(bytes(self.image), cycle, time.time_ns(), quality, Provenance.SIMULATED, self.failure)
        )

    def answer(self) -> None:
        """Answer steps again, after ``mute`` was set."""
        self.mute = False
        self._bell.ring()

    def stop(self) -> None:
        self._stopping = True
        self.processor.stop()
        self._bell.ring()
        for thread in self._threads:
            thread.join(20)
            assert not thread.is_alive()

    def _run(self) -> None:
        while not self._stopping:
            seen = self._bell.value()
            state = self._clock.read()
            if state.stepping and state.step > self._done and not self.mute:
                self._done = state.step
                self._step(state.step)
            else:
                self._bell.wait(seen, _FAR_NS)

    def _step(self, number: int) -> None:
        before = _NUMBERS.unpack_from(self.image)
        if self.processor.waiting:
            self.processor.carry_out(self._write)
        count, goal = before[0] + 1, _NUMBERS.unpack_from(self.image)[2]
        _NUMBERS.pack_into(self.image, 0, count, 2 * count, goal, before[2])
        struct.pack_into(">100i", self.image, 16, *range(count, count + 100))
        self.publish(number)

    def _write(self, writes: Sequence[Write]) -> list[str]:
        for offset, _, data in writes:
            self.image[offset : offset + len(data)] = data
        return [""] * len(writes)


@contextmanager
def stepped_segment(instance: str, *sources: str, virtual: bool = True) -> Iterator[Segment]:
    """Create a segment whose sources are models; ``virtual``: time starts stopped at 0."""
    attributes = Attributes("simulation", ("goal",), stepped=True)
    blocks = [BlockSpec(source, LAYOUT, 20_000_000, STALE_NS, 1 << 20, attributes) for source in sources]
    processes = [*(ProcessSpec(source, "source") for source in sources), ProcessSpec("grpc", "grpc")]
    with Segment.create(instance, blocks, processes, stepped=virtual) as segment:
        yield segment
        segment.unlink()


def simulate(
    instance: str,
    test: Callable[[Endpoint, dict[str, Model]], Awaitable[None]],
    *sources: str,
    virtual: bool = True,
) -> None:
    """Run a test with served models, by default one named ``sim``."""
    with stepped_segment(instance, *(sources or ("sim",)), virtual=virtual) as segment:
        models = {source: Model(segment, source) for source in segment.blocks}

        async def run() -> None:
            async with endpoint(segment) as served:
                await test(served, models)

        try:
            asyncio.run(run())
        finally:
            for model in models.values():
                model.stop()
