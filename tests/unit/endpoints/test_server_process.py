"""The questions to a server that the instance runs, at the beats of its process, by a clock of the test."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import suppress
from types import SimpleNamespace

import pytest

from shmio.endpoints import server_process
from shmio.endpoints.server_process import ASK_S, HANG_S, LATE_S, Liveness, Probe
from shmio.errors import EndpointError
from shmio.realtime import ProcessorTime
from shmio.worker import BEAT_S

PID = 1234


class Rig:
    """A server's side of the connections, and the clocks."""

    liveness: Liveness

    def __init__(self) -> None:
        self.now_s, self.waited_s = 1000.0, 500.0
        self.connections: list[socket.socket] = []
        self.refuses = self.is_full = False

    def connect(self) -> socket.socket:
        if self.refuses:
            raise ConnectionRefusedError
        if self.is_full:
            raise TimeoutError
        ours, theirs = socket.socketpair()
        theirs.setblocking(False)
        self.connections.append(theirs)
        return ours

    def beat(self, for_s: float = BEAT_S, *, starved: float = 0.0) -> str:
        """Check after a time, for a part of which the server has waited for a processor; return the problem."""
        self.now_s += for_s
        self.waited_s += for_s * starved
        self.liveness.check(PID)
        return self.liveness.problem

    def asked(self) -> bytes:
        """Return the next question, which comes after ``ASK_S``."""
        begin_s, found = self.now_s, b""
        while not found:
            self.beat()
            with suppress(IndexError, BlockingIOError):
                found = self.connections[-1].recv(100)
        assert ASK_S - BEAT_S <= self.now_s - begin_s <= ASK_S + 2 * BEAT_S
        return found

    def beats_until_it_hangs(self, **how: float) -> float:
        """Return how long the server, which gives no answer, is watched, in s."""
        begin_s = self.now_s
        with suppress(EndpointError):
            while self.now_s - begin_s < 20 * HANG_S and not self.liveness.hangs:
                self.beat(**how)
        assert self.liveness.hangs
        return self.now_s - begin_s


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    rig = Rig()
    monkeypatch.setattr(server_process, "time", SimpleNamespace(monotonic=lambda: rig.now_s))
    used = SimpleNamespace(of=lambda pid: ProcessorTime(0, round(rig.waited_s * 1e9) if pid == PID else 0))
    monkeypatch.setattr(server_process, "ProcessorTime", used)
    rig.liveness = Liveness("the server", Probe(rig.connect, b"hello", b"ping"))
    yield rig
    rig.liveness.close()
    for connection in rig.connections:
        connection.close()


def test_it_asks_again_and_again_over_one_connection(rig: Rig) -> None:
    for number in range(20):
        assert rig.asked() == (b"ping" if number else b"hello")
        rig.connections[0].send(b"yes")
        assert rig.beat(LATE_S) == ""
    assert len(rig.connections) == 1


def test_a_late_answer_is_a_problem_until_it_comes(rig: Rig) -> None:
    assert rig.asked() == b"hello"
    assert [rig.beat(LATE_S / 4) for _ in range(3)] == [""] * 3
    assert "the server has not answered for" in rig.beat(LATE_S / 4)
    rig.connections[0].send(b"yes")
    assert rig.beat() == ""
    assert rig.asked() == b"ping"
    assert rig.beat() == "", "the time before the answer does not count"


def test_a_server_that_never_answers_hangs(rig: Rig) -> None:
    rig.asked()
    assert rig.beats_until_it_hangs() == pytest.approx(HANG_S, abs=2 * BEAT_S)


def test_a_server_that_gets_no_processor_does_not_hang(rig: Rig) -> None:
    """Only the time counts in which it could have answered: a tenth of it here, after the answer was late."""
    rig.asked()
    in_time_s = HANG_S - LATE_S
    assert rig.beats_until_it_hangs(starved=0.9) == pytest.approx(LATE_S + in_time_s / 0.1, rel=0.1)


def test_a_pause_of_both_processes_does_not_count(rig: Rig) -> None:
    """As when the host was suspended."""
    rig.asked()
    for _ in range(3):
        assert "the server has not answered for" in rig.beat(3600.0)
    rig.connections[0].send(b"yes")
    assert rig.beat() == ""


@pytest.mark.parametrize("full", [False, True], ids=["no answer yet", "no connection yet"])
def test_the_time_before_the_question_does_not_count(rig: Rig, *, full: bool) -> None:
    """As when the host was suspended while no answer was due."""
    rig.is_full = full
    assert rig.beat(3600.0) == ""
    assert rig.beat() == ""
    assert "the server has not answered for 1 s" in rig.beat(LATE_S)


def test_a_connection_that_the_server_closes_or_refuses_is_an_answer(rig: Rig) -> None:
    rig.asked()
    rig.connections[0].shutdown(socket.SHUT_RDWR)
    assert rig.beat() == ""
    assert rig.asked() == b"hello", "over a new connection"
    rig.connections[1].shutdown(socket.SHUT_RDWR)
    rig.beat()
    rig.refuses = True
    for _ in range(10):
        assert rig.beat(ASK_S) == ""
    assert len(rig.connections) == 2
    rig.refuses = False
    assert rig.asked() == b"hello"
