"""What real clients send, and what real CPUs answer: bytes from public captures of an IM151-8, S7-300 and S7-400.

The captures are part of the collection ITI/ICS-Security-Tools (CC BY 4.0).
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

import pytest
from snap7.type import SrvArea

from shmio.config.address import Address
from shmio.emulators.s7 import S7Server, ServerOptions
from shmio.emulators.s7_profiles import PROFILES, Delays, Kind, Times
from tests.unit.connectors.s7.noise import EMPTY, parts_of

CONNECT = bytes.fromhex("03000016 11e0 0000 000f 00 c1020100 c2020102 c0010a")
CONFIRM = bytes.fromhex("03000016 11d0 000f 0003 00 c0010a c1020100 c2020102")
SETUP = bytes.fromhex("03000019 02f080 32010000 0100 0008 0000 f000 0001 0003 00f0")
GRANT = bytes.fromhex("0300001b 02f080 32030000 0100 0008 0000 0000 f000 0001 0002 00f0")

READ_OF_EIGHT = bytes.fromhex(
    "03000073 02f080 32010000 0200 0062 0000 0408"
    "120a100100010001 84000010 120a100800010001 84000040 120a100600010001 84000020 120a100400010001 84000000"
    "120a100100010000 83000008 120a100100010000 83000009 120a101d00010000 1d000000 120a101c00010000 1c000000"
)
"""WinCC reads a bit, REAL, DWORD, WORD, two bits of the markers, a timer and a counter."""
ANSWER_OF_EIGHT = bytes.fromhex(
    "03000049 02f080 32030000 0200 0002 0034 0000 0408 ff03000101 00 ff070004aabbccdd ff040020feadbeef ff040010babe"
    "ff03000101 00 ff03000101 00 ff0900022504 ff0900020011"
)
WRITE = bytes.fromhex(
    "030000c3 02f080 32010000 1a00 003e 0074 0505 120a100400100000 83000000 120a100200100000 81000000"
    "120a100200100000 82000000 120a101d00080000 1d000000 120a101c00080000 1c000000"
    "00040100 addeaddeaddeaddeaddeaddeaddeaddeefbeefbeefbeefbeefbeefbeefbeefbe"
    "00040080 aaaaaaaaaaaaaaaabbbbbbbbbbbbbbbb 00040080 bbbbbbbbbbbbbbbbaddeaddeaddeadde"
    "00090010 efbeefbeefbeefbeefbeefbeefbeefbe 00090010 fecafecafecafecafecafecafecafeca"
)
"""Markers, inputs, outputs, timers and counters."""
WRITTEN = bytes.fromhex("0300001a 02f080 32030000 1a00 0002 0005 0000 0505 ffffff 03 03")
NO_LIST = (
    bytes.fromhex("03000021 02f080 32070000 0c00 0008 0008 0001120411440100 ff090004 0c917fff"),
    bytes.fromhex("03000021 02f080 32070000 0c00 000c 0004 000112081284010100 00d402 0a000000"),
)
NO_BLOCK = (
    bytes.fromhex("03000025 02f080 32070000 0b00 0008 000c 0001120411430300 ff090008 3041303030303041"),
    bytes.fromhex("03000021 02f080 32070000 0b00 000c 0004 000112081283030000 00d209 0a000000"),
)
READ_OF_PARTS = bytes.fromhex("03000026 02f080 32010000 0d00 0015 0000 0401 1211b003 02004a006c 04004c0194 020051003c")
"""WinCC reads parts of three data blocks of an S7-400."""
ANSWER_OF_PARTS = bytes.fromhex("03000024 02f080 32030000 0d00 0002 000f 0000 0401 ff09000b ff040a ff0544053e ff040a")
STRANGERS = [bytes.fromhex(text) for text in (
    "03000013 02f080 32020000 0001 0000 0000 0000",  # an Ack
    "03000019 02f080 32070000 0000 0008 0000 0100101000000000",  # a push
)]  # fmt: skip


@contextmanager
def served(options: ServerOptions | None = None) -> Iterator[S7Server]:
    with S7Server(Address("127.0.0.1", 0), options=options or ServerOptions(240, 2)) as server:
        server.add_block(1, bytearray.fromhex("babe 01 00 feadbeef aabbccdd"))
        for number, start, data in ((74, 108, b"\4\x0a"), (76, 404, b"\5\x44\5\x3e"), (81, 60, b"\4\x0a")):
            server.add_block(number, bytearray(start) + data)
        for area in (SrvArea.PE, SrvArea.PA):
            server.add_area(area, bytearray(16))
        server.add_area(SrvArea.MK, bytearray(b"\0\3".ljust(32, b"\0")))
        server.add_area(SrvArea.TM, bytearray(b"\x25\x04".ljust(16, b"\0")))
        server.add_area(SrvArea.CT, bytearray(b"\x00\x11".ljust(16, b"\0")))
        server.start()
        yield server


@contextmanager
def dialled(server: S7Server) -> Iterator[tuple[socket.socket, BinaryIO]]:
    with socket.create_connection((server.address.host, server.address.port), timeout=30) as peer:
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with peer.makefile("rb") as stream:
            yield peer, stream


def frame_of(stream: BinaryIO) -> bytes:
    head = stream.read(4)
    return head + stream.read(int.from_bytes(head[2:], "big") - 4) if head else b""


def test_answers_are_those_of_the_cpus() -> None:
    with served() as server, dialled(server) as (peer, stream):
        peer.sendall(CONNECT)
        confirm = frame_of(stream)
        assert confirm[:8] + confirm[10:] == CONFIRM[:8] + CONFIRM[10:]  # but for the CPU's own reference
        for request, answer in [
            (SETUP, GRANT),
            (READ_OF_EIGHT, ANSWER_OF_EIGHT),
            (WRITE, WRITTEN),
            NO_BLOCK,
            (READ_OF_PARTS, ANSWER_OF_PARTS),
        ]:
            peer.sendall(request)
            assert frame_of(stream).hex(" ") == answer.hex(" ")
        peer.sendall(NO_LIST[0])
        refusal = frame_of(stream)
        assert refusal[:24] + refusal[25:] == NO_LIST[1][:24] + NO_LIST[1][25:]  # but for the sequence number


def test_parts_of_blocks_that_are_missing_or_written() -> None:
    beyond = READ_OF_PARTS[:-1] + b"\x3d"  # one byte beyond the end
    write = bytes.fromhex("03000021 02f080 32010000 0d00 000b 0005 0501 1207b001 01004a006c 00040008 01")
    with served() as server, dialled(server) as (peer, stream):
        peer.sendall(CONNECT + SETUP + beyond + write + READ_OF_PARTS)
        frame_of(stream), frame_of(stream)
        assert frame_of(stream)[-6:] == bytes.fromhex("0401 05000000")
        assert frame_of(stream)[-3:] == bytes.fromhex("0501 03")
        assert frame_of(stream) == ANSWER_OF_PARTS


def test_empty_tpdus_and_messages_that_need_no_answer_are_skipped() -> None:
    with served() as server, dialled(server) as (peer, stream):
        peer.sendall(CONNECT + EMPTY * 3 + SETUP + EMPTY + bytes.fromhex("03000007 02f080"))
        assert len(frame_of(stream)) == len(CONFIRM)
        assert frame_of(stream) == GRANT
        for stranger in STRANGERS:
            peer.sendall(EMPTY * 1000 + READ_OF_EIGHT + stranger + EMPTY)
            assert frame_of(stream) == ANSWER_OF_EIGHT
        peer.shutdown(socket.SHUT_WR)
        assert stream.read() == b""


def test_requests_divided_at_each_byte_and_together() -> None:
    pieces = [(READ_OF_EIGHT[:cut], READ_OF_EIGHT[cut:]) for cut in range(1, len(READ_OF_EIGHT))]
    tpdus = [parts_of(READ_OF_EIGHT, cut) for cut in range(1, len(READ_OF_EIGHT) - 7)]
    tpdus.append(parts_of(READ_OF_EIGHT, *range(1, len(READ_OF_EIGHT) - 7)))
    tpdus.append(EMPTY.join([parts_of(READ_OF_EIGHT, 40)[:47], parts_of(READ_OF_EIGHT, 40)[47:]]))
    with served() as server, dialled(server) as (peer, stream):
        peer.sendall(CONNECT + SETUP)
        frame_of(stream), frame_of(stream)
        for first, second in pieces:
            peer.sendall(first)
            peer.sendall(second)
            assert frame_of(stream) == ANSWER_OF_EIGHT, first
        for request in tpdus:
            peer.sendall(request)
            assert frame_of(stream) == ANSWER_OF_EIGHT, request
        peer.sendall(READ_OF_EIGHT + NO_BLOCK[0] + READ_OF_EIGHT)  # in one segment
        assert [frame_of(stream) for _ in range(3)] == [ANSWER_OF_EIGHT, NO_BLOCK[1], ANSWER_OF_EIGHT]
        peer.sendall(READ_OF_EIGHT + SETUP[:4] + b"\x03\x80\x00" + SETUP[7:])  # answers it, then closes
        assert frame_of(stream) in {ANSWER_OF_EIGHT, b""}
        assert stream.read() == b""


@pytest.mark.parametrize(
    ("asked", "granted", "profile"),
    [((1, 1, 1920), (1, 1, 240), "im151-8"), ((1, 3, 240), (1, 2, 240), "s7-300"), ((8, 8, 960), (8, 2, 480), "s7-400"),
     ((1, 1, 480), (1, 1, 480), "s7-1500")],
)  # fmt: skip
def test_grants_are_those_of_the_cpus(asked: tuple[int, ...], granted: tuple[int, ...], profile: str) -> None:
    one = PROFILES[profile]
    with served(ServerOptions(one.pdu_size, one.jobs)) as server, dialled(server) as (peer, stream):
        peer.sendall(CONNECT + SETUP[:-6] + b"".join(number.to_bytes(2, "big") for number in asked))
        frame_of(stream)
        assert frame_of(stream)[-6:] == b"".join(number.to_bytes(2, "big") for number in granted)


def test_pdus_fit_a_small_tpdu() -> None:
    """A client that asks for TPDUs of 128 bytes gets no PDU of 480 bytes, which would not fit."""
    with served(ServerOptions(480, 2)) as server, dialled(server) as (peer, stream):
        peer.sendall(CONNECT[:-1] + b"\7" + SETUP[:-2] + b"\1\xe0")
        assert frame_of(stream)[13] == 7
        assert frame_of(stream)[-2:] == (125).to_bytes(2, "big")
        peer.sendall(READ_OF_EIGHT)
        assert frame_of(stream) == ANSWER_OF_EIGHT


# -- times -------------------------------------------------------------------------------------------------------------


MEASURED: dict[str, dict[Kind, tuple[float, ...]]] = {
    "s7-300": {"read": (3.2,), "write": (3.2,), "other": (5.7, 6.6, 6.8)},
    "im151-8": {"read": (3.9, 4.0, 5.0, 6.9), "write": (3.9, 4.9, 5.0, 7.0), "other": (5.7, 6.6, 8.1)},
    "s7-300-slow": {"read": (15, 64, 115, 245), "write": (14, 24, 73), "other": (30,)},
    "s7-400": {"read": (4.1, 4.4, 7.2), "write": (4.1, 4.2), "other": (4.1, 4.3, 5.1)},
    "s7-1500": {"read": (0.8, 1.3), "write": (1.0, 1.1)},
}


def test_the_times_are_those_measured() -> None:
    for name, kinds in MEASURED.items():
        for kind, ms in kinds.items():
            delays = Delays(PROFILES[name], seed=1)
            drawn = [delays.due_ns(kind, at * 10**12) - at * 10**12 for at in range(20_000)]
            for share, wanted in zip((0.5, 0.9, 0.99, 1.0), ms, strict=False):
                assert PROFILES[name].times[kind].at(share) == wanted, (name, kind, share)
                later = sum(ns > wanted * 1e6 + 1 for ns in drawn) / len(drawn)
                assert later <= 1 - share + 0.01, (name, kind, share)
            assert min(drawn) == round(ms[0] * 1e6)


def test_equal_seeds_give_equal_times_and_answers_keep_their_order() -> None:
    first, again, other = (
        [delays.due_ns("read", at) for at in range(0, 10**8, 10**6)]
        for delays in (Delays(PROFILES["s7-300-slow"], seed) for seed in (1, 1, 2))
    )
    assert first == again != other
    assert first == sorted(first)


def test_an_answer_that_is_not_due_delays_no_other_client() -> None:
    kinds = PROFILES["s7-1500"].times
    at_once, in_an_hour = Times(0, 0, 0, 0), Times(*[3.6e6] * 4)
    hour = PROFILES["s7-1500"]._replace(times={**dict.fromkeys(kinds, at_once), "other": in_an_hour})
    with (
        served(ServerOptions(240, 2, profile=hour)) as server,
        dialled(server) as (late, _),
        dialled(server) as (peer, stream),
    ):
        late.sendall(CONNECT + SETUP + NO_LIST[0])
        peer.sendall(CONNECT + SETUP + READ_OF_EIGHT)
        frame_of(stream), frame_of(stream)
        assert frame_of(stream) == ANSWER_OF_EIGHT
        late.shutdown(socket.SHUT_WR)  # the server ends although an answer is still due
