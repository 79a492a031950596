"""How the client diagnoses a controller that refuses reads or is not running."""

from __future__ import annotations

import threading
import time
from contextlib import closing

import pytest
import snap7

from shmio.connectors.s7 import S7Client, mode
from shmio.emulators.s7 import Fault, S7Server, ServerOptions
from shmio.errors import ConnectorError
from tests.unit.connectors.s7.harness import SIZE, MakePlc, Plc


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (ServerOptions(fault=Fault.PUT_GET_OFF), r"\(error 0x8104\); enable 'Permit access with PUT/GET"),
        (ServerOptions(fault=Fault.PROTECTED), r"DB201: access denied \(item code 0x03\).*'Full access'"),
        (
            ServerOptions(fault=Fault.OPTIMIZED),
            r"DB201 has no byte that can be addressed.*clear 'Optimized block",
        ),
        (ServerOptions(block_size=1), r"DB201 does not have 2180 bytes but 1 bytes .*export it again"),
        (ServerOptions(block_size=SIZE - 1), r"DB201 does not have 2180 bytes but 2179 bytes"),
        (ServerOptions(block_size=963, max_pdu_size=240, max_jobs=1), r"DB201 does not have 2180 bytes but 963 bytes"),
        (
            ServerOptions(block_size=1234, max_pdu_size=240, max_jobs=24),
            r"DB201 does not have 2180 bytes but 1234",
        ),
    ],
)
def test_refusal_is_reported_with_a_remedy(make_plc: MakePlc, options: ServerOptions, text: str) -> None:
    client = make_plc(options).connected()
    for _ in range(client.depth):
        client.submit()
    with pytest.raises(ConnectorError, match=text):
        client.collect(1 << 62)
    assert not client.connected


def test_refusal_is_reported_if_the_size_cannot_be_found(make_plc: MakePlc) -> None:
    plc = make_plc(ServerOptions(block_size=500))
    client = plc.connected(timeout=300)
    answers = 0

    def only_the_read(frame: bytes) -> bytes | None:
        nonlocal answers
        answers += 1
        return frame if answers <= 3 else None

    plc.proxy.edit(only_the_read)
    with pytest.raises(ConnectorError, match=r"^DB201 does not have 2180 bytes \(item code 0x05\).*export it again"):
        client.read()
    assert not client.connected


# -- operating mode ----------------------------------------------------------------------------------------------------


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the client ask for the operating mode with every read."""
    monkeypatch.setattr(mode, "INTERVAL_NS", 0)


def read_until(client: S7Client, *, doubt: bool) -> str:
    for _ in range(10):
        client.read()
        if bool(client.doubt) == doubt:
            return client.doubt
    raise AssertionError(f"still {client.doubt!r}")


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("jobs", [1, 8])
def test_stop_and_run_are_noticed(make_plc: MakePlc, jobs: int) -> None:
    plc = make_plc(ServerOptions(max_jobs=jobs))
    client = plc.connected()
    peer = snap7.Client()
    peer.connect(plc.server.address.host, 0, 1, plc.server.address.port)
    for _ in range(2):
        assert read_until(client, doubt=False) == ""
        peer.plc_stop()
        assert "the PLC is in STOP: its program does not run; switch it to RUN" in read_until(client, doubt=True)
        peer.plc_hot_start()
    peer.disconnect()
    peer.destroy()


def test_stop_is_known_before_the_first_image(plc: Plc) -> None:
    peer = snap7.Client()
    peer.connect(plc.server.address.host, 0, 1, plc.server.address.port)
    peer.plc_stop()
    client = plc.connected()
    assert "in STOP" in client.doubt
    assert client.read() == plc.block
    client.close()
    assert client.doubt == ""
    peer.disconnect()
    peer.destroy()


def test_mode_is_not_asked_with_every_read(plc: Plc) -> None:
    asked = 0

    def count(frame: bytes) -> bytes:
        nonlocal asked
        asked += frame[8] == 7
        return frame

    plc.proxy.edit(count)
    client = plc.connected()
    for _ in range(100):
        client.read()
    assert asked == 1


class Ignorant(S7Server):
    """A controller that answers that it has no system status lists."""

    def _get_szl_data(self, szl_id: int, szl_index: int) -> bytes | None:
        return None


class Touchy(S7Server):
    """A controller that closes the connection when it receives an unknown request."""

    def _process_request(self, request_data: bytes, client_address: tuple[str, int]) -> bytes | None:
        return None


@pytest.mark.usefixtures("often")
def test_a_controller_without_a_mode(make_plc: MakePlc) -> None:
    plc = make_plc(ServerOptions(), Ignorant)
    client = plc.connected()
    for _ in range(5):
        assert client.read() == plc.block
        assert client.doubt == ""


@pytest.mark.usefixtures("often")
def test_a_controller_that_hangs_up_when_asked(make_plc: MakePlc) -> None:
    plc = make_plc(ServerOptions(), Touchy)
    client = plc.client()
    for _ in range(2):
        with pytest.raises(ConnectorError, match="closed the connection"):
            client.connect()
    client.connect()
    for _ in range(5):
        assert client.read() == plc.block


@pytest.mark.usefixtures("often")
def test_a_controller_that_is_silent_when_asked(plc: Plc) -> None:
    plc.proxy.edit(lambda frame: None if frame[8] == 7 else frame)
    client = plc.client(timeout=200)
    for _ in range(2):
        with pytest.raises(ConnectorError, match="no answer within 200 ms"):
            client.connect()
    client.connect()
    for _ in range(5):
        assert client.read() == plc.block


def test_unanswered_mode_query_ends_the_session(plc: Plc, monkeypatch: pytest.MonkeyPatch) -> None:
    """The controller has answered such queries before, so the connection is faulty. Reads alone do not show that."""
    client = plc.connected(timeout=200)
    monkeypatch.setattr(mode, "INTERVAL_NS", 0)
    plc.proxy.edit(lambda frame: None if frame[8] == 7 else frame)

    def read_on() -> None:
        while True:
            client.read()

    with pytest.raises(ConnectorError, match="no answer within 200 ms"):
        read_on()
    plc.proxy.pass_all()
    client.connect()
    assert client.read() == plc.block


def test_mode_answer_that_waited_through_a_long_period_is_in_time(plc: Plc, monkeypatch: pytest.MonkeyPatch) -> None:
    """The client does not receive between two reads, while the clock moves beyond the time-out."""
    monkeypatch.setattr(mode, "INTERVAL_NS", 0)
    client = plc.connected()
    answered = threading.Event()

    def see(frame: bytes) -> bytes:
        if frame[8] == 7:
            answered.set()
        return frame

    plc.proxy.edit(see)
    client.read()
    assert answered.wait(10)
    now_ns = time.monotonic_ns
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns() + 10**10)
    assert client.read() == plc.block


def test_wrong_answer_to_the_mode_query(plc: Plc) -> None:
    plc.proxy.edit(lambda frame: frame[:22] + b"\x44" + frame[23:] if frame[8] == 7 else frame)
    with closing(plc.client()) as client, pytest.raises(ConnectorError, match="not an answer to 'read SZL'"):
        client.connect()
