"""The emulated controller as a whole, seen by a client."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import pytest
import snap7

from shmio.config.address import Address
from shmio.connectors.s7 import S7Client, S7Options
from shmio.emulators.emulator import Emulator
from shmio.emulators.programs import generations
from shmio.emulators.s7 import ServerOptions
from shmio.errors import ConfigError, EndpointError
from shmio.layout.model import Layout
from shmio.layout.values.write import Write

LOOPBACK = Address("127.0.0.1", 0)


@pytest.fixture
def counter(db201: Layout) -> Iterator[Emulator]:
    before = set(threading.enumerate())
    with Emulator(db201, "counter", LOOPBACK) as emulator:
        yield emulator
    assert set(threading.enumerate()) <= before
    assert emulator.cycle.failure is None


def client_of(emulator: Emulator, size: int = 2180, number: int = 201) -> S7Client:
    return S7Client(S7Options(host=emulator.address.host, port=emulator.address.port), number, size)


def test_pdu_never_mixes_program_cycles(counter: Emulator) -> None:
    """Two clients read as fast as they can while the program runs at 1 kHz."""
    seen: set[int] = set()
    with closing(client_of(counter, 936)) as first, closing(client_of(counter, 936)) as second:
        first.connect()
        second.connect()
        while len(seen) < 100:
            for client in (first, second):
                found = generations(client.read())
                assert len(found) == 1
                seen.update(found)


def test_a_read_of_several_pdus_mixes_at_most_neighbouring_cycles(counter: Emulator) -> None:
    last = 0
    with closing(client_of(counter)) as client:
        client.connect()
        while last < 100:
            found = generations(client.read())
            assert len(found) <= 3
            assert found[0] >= last
            last = found[-1]


def test_program_follows_its_schedule(counter: Emulator) -> None:
    with closing(client_of(counter)) as client:
        client.connect()
        while (generation := generations(client.read())[-1]) < 50:
            pass
    assert counter.cycle.cycles + counter.cycle.overruns >= generation


def test_stopping_the_cpu_stops_the_program_and_not_the_server(counter: Emulator) -> None:
    peer = snap7.Client()
    peer.connect(counter.address.host, 0, 1, counter.address.port)
    with closing(client_of(counter)) as client:
        client.connect()
        peer.plc_stop()
        client.read()  # a cycle under way ends before this read does
        stopped = client.read()
        assert len(generations(stopped)) == 1
        assert all(client.read() == stopped for _ in range(100))
        peer.plc_hot_start()
        while client.read() == stopped:
            pass
    peer.disconnect()
    peer.destroy()


def test_first_cycle_ends_before_the_first_client_connects(db201: Layout) -> None:
    with Emulator(db201, "a50", LOOPBACK) as emulator, closing(client_of(emulator)) as client:
        client.connect()
        assert client.read()[1002:1004] == b"\x00\x0a"


def test_clients_can_write_registers_that_the_program_does_not_drive(db201: Layout) -> None:
    with Emulator(db201, "a50", LOOPBACK) as emulator, closing(client_of(emulator)) as client:
        client.connect()
        peer = snap7.Client()
        peer.connect(emulator.address.host, 0, 1, emulator.address.port)
        peer.db_write(201, 1050, bytearray(b"command"))
        cycles = emulator.cycle.cycles
        while emulator.cycle.cycles < cycles + 2:
            assert client.read()[1050:1057] == b"command"
        peer.disconnect()
        peer.destroy()


def test_db_number_from_the_layout_or_given(db201: Layout) -> None:
    unnumbered = replace(db201, number=None)
    with pytest.raises(ConfigError, match="dbNumber"):
        Emulator(unnumbered, "a50", LOOPBACK)
    with (
        Emulator(unnumbered, "a50", LOOPBACK, db_number=7) as emulator,
        closing(client_of(emulator, number=7)) as client,
    ):
        client.connect()
        assert len(client.read()) == 2180


def test_unknown_program(db201: Layout) -> None:
    with pytest.raises(ConfigError, match=r"unknown program 'a51'; did you mean 'a50'"):
        Emulator(db201, "a51", LOOPBACK)


def test_address_taken(counter: Emulator, db201: Layout) -> None:
    second = Emulator(db201, "a50", counter.address)
    with pytest.raises(EndpointError, match=f"cannot listen on {counter.address}"):
        second.start()
    second.stop()


def test_a_failing_program_is_reported(db201: Layout, monkeypatch: pytest.MonkeyPatch) -> None:
    failed = threading.Event()

    class Failing:
        period_ms = 1

        def __init__(self, layout: Layout) -> None: ...

        def step(self, time_s: float, frame: bytearray) -> None:
            if time_s:
                failed.set()
                raise ZeroDivisionError

    monkeypatch.setattr("shmio.emulators.programs.PROGRAMS", {"failing": Failing})
    with Emulator(db201, "failing", LOOPBACK) as emulator:
        assert failed.wait(10)
    assert isinstance(emulator.cycle.failure, ZeroDivisionError)


def test_traits_reach_the_client_and_commands_reach_the_program(db201: Layout) -> None:
    """A client commands a hold: the cell stops all motion, and reports it."""
    with (
        Emulator(db201, "a50", LOOPBACK, options=ServerOptions(max_pdu_size=480, max_jobs=6)) as emulator,
        closing(client_of(emulator)) as client,
    ):
        client.connect()
        assert (client.pdu_size, client.jobs, client.depth) == (480, 6, 1)
        assert client.write([Write(1013, 1, b"\1")]) == [""]
        while not client.read()[1001] & 8:
            pass
        stands = client.read()[2100:]
        cycles = emulator.cycle.cycles
        while emulator.cycle.cycles < cycles + 20:
            assert client.read()[2100:] == stands
        assert client.write([Write(1013, 1, b"\0")]) == [""]
        while client.read()[2100:] == stands:
            pass
