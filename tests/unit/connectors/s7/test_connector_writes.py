"""Writing over real sockets: each outcome is true, and any doubt ends the connection."""

from __future__ import annotations

import re
import socket
import threading
import time

import pytest

from shmio.connectors.base import Lost, WriteLostError
from shmio.connectors.s7.connector import S7Client, S7Connector, S7Options
from shmio.emulators.s7 import Fault, ServerOptions
from shmio.errors import ConnectorError
from shmio.layout.model import Layout, Register
from shmio.layout.values.write import Write
from tests.unit.connectors.s7.harness import SIZE, MakePlc, Plc, assert_recovers


class Clock:
    """The real clock plus an offset, so that answers seem to take seconds without any waiting."""

    def __init__(self) -> None:
        self._moved_ns = 0

    def monotonic_ns(self) -> int:
        return time.monotonic_ns() + self._moved_ns

    def move(self, by_s: int) -> None:
        self._moved_ns += by_s * 10**9

    def slow_down(self, plc: Plc, answer_s: int) -> None:
        """Make each answer to a write seem to take ``answer_s`` seconds. Other answers take no time."""

        def pass_on(frame: bytes) -> bytes:
            if frame[8] == 3 and frame[19] == 5:  # an answer to a job, which writes
                self.move(answer_s)
            return frame

        plc.proxy.edit(pass_on)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr("shmio.connectors.s7.session.time", made)
    monkeypatch.setattr("shmio.connectors.s7.transport.time", made)
    return made


def image(client: S7Client) -> bytes:
    collected = client.collect(time.monotonic_ns() + 10**10)
    assert collected is not None
    return collected


@pytest.mark.parametrize("pdu_size", [240, 480, 960])
@pytest.mark.parametrize("jobs", [1, 3, 24])
def test_written_values_are_read_back(make_plc: MakePlc, pdu_size: int, jobs: int) -> None:
    plc = make_plc(ServerOptions(max_pdu_size=pdu_size, max_jobs=jobs))
    client = plc.connected()
    whole = bytes(range(256)) * 8 + bytes(SIZE - 2048)
    assert client.write([Write(0, 0, whole)]) == [""]
    assert client.read() == whole == plc.block
    writes = [Write(3, 0, b"abc"), Write(10, 1 << 7, b"\x80"), Write(10, 1, b"\xfe"), Write(SIZE - 1, 0, b"z")]
    assert client.write(writes) == [""] * 4
    assert client.read() == plc.block
    assert plc.block[:12] + plc.block[-1:] == b"\0\1\2abc\6\7\x08\x09\x8a\x0bz"


def test_nothing_to_write(plc: Plc) -> None:
    assert plc.connected().write([]) == []


def test_bit_write_leaves_the_other_bits_to_the_program(plc: Plc) -> None:
    """The PLC's program counts in the other bits of the byte all the time. No count may be lost."""
    client = plc.connected()
    plc.block[7] = 0
    stopping = threading.Event()
    counted = 0

    def count() -> None:
        nonlocal counted
        while not stopping.is_set():
            with plc.server.lock:
                plc.block[7] = plc.block[7] & 0x10 | (counted + 1 & 0x0F) | (counted + 1 & 0x70) << 1
            counted += 1

    thread = threading.Thread(target=count)
    thread.start()
    for turn in range(200):
        assert client.write([Write(7, 0x10, b"\x10" if turn & 1 else b"\xef")]) == [""]
        assert plc.block[7] & 0x10 == (0x10 if turn & 1 else 0)
    stopping.set()
    thread.join()
    assert plc.block[7] & 0xEF == counted & 0x0F | (counted & 0x70) << 1


def test_a_write_passes_between_reads_under_way(make_plc: MakePlc) -> None:
    plc = make_plc(ServerOptions(max_pdu_size=480, max_jobs=10))
    client = plc.connected()
    before = bytes(plc.block)
    client.submit()
    client.submit()
    assert client.write([Write(0, 0, b"new"), Write(2000, 0, b"new")]) == ["", ""]
    assert image(client)[3:2000] == before[3:2000]
    assert image(client)[3:2000] == before[3:2000]
    client.submit()
    assert image(client) == b"new" + before[3:2000] + b"new" + before[2003:]


def test_a_refused_item_among_good_ones(plc: Plc) -> None:
    """The controller refuses a write beyond the end of the block, and carries out the others."""
    client = plc.connected(size=SIZE)
    outcomes = client.write([Write(0, 0, b"one"), Write(SIZE, 0, b"two"), Write(9, 2, b"\2")])
    assert [outcomes[0], outcomes[2]] == ["", ""]
    assert outcomes[1].startswith(f"DB201 has no byte {SIZE + 2} (item code 0x05): the layout is of another version")
    assert plc.block[:3] == b"one"
    assert client.read() == plc.block


@pytest.mark.parametrize(
    ("fault", "text"), [(Fault.WRITE_PROTECTED, r"0x03.*'Full access'"), (Fault.PUT_GET_OFF, r"0x8104.*PUT/GET")]
)
def test_controller_that_refuses_writes(make_plc: MakePlc, fault: Fault, text: str) -> None:
    plc = make_plc(ServerOptions(fault=fault))
    before = bytes(plc.block)
    client = plc.connected()
    for outcome in client.write([Write(0, 0, b"one"), Write(9, 2, b"\2")]):
        assert re.search(text, outcome)
    assert client.connected
    assert plc.block == before


def test_an_answer_to_another_request(plc: Plc) -> None:
    client = plc.connected()
    plc.proxy.rewrite_reference(lambda reference: reference + 100)
    with pytest.raises(ConnectorError, match="not in flight"):
        client.write([Write(0, 0, b"x")])
    assert_recovers(plc, client)


def test_an_answer_for_fewer_items(plc: Plc) -> None:
    client = plc.connected()

    def shorten(frame: bytes) -> bytes:
        return frame[:3] + bytes((len(frame) - 1,)) + frame[4:16] + b"\1" + frame[17:20] + b"\1" + frame[21:-1]

    plc.proxy.edit(shorten, frames=1)
    with pytest.raises(ConnectorError, match="1 return codes, but 2 items were written"):
        client.write([Write(0, 0, b"x"), Write(2, 0, b"y")])
    assert_recovers(plc, client)


def test_late_answer_is_never_used_for_the_next_request(plc: Plc) -> None:
    client = plc.connected(timeout=300)
    plc.proxy.hold()
    with pytest.raises(ConnectorError, match="no answer within 300 ms"):
        client.write([Write(0, 0, b"x")])
    assert plc.proxy.wait_held()
    plc.proxy.edit(lambda frame: frame)  # pass the new session, keep the held answer
    client.connect()
    plc.proxy.release()  # the old confirmation, on the new connection
    with pytest.raises(ConnectorError, match="not in flight"):
        client.write([Write(SIZE, 0, b"y")])  # this write would be refused
    assert_recovers(plc, client)


@pytest.mark.parametrize("count", [0, 1, 21, 30])
def test_the_connection_is_lost_in_mid_write(make_plc: MakePlc, count: int) -> None:
    plc = make_plc(ServerOptions(max_pdu_size=240, max_jobs=3))
    client = plc.connected()
    if count:
        plc.proxy.cut_after(count)
    else:
        plc.proxy.cut(reset=True)
    with pytest.raises(ConnectorError, match="closed the connection"):
        client.write([Write(0, 0, bytes(SIZE))])
    with pytest.raises(ConnectorError, match="not connected"):
        client.write([Write(0, 0, b"x")])
    assert_recovers(plc, client)


@pytest.mark.parametrize("jobs", [1, 2])
def test_outcome_of_each_write_after_a_lost_connection(make_plc: MakePlc, jobs: int) -> None:
    """Each answer lets the next job be sent. Jobs after those under way were therefore never sent."""
    plc = make_plc(ServerOptions(max_pdu_size=240, max_jobs=jobs))
    client = plc.connected(timeout=300)
    writes = [Write(SIZE, 0, b"?"), *(Write(at, 0, b"\xee" * 200) for at in range(0, 2000, 200))]  # a job each
    before = bytes(plc.block)
    answered = 0

    def cut_at_the_third(frame: bytes) -> bytes | None:
        nonlocal answered
        answered += frame[8] == 3 and frame[19] == 5
        return None if answered >= 3 else frame

    plc.proxy.edit(cut_at_the_third)
    with pytest.raises(WriteLostError, match="no answer within 300 ms") as lost:
        client.write(writes)
    assert isinstance(lost.value.outcomes[0], str)
    assert "no byte" in lost.value.outcomes[0]
    assert lost.value.outcomes[1:] == ("", *[Lost.UNKNOWN] * jobs, *[Lost.UNSENT] * (9 - jobs))
    assert_recovers(plc, client)
    unsent = 200 * (1 + jobs)
    assert plc.block[:200] == b"\xee" * 200
    assert plc.block[unsent:] == before[unsent:]


def test_writes_on_a_reset_connection_were_not_sent(plc: Plc, monkeypatch: pytest.MonkeyPatch) -> None:
    client = plc.connected()
    before = bytes(plc.block)

    def reset(_: socket.socket, __: bytes) -> int:
        raise ConnectionResetError

    with monkeypatch.context() as patch:
        patch.setattr("socket.socket.send", reset)
        with pytest.raises(WriteLostError, match="closed the connection") as lost:
            client.write([Write(0, 0, b"one"), Write(9, 2, b"\2")])
    assert lost.value.outcomes == (Lost.UNSENT, Lost.UNSENT)
    assert_recovers(plc, client)
    assert plc.block == before


def test_partly_sent_job_has_an_unknown_outcome(plc: Plc, monkeypatch: pytest.MonkeyPatch) -> None:
    client = plc.connected()
    send = socket.socket.send
    sent: list[int] = []

    def send_once(to: socket.socket, data: bytes) -> int:
        if sent:
            raise ConnectionResetError
        sent.append(send(to, bytes(data)[:5]))
        return sent[0]

    with monkeypatch.context() as patch:
        patch.setattr("socket.socket.send", send_once)
        with pytest.raises(WriteLostError) as lost:
            client.write([Write(0, 0, b"one")])
    assert lost.value.outcomes == (Lost.UNKNOWN,)
    assert_recovers(plc, client)


def test_without_a_session_nothing_is_sent(plc: Plc) -> None:
    with pytest.raises(WriteLostError, match="not connected") as lost:
        plc.client().write([Write(0, 0, b"x")] * 2)
    assert lost.value.outcomes == (Lost.UNSENT,) * 2


def test_refused_read_does_not_affect_a_write(make_plc: MakePlc) -> None:
    """The outcome of the write is known and returned. The refused read then ends the connection."""
    plc = make_plc(ServerOptions(block_size=1000))
    client = plc.connected()
    client.submit()
    assert client.write([Write(0, 0, b"x")]) == [""]
    with pytest.raises(ConnectorError, match="DB201 does not have 2180 bytes but 1000 bytes"):
        client.collect(time.monotonic_ns() + 10**10)
    assert not client.connected


SCATTERED = [Write(2 * place, 1 << place % 8, b"\xff") for place in range(60)]  # three jobs


def test_slow_controller_does_not_time_out(make_plc: MakePlc, clock: Clock) -> None:
    """Each answer may take the whole time-out. Reads that wait behind writes do not count as late."""
    plc = make_plc(ServerOptions(max_jobs=1))
    client = plc.connected(timeout=5000)
    clock.slow_down(plc, 4)
    clock.move(2)
    client.submit()  # three more jobs, of which one is under way, and the query for the operating mode
    assert client.write(SCATTERED) == [""] * 60
    submitted = threading.Event()
    plc.proxy.edit(
        lambda frame: frame if frame[8] != 7 or submitted.wait(10) else None
    )  # 7: the answer to the query for the mode
    assert client.collect(clock.monotonic_ns() + 10**10) is not None
    client.submit()
    submitted.set()
    assert client.collect(clock.monotonic_ns() + 10**10) == bytes(plc.block)
    assert all(plc.block[write.offset] & write.mask for write in SCATTERED)


@pytest.mark.parametrize(("timeout_s", "most_s"), [(5, 20), (30, 30)])
def test_duration_of_a_batch_is_bounded(make_plc: MakePlc, clock: Clock, timeout_s: int, most_s: int) -> None:
    """Otherwise the supervisor would consider the source's process hung, because a call does not return."""
    plc = make_plc(ServerOptions(max_jobs=1))
    client = plc.connected(timeout=1000 * timeout_s)
    clock.slow_down(plc, 4)
    with pytest.raises(ConnectorError, match=f"has not answered all writes of a cycle within {most_s} s; write fewer"):
        client.write([Write(2 * place, 1, b"\1") for place in range(180)])  # nine jobs
    assert_recovers(plc, client)


@pytest.mark.parametrize(("timeout", "longest_s"), [(2000, 20), (20_500, 20.5)])
def test_timeout_of_the_connector_covers_a_batch(timeout: int, longest_s: float) -> None:
    layout = Layout("DB201", 201, 2, False, (Register("a", "INT", (), 0, None, 2, 1),))
    assert S7Connector(S7Options(host="192.0.2.1", timeout=timeout), layout).timeout_s == longest_s
