"""An emulated controller in its own process, attacked over real sockets."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmio.connectors.s7 import S7Client, S7Options
from shmio.errors import ConnectorError
from shmio.testing.cell import PATIENCE_S, until

SIZE = 300
MAX_CLIENTS = 16
LONGEST_ANSWER = 967
PLC = f"""
import json, sys
from shmio.config.address import Address
from shmio.emulators.s7 import S7Server
with S7Server(Address("127.0.0.1", 0), max_clients={MAX_CLIENTS}) as server:
    server.add_block(5, bytearray({SIZE}))
    server.start()
    print(server.address.port, flush=True)
    for line in sys.stdin:
        print(json.dumps(server.client_count), flush=True)
"""

SESSION = bytes.fromhex("0300001611e00000000100c1020100c2020101c0010a")
SETUP = bytes.fromhex("03000019 02f080 32 01 0000 0001 0008 0000 f0 00 0008 0008 03c0")


class Plc:
    """The process under attack, and one honest client that stays connected throughout."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        self._process = process
        self.port = int(process.stdout.readline())
        self.honest = self.client()
        self.honest.connect()

    def client(self) -> S7Client:
        return S7Client(S7Options(host="127.0.0.1", port=self.port, timeout=int(PATIENCE_S * 1000)), 5, SIZE)

    def dial(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_S)

    @property
    def clients(self) -> int:
        """Number of clients that the server counts."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return int(json.loads(self._process.stdout.readline()))

    @property
    def resources(self) -> tuple[int, int, int]:
        """Peak of resident memory in KiB, threads now, descriptors now."""
        place = Path(f"/proc/{self._process.pid}")
        status = dict(line.split(":", 1) for line in (place / "status").read_text().splitlines())
        return int(status["VmHWM"].split()[0]), int(status["Threads"]), len(list((place / "fd").iterdir()))


@pytest.fixture
def plc(tmp_path: Path) -> Iterator[Plc]:
    log = tmp_path / "log"  # not a pipe: the process would block when it is full
    with (
        log.open("w") as said,
        subprocess.Popen(
            [sys.executable, "-c", PLC], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said, text=True
        ) as process,
    ):
        plc = Plc(process)
        with closing(plc.honest):
            yield plc
            assert len(plc.honest.read()) == SIZE, "the honest client is still served"
        process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert "Traceback" not in log.read_text()


# -- what the peers send -----------------------------------------------------------------------------------------------

byte, word = st.integers(0, 0xFF), st.integers(0, 0xFFFF)


def tpkt(payload: bytes, length: int | None = None) -> bytes:
    return struct.pack(">BxH", 3, len(payload) + 4 if length is None else length) + payload


def data(pdu: bytes) -> bytes:
    return tpkt(b"\x02\xf0\x80" + pdu)


def job(parameters: bytes, values: bytes, lie: int = 0) -> bytes:
    head = struct.pack(">BBHHHH", 0x32, 1, 0, 7, len(parameters), len(values) + lie & 0xFFFF)
    return data(head + parameters + values)


items = st.lists(
    st.builds(
        lambda kind, count, number, area, place: struct.pack(
            ">BBBBHHI", 0x12, 10, 0x10, kind, count, number, area << 24 | place
        ),
        st.integers(0, 9) | byte,
        st.integers(0, 20) | word,
        st.just(5) | word,
        st.just(0x84) | byte,
        st.integers(0, 8 * (SIZE + 2)) | st.integers(0, 0xFFFFFF),
    ),
    max_size=20,
)
values = st.lists(
    st.builds(
        lambda code, transport, length, value: struct.pack(">BBH", code, transport, length) + value,
        byte,
        st.sampled_from([3, 4, 5, 7, 9]) | byte,
        st.integers(0, 64) | word,
        st.binary(max_size=20),
    ),
    max_size=20,
).map(b"".join)
jobs = st.builds(
    lambda function, count, places, content, lie: job(
        bytes((function, len(places) if count is None else count)) + b"".join(places), content, lie
    ),
    st.sampled_from([4, 5]),
    st.none() | st.just(255) | byte,
    items,
    st.just(b"") | values,
    st.just(0) | st.integers(-9, 9),
)
setups = st.builds(
    lambda calling, called, size: job(struct.pack(">BxHHH", 0xF0, calling, called, size), b""),
    word,
    word,
    st.sampled_from([0, 1, 12, 100, 960, 65535]) | word,
)
services = st.sampled_from(
    [
        "32 07 0000 0001 0008 0008 00 01 12 04 11 44 01 00 ff 09 0004 0424 0000",
        "32 07 0000 0001 0008 0008 00 01 12 04 11 44 01 00 ff 09 0004 001c 0000",
        "32 07 0000 0001 0008 000c 00 01 12 04 11 43 03 00 ff 09 0008 3041 3030303035 41",
        "32 07 0000 0001 0008 000e 00 01 12 04 11 47 02 00 ff 09 000a 00192601010203040506",
        "32 01 0000 0001 0010 0000 29 0000000000 09 505f50524f4752414d",
        "32 01 0000 0001 0014 0000 28 00000000000000fd 0000 09 505f50524f4752414d",
        "32 01 0000 0001 0008 0000 1d 000000000000 00",
    ]
).map(lambda text: data(bytes.fromhex(text)))
orderly = jobs | setups | services  # each of these must be answered
noise = st.builds(data, st.binary(max_size=300)) | st.builds(tpkt, st.binary(), word)
spoilt = st.builds(
    lambda frame, at, new: frame[: at % len(frame)] + bytes((new,)) + frame[at % len(frame) + 1 :], orderly, word, byte
)
conversations = st.builds(list.__add__, st.lists(orderly, max_size=12), st.just([]) | st.lists(noise | spoilt))
beginnings = st.sampled_from([SESSION + SETUP] * 4 + [SESSION, b""]) | st.builds(tpkt, st.binary(max_size=40))


def answers(received: bytes) -> list[bytes]:
    """Split the received bytes into messages, and check their lengths."""
    found = []
    while received:
        version, length = struct.unpack_from(">BxH", received)
        assert version == 3
        assert 7 <= length <= LONGEST_ANSWER
        assert length <= len(received)
        found.append(received[:length])
        received = received[length:]
    return found


def attack(peer: socket.socket, sent: bytes) -> bytes:
    """Send, shut down the sending side, and return what comes until the connection ends."""
    received = b""
    with contextlib.suppress(ConnectionError):  # the server may close before all is sent
        peer.sendall(sent)
        with contextlib.suppress(OSError):  # no longer connected
            peer.shutdown(socket.SHUT_WR)
        while piece := peer.recv(65536):
            received += piece
    return received


def test_any_input_is_answered_or_closes_the_connection(plc: Plc) -> None:
    plc.honest.read()
    peak_kib, threads, descriptors = plc.resources
    count = 0

    @settings(max_examples=300)  # the examples depend on the modules that other tests have loaded
    @given(beginnings, conversations)
    def run(beginning: bytes, sent: list[bytes]) -> None:
        nonlocal count
        with plc.dial() as peer:
            found = answers(attack(peer, beginning + b"".join(sent)))
        assert len(found) <= len(sent) + 2
        count += len(found)
        assert len(plc.honest.read()) == SIZE

    run()
    assert count > 100, "many jobs were answered"
    until(lambda: plc.clients == 1, "all places are free again")
    until(lambda: plc.resources[1:] == (threads, descriptors), "threads and descriptors are given back")
    assert plc.resources[0] < peak_kib + 16 * 1024


def test_silent_connections_use_only_the_allowed_places(plc: Plc) -> None:
    """The peers fall silent at once, within the handshake, within a frame, or after the set-up."""
    peak_kib, threads, descriptors = plc.resources
    with ExitStack() as stack:
        for begun in (b"", SESSION[:9], b"\x03\x00\xff\xff" + bytes(9000), SESSION + SETUP, SESSION + SETUP[:20]) * 60:
            peer = stack.enter_context(plc.dial())
            with contextlib.suppress(ConnectionError):  # the server refuses it
                peer.sendall(begun)
        assert plc.clients <= MAX_CLIENTS
        now_kib, now_threads, now_descriptors = plc.resources
        assert now_threads <= threads + MAX_CLIENTS
        assert now_descriptors <= descriptors + MAX_CLIENTS + 1  # one connection that is being refused
        assert now_kib < peak_kib + 16 * 1024
        assert len(plc.honest.read()) == SIZE
    with closing(plc.client()) as late:

        def admitted() -> bool:
            with contextlib.suppress(ConnectorError):
                late.connect()
                return len(late.read()) == SIZE
            return False

        until(admitted, "room for another")
    until(lambda: plc.resources[1:] == (threads, descriptors), "threads and descriptors are given back")


def send_forever(peer: socket.socket, sent: bytes) -> None:
    while True:
        peer.send(sent)


def test_flood_of_jobs_uses_bounded_memory(plc: Plc) -> None:
    """A peer sends jobs as fast as it can, and reads no answer."""
    read = bytes.fromhex("0300001f 02f080 32 01 0000 0001 000e 0000 04 01 12 0a 10 02 0100 0005 84 000000")
    plc.honest.read()
    peak_kib, _, _ = plc.resources
    with plc.dial() as peer:
        peer.sendall(SESSION + SETUP)
        peer.setblocking(False)
        with pytest.raises(BlockingIOError):
            send_forever(peer, read * 1000)
        assert len(plc.honest.read()) == SIZE
    assert plc.resources[0] < peak_kib + 16 * 1024
