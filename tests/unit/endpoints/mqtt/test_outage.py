"""A broker that disappears and returns: changes in between are kept, in order."""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from shmio.backoff import Backoff
from shmio.config import Address, MqttTls, MqttTopic
from shmio.segment import BlockWriter, Segment
from shmio.testing.mosquitto import Mosquitto
from shmio.testing.ports import reserved_port
from shmio.testing.proxy import FaultProxy
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.mqtt.harness import PREFIX, bridge, listening

AWAY = "nothing listens there"


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the back-off of a bridge that reconnects."""
    monkeypatch.setattr("shmio.endpoints.mqtt.connection.reconnect.RECONNECT", Backoff(0.02, 0.1))


def test_changes_are_kept_while_the_broker_is_away(segment: Segment, broker: Mosquitto) -> None:
    """The changes arrive in order with their times, marked as late. The current values arrive after them."""
    rules = [MqttTopic(match="cell/step", payload="json")]
    writer = segment.writer("cell")
    writer.publish(image(step=1), cycle=1)
    with (
        FaultProxy(broker.address, framing=None) as proxy,
        listening(broker.address) as listener,
        bridge(segment, proxy.address, topic=rules) as running,
    ):
        listener.until("cell/secret/out")
        running.until(lambda: not running.bridge.connection.in_flight)
        proxy.refuse()
        listener.until("status", b"offline")  # the last will
        running.until(lambda: AWAY in running.bridge.problem)
        for step in range(2, 12):
            writer.publish(image(step=step, position=step), cycle=step)
        running.until(lambda: running.bridge.outbox.backlog >= 20)
        assert "changes are kept" in running.bridge.problem
        proxy.admit()
        listener.until("status", b"online")
        stamps: list[float] = []
        while (message := listener.message()).topic != f"{PREFIX}/cell/secret/out":
            if message.topic == f"{PREFIX}/cell/axis/position/out":  # a text message has its time in a user property
                stamps += [float(text) for _, text in vars(message.properties).get("UserProperty", ())]
        running.until(lambda: not running.bridge.problem)
        assert running.bridge.outbox.dropped == 0
    told = [json.loads(value) for value in listener.values("cell/step/out")]
    assert [one["value"] for one in told] == [*range(1, 12), 11]
    assert [one.get("late", False) for one in told] == [False, *[True] * 10, False]
    times = [one["source_time"] for one in told]
    assert times == sorted(times)
    assert len(set(times)) == 11
    assert stamps == times[1:-1]
    assert listener.values("cell/axis/position/out")[1:] == [f"{step}.0" for step in [*range(2, 12), 11]]


class Load:
    """A source whose register step counts up with each frame."""

    def __init__(self, writer: BlockWriter) -> None:
        self.last = 0
        self._writer = writer
        writer.publish(image(), cycle=0)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            self.last += 1
            self._writer.publish(image(step=self.last, position=self.last), cycle=self.last)

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def __enter__(self) -> Load:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def test_a_connection_cut_repeatedly_loses_no_change(
    segment: Segment, make_broker: Callable[..., Mosquitto], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The source publishes all the time. The bridge sends changes again that the broker may have missed, in order."""
    # A busy host must not look like a slow broker, for which changes are conflated.
    monkeypatch.setattr("shmio.endpoints.mqtt.feed.CATCH_UP_S", 10.0)
    broker = make_broker("allow_anonymous true", "max_inflight_messages 10000")
    with (
        FaultProxy(broker.address, framing=None) as proxy,
        listening(broker.address, f"{PREFIX}/cell/step/out") as listener,
    ):
        load = Load(segment.writer("cell"))
        with bridge(segment, proxy.address) as running:
            for _ in range(20):
                for _ in range(25):
                    listener.message()
                connects = running.bridge.connection.connects
                proxy.cut(reset=True)
                running.until(lambda count=connects: running.bridge.connection.connects > count)
            load.stop()
            listener.until("cell/step/out", str(load.last).encode())
            assert running.bridge.outbox.dropped == 0
    first = list(dict.fromkeys(int(value) for value in listener.values("cell/step/out")))
    assert first == list(range(first[0], load.last + 1))


def test_the_bridge_reconnects_to_a_broker_killed_repeatedly(segment: Segment, broker: Mosquitto) -> None:
    load = Load(segment.writer("cell"))
    try:
        with bridge(segment, broker.address) as running:
            for _ in range(20):
                running.until(lambda: running.bridge.connection.up)
                broker.kill()
                running.until(lambda: AWAY in running.bridge.problem)
                broker.start()
            load.stop()
            running.until(lambda: running.bridge.connection.up and not running.bridge.outbox.busy)
            running.until(lambda: not running.bridge.connection.in_flight)
            assert running.bridge.outbox.dropped == 0
            with listening(broker.address, f"{PREFIX}/cell/step/out") as listener:
                assert listener.until("cell/step/out") == str(load.last).encode()
    finally:
        load.stop()


def test_another_client_misses_no_change_though_the_broker_is_killed_repeatedly(
    segment: Segment, make_broker: Callable[..., Mosquitto], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The test freezes the bridge's connection before each kill, so that the bridge gets no acknowledgement.

    A message that a broker has acknowledged and then lost cannot be sent again.
    """
    monkeypatch.setattr("shmio.endpoints.mqtt.feed.CATCH_UP_S", 10.0)
    broker = make_broker("allow_anonymous true", "max_inflight_messages 10000")
    filters = [f"{PREFIX}/{topic}" for topic in ("cell/step/out", "kill")]
    told: list[str] = []
    with (
        FaultProxy(broker.address, framing=None) as proxy,
        Load(segment.writer("cell")) as load,
        bridge(segment, proxy.address) as running,
    ):
        for kill in range(20):
            with listening(broker.address, *filters) as listener:
                proxy.admit()
                for _ in range(10):
                    listener.message()
                proxy.freeze()
                listener.publish("kill", str(kill))
                listener.until("kill")
                told += listener.values("cell/step/out")
                broker.kill()
                proxy.refuse()
                running.until(lambda: not running.bridge.connection.up)
            broker.start()
            proxy.thaw()
        with listening(broker.address, *filters) as listener:
            proxy.admit()
            load.stop()
            listener.until("cell/step/out", str(load.last).encode())
            told += listener.values("cell/step/out")
        assert running.bridge.outbox.dropped == running.bridge.counters[7] == 0
    first = list(dict.fromkeys(int(value) for value in told))
    assert first == list(range(first[0], load.last + 1))


def test_beyond_the_bound_the_oldest_changes_are_dropped_and_counted(segment: Segment, broker: Mosquitto) -> None:
    writer = segment.writer("cell")
    writer.publish(image(step=1), cycle=1)
    with bridge(segment, broker.address, backlog_mb=0.01) as running:
        with listening(broker.address) as listener:
            listener.until("cell/secret/out")
        broker.kill()
        running.until(lambda: AWAY in running.bridge.problem)
        for step in range(2, 302):
            writer.publish(image(step=step), cycle=step)
            running.until(lambda s=step: running.bridge.outbox.backlog + running.bridge.outbox.dropped >= s - 1)
        kept, dropped = running.bridge.outbox.backlog, running.bridge.outbox.dropped
        assert kept + dropped >= 300
        assert 0 < kept < 60
        assert f"{dropped} dropped" in running.bridge.problem
        broker.start()
        running.until(lambda: not running.bridge.problem and not running.bridge.outbox.busy)
        running.until(lambda: not running.bridge.connection.in_flight)
        with listening(broker.address, f"{PREFIX}/cell/step/out") as listener:
            assert listener.until("cell/step/out") == b"301"


def test_the_second_broker_is_used_if_the_first_is_absent(
    segment: Segment, make_broker: Callable[..., Mosquitto]
) -> None:
    broker = make_broker()
    segment.writer("cell").publish(image(step=1), cycle=1)
    with reserved_port() as nobody, bridge(segment, [nobody, broker.address]) as running:
        running.until(lambda: running.bridge.connection.up)
        with listening(broker.address) as listener:
            listener.until("cell/step/out", b"1")


def secret(folder: Path, text: str) -> str:
    file = folder / "password"
    file.write_text(text)
    file.chmod(0o600)
    return str(file)


def test_a_wrong_password_is_reported_until_the_file_has_the_right_one(
    segment: Segment, make_broker: Callable[..., Mosquitto], tmp_path: Path
) -> None:
    from shmio.config.credentials import hashed

    (tmp_path / "accounts").write_text(f"cell:{hashed('right')}\n")
    broker = make_broker("allow_anonymous false", f"password_file {tmp_path / 'accounts'}")
    segment.writer("cell").publish(image(step=1), cycle=1)
    file = secret(tmp_path, "wrong\n")
    with bridge(segment, broker.address, username="cell", password_file=file) as running:
        running.until(lambda: "mqtt.password_file" in running.bridge.problem)
        assert "refuses shmio's login" in running.bridge.problem
        assert "right" not in running.bridge.problem
        secret(tmp_path, "right\n")
        running.until(lambda: running.bridge.connection.up)
        assert not running.bridge.problem
        with listening(broker.address, username="cell", password="right") as listener:
            listener.until("cell/step/out", b"1")


class Answers:
    """A broker that sends the same bytes to each client, and disconnects."""

    def __init__(self, answer: bytes) -> None:
        self._answer = answer
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = Address("127.0.0.1", self._server.getsockname()[1])
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while True:
            connection, _ = self._server.accept()
            with connection:
                if not connection.recv(1000):
                    return
                connection.sendall(self._answer)

    def close(self) -> None:
        with socket.create_connection((self.address.host, self.address.port)):
            pass
        self._thread.join()
        self._server.close()


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (b"\x20\x03\x00\x97\x00", "it accepts no more connections at present"),
        (b"\x20\x03\x00\x89\x00", "it accepts no more connections at present"),
        (b"\x20\x03\x00\x85\x00", "it refuses the connection: Client identifier not valid"),
        (b"", "the connection was lost before the login: the broker is full"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "the connection was lost"),
        (b"\x20\xff\xff\xff\xff\xff\xff", "the connection was lost"),
        (b"\x30\x05\x00\x09ab", "the connection was lost"),
        (b"\x20\x02\x00\x05", "refuses shmio's login"),
    ],
)
def test_the_brokers_answer_is_reported(segment: Segment, answer: bytes, told: str) -> None:
    segment.writer("cell").publish(image(step=1), cycle=1)
    answers = Answers(answer)
    try:
        with bridge(segment, answers.address) as running:
            running.until(lambda: told in running.bridge.problem)
    finally:
        answers.close()


def test_a_host_that_accepts_but_never_answers_times_out(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.mqtt.connection.connection.CONNECT_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = Address("127.0.0.1", silent.getsockname()[1])
        with bridge(segment, address) as running:
            running.until(lambda: "does not answer" in running.bridge.problem)


def test_a_file_that_cannot_be_read_yet_blocks_nothing(
    segment: Segment, broker: Mosquitto, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """An example is a file on a network server that is down. Here the file is a pipe without a writer."""
    monkeypatch.setattr("shmio.endpoints.mqtt.connection.attempt.SLOW_S", 0.1)
    pipe = tmp_path / "ca.pem"
    os.mkfifo(pipe)
    writer = segment.writer("cell")
    writer.publish(image(step=1), cycle=1)
    with bridge(segment, broker.address, tls=MqttTls(ca=str(pipe))) as running:
        running.until(lambda: "no answer yet" in running.bridge.problem)
        writer.publish(image(step=2), cycle=2)
        running.until(lambda: running.bridge.outbox.backlog)  # the bridge continues
        with pipe.open("wb"):  # lets the waiting reader continue
            pipe.unlink()
        running.until(lambda: "mqtt.tls.ca" in running.bridge.problem)


def test_the_problem_of_each_of_several_brokers_is_reported(segment: Segment) -> None:
    with reserved_port() as one, reserved_port() as other, bridge(segment, [one, other]) as running:
        told = sorted(f"broker {address}: nothing listens there" for address in (one, other))
        running.until(lambda: running.bridge.problem == "; ".join(told))
