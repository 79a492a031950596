"""Virtual time: a step is done when the broker has received all its changes and its marker."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from shmio.local.time_control import Coordinator
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from shmio.testing.mosquitto import Mosquitto
from shmio.testing.proxy import FaultProxy
from tests.unit.endpoints.harness import STALE_NS
from tests.unit.endpoints.mqtt.harness import PREFIX, TIMEOUT_S, Listener, bridge, listening
from tests.unit.endpoints.stepped import LAYOUT, Model

MARK = f"{PREFIX}/simlog/step"


@contextmanager
def _models(instance: str, *sources: str, virtual: bool = True) -> Iterator[list[Model]]:
    attributes = Attributes("simulation", ("goal",), stepped=True)
    blocks = [BlockSpec(source, LAYOUT, 20_000_000, STALE_NS, 1 << 20, attributes) for source in sources]
    processes = [*(ProcessSpec(source, "source") for source in sources), ProcessSpec("mqtt", "mqtt")]
    with Segment.create(instance, blocks, processes, stepped=virtual) as segment:
        models = [Model(segment, source) for source in sources]
        try:
            yield models
        finally:
            for model in models:
                model.stop()
            segment.unlink()


@pytest.fixture
def models(instance: str) -> Iterator[Segment]:
    with _models(instance, "one", "two"), Segment.open(instance, writable=True) as segment:
        yield segment


@contextmanager
def coordinator(segment: Segment) -> Iterator[Coordinator]:
    with Segment.open(segment.instance, writable=True) as opened:
        moving = Coordinator(opened, hard_s=TIMEOUT_S)
        try:
            yield moving
        finally:
            moving.close()


def changes(listener: Listener) -> list[tuple[str, bytes]]:
    """Return the messages up to and including the next marker."""
    found = []
    while True:
        message = listener.message()
        found.append((message.topic.removeprefix(f"{PREFIX}/"), bytes(message.payload)))
        if message.topic == MARK:
            return found


def test_a_step_is_delivered_whole_and_in_order(models: Segment, broker: Mosquitto) -> None:
    with (
        listening(broker.address) as listener,
        bridge(models, broker.address) as running,
        coordinator(models) as time,
    ):
        listener.until("two/row/out")
        for number in (1, 2, 3):
            step = time.step()
            assert running.bridge.steps.done == step.number  # already now, not only soon
            came = changes(listener)
            assert [topic for topic, _ in came] == [
                *(f"{source}/{name}/out" for source in ("one", "two") for name in ("count", "doubled", "row")),
                "simlog/step",
            ]
            assert came[0][1] == str(number).encode()
            assert json.loads(came[-1][1]) == {"step": number, "time_s": step.time_ns / 1e9}


def test_each_of_many_steps_is_published(models: Segment, broker: Mosquitto) -> None:
    with listening(broker.address) as listener, bridge(models, broker.address), coordinator(models) as time:
        listener.until("two/row/out")
        for _ in range(200):
            time.step()
        for number in range(1, 201):
            assert ("two/doubled/out", str(2 * number).encode()) in changes(listener)


def test_a_broker_that_is_away_delays_no_step(models: Segment, broker: Mosquitto) -> None:
    """The bridge keeps the changes of the steps for the broker."""
    with (
        FaultProxy(broker.address, framing=None) as proxy,
        listening(broker.address) as listener,
        bridge(models, proxy.address) as running,
        coordinator(models) as time,
    ):
        listener.until("two/row/out")
        proxy.refuse()
        running.until(lambda: bool(running.bridge.problem))
        for _ in range(5):
            time.step()
        proxy.admit()
        listener.until("one/count/out", b"5")
    counts = dict.fromkeys(int(value) for value in listener.values("one/count/out"))
    assert list(counts) == [0, 1, 2, 3, 4, 5]


def test_a_step_stops_waiting_for_a_broker_that_does_not_answer(
    models: Segment, broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.endpoints.mqtt.steps.PATIENCE_S", 0.2)
    with (
        FaultProxy(broker.address, framing=None) as proxy,
        listening(broker.address) as listener,
        bridge(models, proxy.address) as running,
        coordinator(models) as time,
    ):
        listener.until("two/row/out")
        proxy.freeze()
        time.step()
        running.until(lambda: "did not accept step 1" in running.bridge.problem)
        proxy.thaw()
        listener.until("one/count/out", b"1")


def test_no_step_waits_for_a_bridge_that_has_ended(models: Segment, broker: Mosquitto) -> None:
    with coordinator(models) as time:
        with bridge(models, broker.address) as running:
            running.until(lambda: running.bridge.connection.up)
            time.step()
        assert time.step().number == 2


def test_after_a_release_changes_are_published_at_once(instance: str, broker: Mosquitto) -> None:
    with (
        _models(instance, "one", virtual=False) as (model,),
        Segment.open(instance, writable=True) as segment,
        listening(broker.address) as listener,
        bridge(segment, broker.address),
        coordinator(segment) as time,
    ):
        listener.until("one/row/out")
        number = time.step(60_000_000_000).number
        while json.loads(changes(listener)[-1][1])["step"] != number:
            pass  # messages from when control was taken
        model.image[0:4] = (7).to_bytes(4, "big")
        model.publish(number)  # waits for a step
        time.release()
        assert listener.message().payload == b"7"
        model.image[0:4] = (8).to_bytes(4, "big")
        model.publish(number + 1)
        assert listener.message().payload == b"8"
        assert time.step().number > number + 1
        assert changes(listener)[-1][0] == "simlog/step"
