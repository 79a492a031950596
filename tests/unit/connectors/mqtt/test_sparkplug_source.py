"""The MQTT connector with Sparkplug B: an edge node made with Node's sparkplug-payload, and hostile messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from shmio.backoff import Backoff
from shmio.connectors.mqtt import sparkplug
from shmio.endpoints.mqtt.sparkplug.node import EdgeNode, Sample
from shmio.layout.tags import place_tags
from shmio.model import statuses
from shmio.model.statuses import describe
from tests.unit.connectors.mqtt.conftest import Plant
from tests.unit.connectors.mqtt.peer import Peer, connected
from tests.unit.connectors.source import Source

GROUP = "spBv1.0/Line 1"
TAGS: dict[str, Any] = {
    "node/cpu": ("REAL", "sparkplug Line 1/cell metric cpu"),
    "axis/pos": {"type": "LREAL", "address": "sparkplug Line 1/cell/robot metric Axis/Pos", "writable": True},
    "axis/count": {"type": "INT", "address": "sparkplug Line 1/cell/robot metric Axis/Count", "writable": True},
    "axis/on": {"type": "BOOL", "address": "sparkplug Line 1/cell/robot metric on", "writable": True},
    "axis/name": ("STRING[10]", "sparkplug Line 1/cell/robot metric name"),
    "axis/gone": ("INT", "sparkplug Line 1/cell/robot metric gone"),
    "other": ("INT", "sparkplug Line 1/cell/other metric n"),
}
CODES: Callable[[Source], list[str]] = lambda source: [describe(source.code(path)).split(" ")[0] for path in TAGS]  # noqa: E731


class Edge:
    """An edge node, for which the peer sends the messages that the test asks for."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        self.seq = 0
        self.bd_seq = 0

    def send(self, kind: str, device: str = "", *metrics: dict[str, Any], **given: Any) -> None:
        seq = {} if kind == "NDEATH" else {"seq": self.seq}
        topic = f"{GROUP}/{kind}/cell" + (f"/{device}" if device else "")
        self.peer.ask("publish_sparkplug", topic, {"timestamp": 1_700_000_000_000, "metrics": metrics} | seq | given)
        if seq:
            self.seq = (given.get("seq", self.seq) + 1) % 256

    def birth(self, **extra: Any) -> None:
        self.seq, self.bd_seq = 0, self.bd_seq + 1
        self.send("NBIRTH", "", self.session(), {"name": "cpu", "type": "Float", "value": 12.5, "alias": 1})
        self.send(
            "DBIRTH", "robot",
            {"name": "Axis/Pos", "type": "Double", "value": 1.5, "alias": 10, "timestamp": 1_700_000_000_500} | extra,
            {"name": "Axis/Count", "type": "Int16", "value": -3, "alias": 11},
            {"name": "on", "type": "Boolean", "value": True},
            {"name": "name", "type": "String", "value": "left"},
            {"name": "unread", "type": "Int32", "value": 1, "alias": 12},
        )  # fmt: skip

    def session(self, number: int | None = None) -> dict[str, Any]:
        return {"name": "bdSeq", "type": "UInt64", "value": self.bd_seq if number is None else number}

    def asked(self, source: Source) -> list[tuple[str, Any]]:
        """Read images until the source has sent a command to the edge node; return the command's metrics.

        A source that gets no birth in time sends the command again.
        """
        heard: list[Any] = []

        def commanded() -> bool:
            heard.extend(self.peer.ask("heard"))
            return bool(heard)

        source.until(commanded)
        metrics = [self.peer.ask("decode_sparkplug", message["hex"])["metrics"] for message in heard]
        found = [[(one["name"], one["value"]) for one in each] for each in metrics]
        assert all(each == found[0] for each in found)
        assert {(one["topic"], one["qos"], one["retain"]) for one in heard} == {(f"{GROUP}/NCMD/cell", 0, False)}
        return found[0]


@pytest.fixture
def edge(plant: Plant) -> Edge:
    plant.device.ask("subscribe", f"{GROUP}/NCMD/cell")
    plant.device.ask("subscribe", f"{GROUP}/DCMD/cell/robot")
    plant.device.ask("heard")
    return Edge(plant.device)


WAITING, DEAD = "BadWaitingForInitialData", "BadNoCommunication"


def born(source: Source, edge: Edge) -> None:
    assert edge.asked(source) == [("Node Control/Rebirth", True)]
    edge.birth()
    source.until(lambda: source.code("axis/pos") == 0)


def test_births_data_and_deaths(plant: Plant, edge: Edge, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sparkplug, "ASK", Backoff(120, 120))  # a slow host causes no second question
    with connected(plant.address, TAGS) as source:
        source.read()
        assert set(CODES(source)) == {WAITING}
        born(source, edge)
        assert CODES(source) == ["Good"] * 5 + ["BadNotFound", WAITING]
        assert [source.value(path) for path in TAGS][:5] == [12.5, 1.5, -3, True, "left"]
        assert source.source_ns("axis/pos") == 1_700_000_000_500_000_000
        assert source.source_ns("axis/on") == 1_700_000_000_000_000_000
        edge.send(
            "DDATA", "robot", {"alias": 11, "type": "Int16", "value": 300}, {"alias": 12, "type": "Int32", "value": 2}
        )
        source.until(lambda: source.value("axis/count") == 300)
        edge.send("DDATA", "robot", {"name": "on", "type": "Boolean", "value": False})
        source.until(lambda: source.value("axis/on") is False)
        edge.send("DDEATH", "robot")
        source.until(lambda: CODES(source) == ["Good", *[DEAD] * 5, WAITING])
        edge.send("DBIRTH", "robot", {"name": "Axis/Count", "type": "Int16", "value": 4, "alias": 20})
        source.until(lambda: source.value("axis/count") == 4)
        assert CODES(source)[1:4] == ["BadNotFound", "Good", "BadNotFound"]
        edge.send("NDEATH", "", edge.session(99))  # of an earlier session
        edge.send("DDATA", "robot", {"alias": 20, "type": "Int16", "value": 5})
        source.until(lambda: source.value("axis/count") == 5)
        assert source.code("axis/count") == 0
        edge.send("NDEATH", "", edge.session())
        source.until(lambda: set(CODES(source)) == {DEAD})
        edge.birth()
        source.until(lambda: source.code("axis/pos") == 0)
        assert edge.peer.ask("heard") == []  # it was asked only once


def test_null_and_quality_and_history(plant: Plant, edge: Edge) -> None:
    with connected(plant.address, TAGS) as source:
        born(source, edge)
        edge.send(
            "DDATA", "robot",
            {"alias": 10, "type": "Double", "value": None},
            {"alias": 11, "type": "Int16", "value": 99, "isHistorical": True},
            {"name": "on", "type": "Boolean", "value": True,
             "properties": {"Quality": {"type": "Int32", "value": 500}}},
            {"name": "name", "type": "String", "value": "far too long a text"},
        )  # fmt: skip
        source.until(lambda: source.code("axis/pos") == statuses.BAD_NO_DATA)
        assert (source.value("axis/count"), source.code("axis/count")) == (-3, 0)
        assert source.code("axis/on") == statuses.UNCERTAIN_LAST_USABLE_VALUE
        assert source.code("axis/name") == statuses.BAD_OUT_OF_RANGE


@pytest.mark.parametrize("fault", ["gap", "alias", "no birth", "after death", "garbage"])
def test_what_cannot_be_trusted_is_bad_until_a_new_birth(
    plant: Plant, edge: Edge, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sparkplug, "ASK", Backoff(0.05, 0.1))
    with connected(plant.address, TAGS) as source:
        born(source, edge)
        metric = {"alias": 10, "type": "Double", "value": 2.5}
        if fault == "gap":
            edge.seq += 1
            edge.send("DDATA", "robot", metric)
        elif fault == "alias":
            edge.send("DDATA", "robot", metric | {"alias": 77})
        elif fault == "no birth":
            edge.send("DDATA", "other", {"name": "n", "type": "Int32", "value": 1})
        elif fault == "after death":
            edge.send("DDEATH", "robot")
            edge.send("DDATA", "robot", metric)
        else:
            edge.peer.ask("publish", f"{GROUP}/NDATA/cell", {"hex": "ffffffff"})
        source.until(lambda: set(CODES(source)) == {WAITING})
        assert source.value("axis/pos") == 1.5
        edge.send("DDATA", "robot", metric)  # nothing is believed before the birth
        # the connector asks for a birth again, after the wait since the first question
        source.until(lambda: bool(edge.peer.ask("heard")))
        edge.birth()
        source.until(lambda: source.code("axis/pos") == 0)


def test_commands(plant: Plant, edge: Edge) -> None:
    with connected(plant.address, TAGS) as source:
        (outcome,) = source.write(**{"axis/pos": 1.0})
        assert "is not online" in outcome
        born(source, edge)
        outcomes = source.write(**{"axis/pos": 7.5, "axis/count": -300, "axis/on": False})
        assert outcomes == ["", "", ""]
        message = plant.device.ask("next", f"{GROUP}/DCMD/cell/robot")
        assert (message["qos"], message["retain"]) == (0, False)
        sent = plant.device.ask("decode_sparkplug", message["hex"])
        assert "seq" not in sent
        by_key = {one.get("alias") or one["name"]: one for one in sent["metrics"]}
        assert {key: one["value"] for key, one in by_key.items()} == {10: 7.5, 11: -300, "on": False}
        assert by_key[11]["type"] == "Int16"
        edge.send("DDEATH", "robot")
        source.until(lambda: source.code("axis/pos") == statuses.BAD_NO_COMMUNICATION)
        assert "has died" in source.write(**{"axis/pos": 1.0})[0]


def test_no_question_is_asked_if_that_is_not_wanted(plant: Plant, edge: Edge) -> None:
    with connected(plant.address, TAGS, rebirth=False) as source:
        source.read()
        edge.birth()
        source.until(lambda: source.code("axis/pos") == 0)
        assert edge.peer.ask("heard") == []


def test_a_reload_keeps_what_is_known_of_nodes_and_asks_for_a_birth_if_metrics_were_added(
    plant: Plant, edge: Edge
) -> None:
    first = {path: TAGS[path] for path in ("axis/count", "axis/pos", "axis/on")}
    with connected(plant.address, first) as source:
        born(source, edge)
        source.reload({path: TAGS[path] for path in ("axis/on", "axis/pos")})
        source.read()
        assert [source.value("axis/on"), source.value("axis/pos"), source.code("axis/pos")] == [True, 1.5, 0]
        edge.send("DDATA", "robot", {"alias": 11, "type": "Int16", "value": 300})  # a metric that was removed
        edge.send("DDATA", "robot", {"alias": 10, "type": "Double", "value": 2.5})
        source.until(lambda: source.value("axis/pos") == 2.5)
        source.reload(TAGS)
        edge.send("DDATA", "other", {"name": "n", "type": "Int16", "value": 5})  # of a device whose birth was missed
        edge.send("DDATA", "robot", {"alias": 10, "type": "Double", "value": 3.5}, {"alias": 11, "type": "Int16"})
        source.until(lambda: source.value("axis/pos") == 3.5)
        kept = {"axis/pos", "axis/on"}
        assert {path for path in TAGS if source.code(path) == 0} == kept
        assert source.code("axis/count") == statuses.BAD_WAITING_FOR_INITIAL_DATA
        born(source, edge)
        source.until(lambda: source.code("node/cpu") == 0 and source.code("axis/name") == 0)
        assert source.code("axis/gone") == statuses.BAD_NOT_FOUND
        edge.send("DDATA", "robot", {"alias": 11, "type": "Int16", "value": 9})
        source.until(lambda: source.value("axis/count") == 9)


def test_a_node_of_shmio_itself_is_read(plant: Plant) -> None:
    """The connector reads the values that shmio's own bridge publishes."""
    kinds: dict[str, tuple[str, Any]] = {
        "a": ("SINT", -7), "b": ("INT", -300), "c": ("DINT", -70_000), "d": ("LINT", -(1 << 40)), "e": ("USINT", 200),
        "f": ("UINT", 60_000), "g": ("UDINT", 4_000_000_000), "h": ("ULINT", (1 << 64) - 1), "i": ("REAL", 0.5),
        "j": ("LREAL", 1e-300), "k": ("BOOL", True), "l": ("STRING[9]", "text"),
        "m": ("ARRAY[1..3] OF INT", [1, -2, 3]),
        "n": ("ARRAY[1..9] OF BOOL", [True, False, True] * 3), "o": ("ARRAY[1..2] OF LREAL", [0.25, -1.0]),
    }  # fmt: skip
    layout = place_tags("dev", {path: kind for path, (kind, _) in kinds.items()})
    node = EdgeNode("G", "N")
    node.define({"dev": layout.registers})
    tags = {path: {"type": kind, "address": f"sparkplug G/N/dev metric {path}", "writable": True}
            for path, (kind, _) in kinds.items()}  # fmt: skip
    with connected(plant.address, tags) as source:
        samples = [Sample(node.metrics["dev"][path], value, 1_700_000_000_000) for path, (_, value) in kinds.items()]
        for message in (node.birth(), node.device_birth("dev", samples), node.data("dev", samples)):
            plant.device.ask("publish", message.topic, {"hex": message.payload.hex()})
        source.until(lambda: source.code("a") == 0)
        assert {path: source.value(path) for path in kinds} == {path: value for path, (_, value) in kinds.items()}
        plant.device.ask("subscribe", "spBv1.0/G/DCMD/N/dev")
        assert source.write(**{path: value for path, (_, value) in kinds.items()}) == [""] * len(kinds)
        sent = plant.device.ask("next", "spBv1.0/G/DCMD/N/dev")
        command = node.command("spBv1.0/G/DCMD/N/dev", bytes.fromhex(sent["hex"]))
        assert dict(command.values) == {path: value for path, (_, value) in kinds.items()}
