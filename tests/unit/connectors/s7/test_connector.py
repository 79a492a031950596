"""The client over real sockets: after any fault, the next ``connect`` recovers."""

from __future__ import annotations

import socket
import struct
import threading
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.config.address import Address
from shmio.connectors.s7 import S7Client, S7Options
from shmio.connectors.s7.pdu import FRAME_OVERHEAD, parse_connect_confirm
from shmio.emulators.s7 import S7Server
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.values.write import Write
from shmio.testing.ports import reserved_port
from tests.unit.connectors.s7.harness import SIZE, Plc, assert_recovers

Scripted = Callable[..., S7Client]


@pytest.fixture
def scripted() -> Iterator[Scripted]:
    """Return a function that makes a client. Its peer sends one of the given answers for each message, then closes."""
    with ExitStack() as stack:

        def make(*answers: bytes, timeout: int = 60_000, size: int = SIZE) -> S7Client:
            listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))

            def play() -> None:
                peer, _ = listener.accept()
                with peer, suppress(OSError):  # the client may have closed
                    peer.settimeout(10)
                    for answer in answers:
                        peer.recv(4096)
                        peer.sendall(answer)

            thread = threading.Thread(target=play)
            thread.start()
            stack.callback(thread.join)
            host, port = listener.getsockname()
            options = S7Options(host=host, port=port, timeout=timeout)
            return stack.enter_context(closing(S7Client(options, 201, size)))

        yield make


# -- what works --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("packet", [None, 1, 96, 461, 941, 942, 65535])
@pytest.mark.parametrize("jobs", [None, 1, 3])
def test_reads_the_whole_block(plc: Plc, packet: int | None, jobs: int | None) -> None:
    client = plc.client(packetSize=packet, maxJobs=jobs, timeout=60_000)
    client.connect()
    assert (client.pdu_size, client.jobs) == (960, jobs or 8)
    for generation in range(3):
        plc.block[:] = bytes([generation]) * SIZE
        assert client.read() == plc.block


def test_reads_a_block_of_one_byte(plc: Plc) -> None:
    client = plc.client(size=1)
    client.connect()
    assert client.read() == plc.block[:1]


def test_references_wrap_around(plc: Plc) -> None:
    client = plc.client(packetSize=1)  # 2180 references a read
    client.connect()
    for _ in range(31):
        assert client.read() == plc.block


def test_reads_over_ipv6() -> None:
    with S7Server(Address("::1", 0)) as server:
        server.add_block(1, bytearray(b"six"))
        server.start()
        with closing(S7Client(S7Options(host="::1", port=server.address.port), 1, 3)) as client:
            client.connect()
            assert client.read() == b"six"


def test_answers_in_any_order(plc: Plc) -> None:
    """The proxy collects three answers, and passes them on in reverse order."""
    client = plc.client()
    client.connect()
    answers: list[bytes] = []

    def swap(frame: bytes) -> bytes | None:
        answers.append(frame)
        return b"".join(reversed(answers)) if len(answers) == 3 else None

    plc.proxy.edit(swap, frames=3)
    assert client.read() == plc.block


class Segmented(socket.socket):
    """A connection that sends and receives a few bytes at a time, as TCP may."""

    MOST = 1

    def recv_into(self, buffer: Any, nbytes: int = 0, flags: int = 0) -> int:
        return super().recv_into(buffer, min(len(buffer), nbytes or len(buffer), self.MOST), flags)

    def send(self, data: Any, flags: int = 0) -> int:
        return super().send(memoryview(data)[: self.MOST], flags)


@pytest.mark.parametrize("most", [1, 3, 4, 7, 26, 500, 967, 968, 1500])
def test_answers_in_segments_of_any_size(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """Answers and requests may end anywhere within a segment, and two may be in one segment."""
    monkeypatch.setattr(Segmented, "MOST", most)
    monkeypatch.setattr(socket, "socket", Segmented)
    block = bytearray(range(256)) * 8
    with S7Server(Address("127.0.0.1", 0)) as server:
        server.add_block(1, block)
        server.start()
        options = S7Options(host="127.0.0.1", port=server.address.port, timeout=60_000)
        with closing(S7Client(options, 1, len(block))) as client:
            client.connect()
            for generation in range(3):
                block[:] = bytes([generation]) + block[1:]
                assert client.read() == block
            assert client.write([Write(3, 0, b"\7" * 1000)]) == [""]
            assert client.read() == block
            assert block[3:1003] == b"\7" * 1000


# -- no connection -----------------------------------------------------------------------------------------------------


def test_connection_refused() -> None:
    with reserved_port() as address:
        client = S7Client(S7Options(host=address.host, port=address.port), 201, SIZE)
        with pytest.raises(ConnectorError, match=f"^connection refused by {address}: no program listens there; check"):
            client.connect()
        assert not client.connected


def test_recovery_after_refused_connections(plc: Plc) -> None:
    client = plc.client()
    client.connect()
    plc.proxy.refuse()
    with pytest.raises(ConnectorError, match="closed the connection"):
        client.read()
    with pytest.raises(ConnectorError, match="connection refused by"):
        client.connect()
    assert_recovers(plc, client)


def test_unknown_host() -> None:
    client = S7Client(S7Options(host="no.such.host.invalid"), 201, SIZE)
    with pytest.raises(ConnectorError, match=r"'no.such.host.invalid' cannot be resolved"):
        client.connect()


def test_frozen_before_the_session(plc: Plc) -> None:
    plc.proxy.freeze()
    client = plc.client(timeout=50)
    with pytest.raises(ConnectorError, match=r"^no answer within 50 ms from 127.0.0.1:"):
        client.connect()
    plc.proxy.pass_all()
    client = plc.client()
    client.connect()
    assert client.read() == plc.block


def test_frozen_in_a_session(plc: Plc) -> None:
    client = plc.client(timeout=500)
    client.connect()
    assert client.read() == plc.block
    plc.proxy.freeze()
    with pytest.raises(ConnectorError, match=r"^no answer within 500 ms from"):
        client.read()
    assert_recovers(plc, client)


def test_dripping_peer_times_out(plc: Plc) -> None:
    """Each byte comes in time, but the time-out is that of the whole operation."""
    client = plc.client(packetSize=1, maxJobs=1, timeout=400)
    client.connect()
    plc.proxy.delay(0.0, 0.01)  # 2180 times 10 ms
    with pytest.raises(ConnectorError, match="no answer within 400 ms"):
        client.read()
    plc.proxy.delay(0.0, 0.0)
    assert not client.connected


# -- faults of the network ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reset", [False, True])
def test_cut_between_reads(plc: Plc, reset: bool) -> None:
    client = plc.client()
    client.connect()
    plc.proxy.cut(reset=reset)
    with pytest.raises(ConnectorError, match=r"closed the connection$"):
        client.read()
    assert_recovers(plc, client)


@pytest.mark.parametrize("count", [1, 24, 25, 26, 967, 1000, 2200])
def test_cut_in_the_middle_of_an_answer(plc: Plc, count: int) -> None:
    client = plc.client()
    client.connect()
    plc.proxy.cut_after(count)
    with pytest.raises(ConnectorError, match=r"closed the connection$"):
        client.read()
    assert_recovers(plc, client)


def test_late_answer_is_never_used_for_the_next_request(plc: Plc) -> None:
    client = plc.client(timeout=500)
    client.connect()
    plc.proxy.hold()
    with pytest.raises(ConnectorError, match="no answer within 500 ms"):
        client.read()
    assert plc.proxy.wait_held()
    plc.proxy.edit(lambda frame: frame)  # pass the new session, keep the held answers
    client.connect()
    plc.block[:] = bytes(SIZE)
    plc.proxy.release()  # the old answers, on the new connection
    with pytest.raises(ConnectorError, match="not in flight"):
        client.read()
    assert_recovers(plc, client)


def test_wrong_reference(plc: Plc) -> None:
    client = plc.client()
    client.connect()
    plc.proxy.rewrite_reference(lambda reference: reference + 100)
    with pytest.raises(ConnectorError, match="not in flight"):
        client.read()
    assert_recovers(plc, client)


def test_answer_sent_twice(plc: Plc) -> None:
    client = plc.client(packetSize=96)
    client.connect()
    plc.proxy.edit(lambda frame: frame * 2, frames=1)
    with pytest.raises(ConnectorError, match="not in flight"):
        client.read()
    assert_recovers(plc, client)


def test_extra_bytes_after_an_answer(plc: Plc) -> None:
    client = plc.client()
    client.connect()
    answers = 0

    def append(frame: bytes) -> bytes:
        nonlocal answers
        answers += 1
        return frame + b"\x03" if answers == 3 else frame

    plc.proxy.edit(append)

    def read_twice() -> None:  # a byte that comes late spoils the second read
        client.read()
        client.read()

    with pytest.raises(ConnectorError, match=r"frame of|not ISO-on-TCP"):
        read_twice()
    assert_recovers(plc, client)


@pytest.mark.parametrize(
    ("noise", "text"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n", "not an S7 controller"),
        (bytes(2000), "not an S7 controller"),
        (b"\x03\x00\xff\xff" + bytes(3000), "frame of 65535 bytes"),
        (b"\x03\x00\x00\x08\x02\xf0\x80\x32", "too short"),
        (b"\x03\x00\x00\x0b\x06\x80" + bytes(5), "ended the session"),
    ],
)
def test_garbage(plc: Plc, noise: bytes, text: str) -> None:
    client = plc.client()
    client.connect()
    plc.proxy.garble(noise)
    with pytest.raises(ConnectorError, match=text):
        client.read()
    assert_recovers(plc, client)


def test_garbage_without_end_takes_no_memory(plc: Plc) -> None:
    client = plc.client()
    client.connect()
    noise = b"\x03\x00\x03\xc7\x02\xf0\x80" * 1_000_000
    plc.proxy.garble(noise)
    tracemalloc.start()
    with pytest.raises(ConnectorError):
        client.read()
    client.connect()
    ours = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(True, "*/connectors/s7/*")])
    tracemalloc.stop()
    assert sum(trace.size for trace in ours.traces) < 100_000
    assert_recovers_open(plc, client)


def assert_recovers_open(plc: Plc, client: S7Client) -> None:
    plc.proxy.pass_all()
    assert client.read() == plc.block


# -- a controller that refuses -----------------------------------------------------------------------------------------


def test_block_shorter_than_the_layout(plc: Plc) -> None:
    client = plc.client(size=SIZE + 1)
    client.connect()
    wanted = rf"^DB201 does not have {SIZE + 1} bytes but {SIZE} bytes \(item code 0x05\): .*export it again"
    with pytest.raises(ConnectorError, match=wanted):
        client.read()
    assert not client.connected


def test_no_such_block(plc: Plc) -> None:
    client = plc.client(db_number=202)
    client.connect()
    with pytest.raises(ConnectorError, match=r"^DB202: the block does not exist \(item code 0x0A\).*optimized"):
        client.read()


CONFIRM = bytes.fromhex("0300000b 06 d0 0001 0007 00")
GRANT = bytes.fromhex("0300001b 02f080 32 03 0000 0000 0008 0000 00 00 f0 00 0001 0001 00f0")
NO_MODE = bytes.fromhex(
    "03000013 02f080 32 02 0000 0001 0000 0000 81 04"
)  # the answer to the query for the operating mode
DENIAL = bytes.fromhex("03000013 02f080 32 02 0000 0002 0000 0000 81 04")


def test_access_denied(scripted: Scripted) -> None:
    client = scripted(CONFIRM, GRANT, NO_MODE, DENIAL)
    client.connect()
    assert (client.pdu_size, client.jobs) == (240, 1)
    with pytest.raises(ConnectorError, match="enable 'Permit access with PUT/GET"):
        client.read()
    assert not client.connected


@pytest.mark.parametrize(
    ("answers", "text"),
    [
        ([], r"closed the connection during set-up: rack 0, slot 1 may be wrong"),
        ([CONFIRM], r"closed the connection during set-up"),
        ([b"SSH-2.0-OpenSSH_9.2\r\n"], "not an S7 controller"),
        ([bytes.fromhex("0300000b 06 80 0001 0007 00")], "refused the session"),
        ([CONFIRM + b"\x03", GRANT], "frame of|not ISO-on-TCP|unexpected"),
        ([CONFIRM, GRANT + b"\x04", NO_MODE], "not ISO-on-TCP"),
        ([CONFIRM, DENIAL], "PUT/GET"),
        ([CONFIRM, GRANT[:-1] + b"\x10"], "PDUs of only 16 bytes"),
        ([bytes.fromhex("030003ff")], "frame of 1023 bytes"),
    ],
)
def test_refused_session(scripted: Scripted, answers: list[bytes], text: str) -> None:
    client = scripted(*answers)
    with pytest.raises(ConnectorError, match=text):
        client.connect()
    assert not client.connected


ANSWER = bytes.fromhex("0300001d 02f080 32 03 0000 0002 0002 0008 0000 04 01 ff 04 0020 01020304")


def test_bytes_after_the_last_answer_end_the_session(scripted: Scripted) -> None:
    client = scripted(CONFIRM, GRANT, NO_MODE, ANSWER + b"\x04", size=4)
    client.connect()
    with pytest.raises(ConnectorError, match="not ISO-on-TCP"):
        client.read()
    assert not client.connected


def confirm(parameters: bytes, *, kind: int = 0xD0, indicator: int | None = None, length: int | None = None) -> bytes:
    """Return a connection confirm. Its lengths are correct unless they are given."""
    head = bytes(((6 + len(parameters)) & 255 if indicator is None else indicator, kind, 0, 1, 0, 7, 0))
    whole = 4 + len(head) + len(parameters) if length is None else length
    return struct.pack(">BxH", 3, whole) + head + parameters


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (confirm(bytes(600)), "frame of 611 bytes"),
        (confirm(b"", length=0xFFFF) + bytes(1 << 20), "frame of 65535 bytes"),
        (confirm(b"", length=0), "frame of 0 bytes"),
        (confirm(b"", length=4), "frame of 4 bytes"),
        (b"\x03\x00\x00\x08\x02\xf0\x80\x32", "COTP TPDU 0xF0"),
        (b"\x03\x00\x00\x07\x02\xd0\x80", "COTP TPDU 0xD0"),
        (b"\x03", "closed the connection during set-up"),
        (b"\x03\x00\x00", "closed the connection during set-up"),
        (confirm(b"")[:-1], "closed the connection during set-up"),
        (confirm(b"", indicator=0), "the wrong length"),
        (confirm(b"", indicator=255), "the wrong length"),
        (confirm(b"\xc0\x01\x00"), "TPDU size code 0"),
        (confirm(b"\xc0\x01\x06"), "TPDU size code 6"),
        (confirm(b"\xc0\x01\x11"), "TPDU size code 17"),
        (confirm(b"\xc0\x01\xff"), "TPDU size code 255"),
        (confirm(b"\xc1\xff\x00"), "closed the connection during set-up"),  # a parameter that is longer than the frame
        (confirm(b"\xc0\x00\xc0\x02\x0a\x0a\xc0"), "closed the connection during set-up"),
        (confirm(b"") * 50, "ROSCTR|not an answer|too short|unexpected"),
        (b"\x00" * 4000, "not ISO-on-TCP"),
    ],
)
def test_a_hostile_connection_confirm(scripted: Scripted, answer: bytes, text: str) -> None:
    client = scripted(answer)
    with pytest.raises(ConnectorError, match=text):
        client.connect()
    assert not client.connected


@given(st.binary(max_size=80), st.booleans())
def test_any_connection_confirm_is_refused_or_valid(parameters: bytes, framed: bool) -> None:
    answer = confirm(parameters) if framed else b"\x03\x00" + struct.pack(">H", 4 + len(parameters)) + parameters
    if len(answer) < FRAME_OVERHEAD:
        return
    try:
        size = parse_connect_confirm(memoryview(answer))
    except ConnectorError:
        return
    assert 128 <= size <= 65531


@pytest.mark.parametrize("answers", [(), (CONFIRM,), (CONFIRM, GRANT)])
def test_a_peer_that_falls_silent_at_any_point_of_the_set_up(answers: tuple[bytes, ...]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener, ExitStack() as stack:

        def play() -> None:
            peer = stack.enter_context(listener.accept()[0])
            for answer in answers:
                peer.recv(4096)
                peer.sendall(answer)

        thread = threading.Thread(target=play)
        thread.start()
        host, port = listener.getsockname()
        with closing(S7Client(S7Options(host=host, port=port, timeout=300), 201, SIZE)) as client:
            with pytest.raises(ConnectorError, match=r"^no answer within 300 ms from 127.0.0.1:"):
                client.connect()
            assert not client.connected
        thread.join()


def test_endless_input_during_the_set_up_takes_no_memory(scripted: Scripted) -> None:
    """Bytes after the connection confirm stay in the kernel's buffer."""
    client = scripted(CONFIRM + bytes.fromhex("03000007 02f080") * 200_000)
    tracemalloc.start()
    with pytest.raises(ConnectorError):
        client.connect()
    ours = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(True, "*/connectors/s7/*")])
    tracemalloc.stop()
    assert sum(trace.size for trace in ours.traces) < 100_000


@pytest.mark.parametrize(("db_number", "size"), [(0, 1), (65536, 1), (1, 0), (1, 65537)])
def test_block_outside_the_address_range_is_refused(db_number: int, size: int) -> None:
    with pytest.raises(ConfigError, match=f"^DB{db_number}"):
        S7Client(S7Options(host="plc"), db_number, size)
