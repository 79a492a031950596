"""A source that accepts commands, with its device. The test decides when a cycle runs."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

from shmio.connectors.commands import CommandProcessor
from shmio.connectors.injection_layers import Owner
from shmio.connectors.output import Image, Output
from shmio.errors import ConnectorError
from shmio.segment import BlockWriter, Provenance, Quality, Write
from tests.unit.endpoints.harness import WRITER

GUEST = 0
"""Number of the command queue for a program outside the instance."""


class Plant:
    """A command processor in its thread, and a device.

    The device accepts every write unless ``refusal`` gives a reason.
    """

    def __init__(
        self, writer: BlockWriter, *, armed: bool = True, allow_nonfinite: Sequence[str] = ("axis/position",)
    ) -> None:
        self.writer = writer
        self.memory = bytearray(writer.block.layout.size)
        self.written: list[Write] = []
        self.refusal = ""
        self.lost = False
        self.owners: dict[int, Owner] = {WRITER: Owner(WRITER, 1), GUEST: Owner(GUEST, 2)}
        self.quality = Quality.GOOD
        self.output = Output(writer)
        self.commands = CommandProcessor(
            self.output, writer.block.attributes.writable, time.monotonic_ns,
            allow_nonfinite=allow_nonfinite, armed=armed, owner_of=self.owners.get,
        )  # fmt: skip
        self.commands.open()
        self.cycles = 0
        """Number of cycles run so far."""
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self.commands.run)]
        self._threads[0].start()

    def cycle(self) -> None:
        """Carry out the waiting commands, then publish the device's memory."""
        try:
            if self.commands.waiting:
                self.commands.carry_out(self._write)
        except ConnectorError as error:
            self.commands.close(str(error))
        self.cycles += 1
        image = bytes(self.memory)
        self.output.publish(Image(image, self.cycles, time.time_ns(), self.quality, Provenance.LIVE, ""))

    def run(self, period_s: float = 0.002) -> None:
        """Run cycles until stopped."""

        def loop() -> None:
            while not self._stop.wait(period_s):
                self.cycle()

        thread = threading.Thread(target=loop)
        self._threads.append(thread)
        thread.start()

    def stop(self) -> None:
        self._stop.set()
        self.commands.stop()
        for thread in self._threads:
            thread.join(20)
            assert not thread.is_alive()

    def _write(self, writes: Sequence[Write]) -> list[str]:
        if self.lost:
            raise ConnectorError("cable out")
        for offset, mask, data in writes:
            if self.refusal:
                continue
            if mask:
                self.memory[offset] = self.memory[offset] & ~mask | data[0] & mask
            else:
                self.memory[offset : offset + len(data)] = data
        self.written += writes
        return [self.refusal] * len(writes)
