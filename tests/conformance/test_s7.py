"""The common conformance suites, run with the S7 connector against the emulated PLC.

Frames are read in one PDU, in several, and in several at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import snap7

from shmio.config import Address
from shmio.connectors.base import Connector
from shmio.connectors.s7.connector import S7Connector, S7Options
from shmio.emulators.emulator import Emulator
from shmio.emulators.programs import Counter, generations
from shmio.emulators.s7 import ServerOptions
from shmio.layout.model import Layout, Register
from shmio.segment import EventKind, Quality, Write
from shmio.testing.conformance import TIMEOUT_MS, Run
from shmio.testing.proxy import FaultProxy
from shmio.testing.write_conformance import SPARE, WriteConformance, Writer

TAIL = SPARE + 2
"""Bytes after the counter: spare bytes, the flag byte, and the count that the flags must have."""


class Shared:
    """PLC program: counts in the flag bytes, and leaves a few bytes to clients.

    It continues the count from the flag bytes that it finds.
    """

    period_ms = 1

    def __init__(self, layout: Layout) -> None:
        self._counter = Counter(replace(layout, size=layout.size - TAIL))
        self._part = bytearray(layout.size - TAIL)
        self._count = 0

    def step(self, time_s: float, frame: bytearray) -> None:
        self._counter.step(time_s, self._part)
        frame[:-TAIL] = self._part
        self._count = self._count + 2 & 0xFE
        frame[-2] = frame[-2] + 2 & 0xFE | frame[-2] & 1
        frame[-1] = self._count


class S7Rig:
    """The emulated PLC, which runs the program ``Shared``."""

    def __init__(self, proxy: FaultProxy, plc: Emulator, size: int, *, tail: int = TAIL) -> None:
        self.proxy = proxy
        self.timeout_ms = TIMEOUT_MS
        self.plc = plc
        self.layout = layout(size - TAIL + tail)
        self._size, self._tail = size, tail
        self.one_pdu = size <= 900
        self.spare = size - TAIL
        self.flags = size - 2
        self.refused = Write(size, 0, b"beyond")

    def connector(self) -> Connector:
        address = self.proxy.address
        return S7Connector(
            S7Options(host=address.host, port=address.port, timeout=self.timeout_ms, dbNumber=7), self.layout
        )

    def changed(self) -> S7Rig:
        return S7Rig(self.proxy, self.plc, self._size, tail=0)

    def generation(self, raw: bytes) -> int:
        """Return the PLC's cycle in which the frame was read.

        A frame that fits into one PDU is of one cycle. A frame of several PDUs may span a few cycles.
        """
        found = generations(raw[: len(raw) - self._tail])
        assert len(found) == 1 or not self.one_pdu, f"mixed cycles {found}"
        assert found[-1] - found[0] < 10_000, f"bytes that the PLC never had: {found}"
        assert not self._tail or raw[-2] & 0xFE == raw[-1], "a write has changed the neighbours of its bit"
        return found[0]


def layout(size: int) -> Layout:
    return Layout("DB7", 7, size, False, (Register("data", "BYTE", ((0, size - 1),), 0, None, size, size),))


class TestS7(WriteConformance):
    @pytest.fixture(
        params=[
            pytest.param((400, ServerOptions(), 0.0), id="one PDU"),
            pytest.param((2180, ServerOptions(), 0.0), id="several PDUs"),
            pytest.param((2180, ServerOptions(max_pdu_size=480, max_jobs=24), 0.004), id="several cycles"),
        ]
    )
    def rig(self, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[S7Rig]:
        size, options, delay_s = request.param
        monkeypatch.setattr("shmio.emulators.programs.PROGRAMS", {"shared": Shared})
        with (
            Emulator(layout(size), "shared", Address("127.0.0.1", 0), options=options) as plc,
            FaultProxy(plc.address, up_s=delay_s, down_s=delay_s) as proxy,
        ):
            yield S7Rig(proxy, plc, size)

    def test_a_reply_with_a_wrong_reference_is_never_accepted(self, run: Run, rig: S7Rig) -> None:
        """A reply whose number matches no open request makes the connector drop the connection."""
        run.good()
        rig.proxy.rewrite_reference(lambda reference: reference + 1000, frames=1)
        run.until(lambda frame: frame.quality is Quality.BAD)
        rig.proxy.pass_all()
        run.good()

    def test_a_confirmation_with_a_wrong_reference_confirms_nothing(self, run: Run, writer: Writer, rig: S7Rig) -> None:
        """The write's outcome is unknown, and the connection is dropped."""

        def rename(frame: bytes) -> bytes:
            return frame[:11] + bytes((frame[11] ^ 0x40,)) + frame[12:] if frame[19:20] == b"\x05" else frame

        rig.proxy.edit(rename)
        end = writer.write(Write(rig.spare, 0, b"x"))
        assert end.kind == EventKind.UNKNOWN
        assert "not in flight" in end.text
        run.bad()
        rig.proxy.pass_all()
        run.good()

    def test_stop_makes_values_uncertain(self, run: Run, rig: S7Rig) -> None:
        """While the PLC is stopped, its block is readable, but no longer changes.

        The image is uncertain, with the remedy as reason, until the PLC runs again.
        """
        run.good()
        peer = snap7.Client()
        peer.connect(rig.plc.address.host, 0, 1, rig.plc.address.port)
        peer.plc_stop()
        frame = run.until(lambda frame: frame.quality is Quality.UNCERTAIN)
        assert "in STOP" in frame.reason
        peer.plc_hot_start()
        run.good()
        peer.disconnect()
        peer.destroy()
