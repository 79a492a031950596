"""The connector with a server in a process of its own: values, statuses, writes, limits."""

from __future__ import annotations

from typing import Any

import pytest

from shmio.errors import ConnectorError
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write, encode
from shmio.model.statuses import BAD_NODE_ID_UNKNOWN, BAD_OUT_OF_RANGE, BAD_TYPE_MISMATCH, GOOD
from shmio.testing.write_conformance import write
from tests.unit.connectors.opcua.device import Device
from tests.unit.connectors.opcua.harness import Source, connected, until

MODES = pytest.mark.parametrize("mode", ["subscribe", "poll"])
DTL = "e807021d050c223848e8072f"
"""A DTL as an S7-1500 sends it: 2024-02-29, Thursday, 12:34:56.789047368."""

NODES: dict[str, tuple[str, Any]] = {
    "text": ("LocalizedText", "open"),
    "guid": ("Guid", "72962b91-fa75-4ae6-8d28-b404dc7daf63"),
    "mode": ("Int32", 3),
    "dtl": ("ExtensionObject", DTL),
    "bytes": ("ByteString", "0a0b0c"),
    "raw": ("UInt16", 125),
    "moment": ("DateTime", "2024-02-29T12:34:56+00:00"),
    "late": ("Double", 1e300),
    "array": ("Int16", [1, 2, 3]),
    "code": ("StatusCode", 0),
    "markup": ("XmlElement", "<x/>"),
    "single": ("Float", 0.5),
}
TAGS: dict[str, Any] = {
    "text": "STRING[20]",
    "guid": "STRING[40]",
    "mode": "USINT",
    "dtl": "DTL",
    "bytes": "ARRAY[1..3] OF BYTE",
    "raw": {"type": "REAL", "scale": [0.1, -2]},
    "moment": "DATE_AND_TIME",
    "late": "REAL",
    "array": "ARRAY[0..2] OF DINT",
    "code": "DWORD",
    "markup": "STRING[20]",
    "single": "LREAL",
}


@pytest.fixture(scope="module", autouse=True)
def nodes(device: Device) -> None:
    for name, (kind, value) in NODES.items():
        device.ask("add", name, kind, value)


@MODES
def test_values_of_many_types(device: Device, mode: str) -> None:
    with connected(device.url, TAGS, mode=mode) as source:
        image = source.connector.read()
        assert {path: source.value(path, image) for path in TAGS if path != "late"} == {
            "text": "open",
            "guid": "72962b91-fa75-4ae6-8d28-b404dc7daf63",
            "mode": 3,
            "dtl": "2024-02-29T12:34:56.789047368",
            "bytes": [10, 11, 12],
            "raw": 10.5,
            "moment": "2024-02-29T12:34:56.000",
            "array": [1, 2, 3],
            "code": 0,
            "markup": "<x/>",
            "single": 0.5,
        }
        codes = {path: source.status(path, image).code for path in TAGS}
        assert codes == dict.fromkeys(TAGS, GOOD) | {"late": BAD_OUT_OF_RANGE}


@MODES
def test_each_type_is_written(device: Device, mode: str) -> None:
    new: dict[str, Value] = {
        "text": "closed", "mode": 200, "dtl": "1999-12-31T23:59:59.000000001", "bytes": [1, 2, 3], "raw": 0.5,
        "moment": "2001-01-01T01:02:03.000", "array": [-1, 0, 40], "guid": "00000000-0000-0000-0000-0000000000ff",
        "code": 0x80340000, "markup": "<y/>", "single": -1.5,
    }  # fmt: skip
    try:
        with connected(device.url, TAGS, mode=mode) as source:
            for path, value in new.items():
                assert source.write(path, value) == ""
            image = source.connector.read()
            assert {path: source.value(path, image) for path in new} == new
            assert device.ask("get", "raw") == 25
            assert "1e+300 does not fit the node's Float" in source.write("single", 1e300)
            assert "Int16" in source.write("array", [1, 2, 40_000])
            assert "'x' is not a Guid" in source.write("guid", "x")
            assert device.ask("get", "array") == [-1, 0, 40]
    finally:
        for name, (kind, value) in NODES.items():
            device.ask("set", name, kind, value)


def test_a_value_that_the_library_cannot_encode_is_refused_by_name(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fault of ours: it is not the server's, and costs no connection."""
    with connected(device.url, {"mode": "INT", "array": "ARRAY[0..2] OF INT"}) as source:
        monkeypatch.setattr("shmio.connectors.opcua.values._whole", lambda number, _kind: object())
        assert source.write("mode", 5).startswith("mode: shmio cannot encode the value as a Int32: ")
        assert source.write("array/1", 5).startswith("array: shmio cannot encode the value as a Int16: ")
        monkeypatch.undo()
        assert source.write("mode", 3) == ""


def test_a_text_that_the_registers_encoding_cannot_hold_says_so(
    device: Device, caplog: pytest.LogCaptureFixture
) -> None:
    device.ask("set", "text", "LocalizedText", "ok ✓")
    try:
        with connected(device.url, {"text": "STRING[20]", "mode": "INT"}) as source:
            assert source.status("text").reason == (
                "the register's encoding cannot hold '✓', which is character 4 of the text; "
                "set the source's key encoding to one that can"
            )
            assert source.status("mode").code == GOOD
        (said,) = [record.getMessage() for record in caplog.records]
        assert said.startswith("text: the register cannot hold the server's value: STRING[20]: the register's encoding")
    finally:
        device.ask("set", "text", "LocalizedText", "open")


@MODES
def test_one_unknown_node_is_bad_alone(device: Device, caplog: pytest.LogCaptureFixture, mode: str) -> None:
    with connected(device.url, {"mode": "INT", "nowhere": "INT"}, mode=mode) as source:
        for _ in range(5):
            image = source.connector.read()
            assert source.status("nowhere", image).code == BAD_NODE_ID_UNKNOWN
            assert (source.status("mode", image).code, source.value("mode", image)) == (GOOD, 3)
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == ["nowhere"]


def test_a_node_that_comes_later_is_found(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.connectors.opcua.session.RETRY_S", 0.05)
    tags = {"mode": "INT", "coming": "INT", "by path": {"type": "INT", "address": "/Objects/2:Device/2:coming"}}
    tags["coming"] = {"type": "INT", "address": "ns=2;s=coming"}
    with connected(device.url, tags) as source:
        assert source.status("coming").code == source.status("by path").code == BAD_NODE_ID_UNKNOWN
        device.ask("add", "coming", "Int16", 5)
        until(lambda: source.value("coming") == 5 and source.status("coming").code == GOOD, "the node")
        until(lambda: source.value("by path") == 5 and source.status("by path").code == GOOD, "the browse path")
        device.ask("set", "coming", "Int16", 6)
        until(lambda: source.value("coming") == 6, "a change")
    device.ask("remove", "coming")


def test_a_node_that_is_removed_turns_bad_and_comes_back(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server does not say that it is gone: it only sends no more changes."""
    monkeypatch.setattr("shmio.connectors.opcua.session.RETRY_S", 0.05)
    device.ask("add", "going", "Int16", 5)
    with connected(device.url, {"going": "INT", "mode": "INT"}) as source:
        assert (source.value("going"), source.status("going").code) == (5, GOOD)
        device.ask("remove", "going")
        until(lambda: source.status("going").code == BAD_NODE_ID_UNKNOWN, "the end of the node")
        assert source.status("mode").code == GOOD
        device.ask("add", "going", "Int16", 6)
        until(lambda: source.value("going") == 6 and source.status("going").code == GOOD, "the node")
        device.ask("set", "going", "Int16", 7)
        until(lambda: source.value("going") == 7, "a change")
    device.ask("remove", "going")


def test_a_node_that_is_removed_and_added_at_once_is_monitored_again(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server sends no more changes of it, and says nothing."""
    monkeypatch.setattr("shmio.connectors.opcua.session.RETRY_S", 0.5)
    device.ask("add", "swapped", "Int16", 5)
    with connected(device.url, {"swapped": "INT", "mode": "INT"}) as source:
        assert source.value("swapped") == 5
        device.ask("remove", "swapped")
        device.ask("add", "swapped", "Int16", 6)
        until(lambda: source.value("swapped") == 6 and source.status("swapped").code == GOOD, "the node")
        device.ask("set", "swapped", "Int16", 7)
        until(lambda: source.value("swapped") == 7, "a change")
    device.ask("remove", "swapped")


def test_a_namespace_that_is_unknown(device: Device) -> None:
    tags = {
        "here": {"type": "INT", "address": "nsu=http://test/device;s=mode"},
        "away": {"type": "INT", "address": "nsu=http://test/nowhere;s=mode"},
    }
    with connected(device.url, tags) as source:
        assert (source.status("here").code, source.value("here")) == (GOOD, 3)
        assert source.status("away").code == BAD_NODE_ID_UNKNOWN


@MODES
def test_a_type_that_does_not_fit_is_bad_alone(device: Device, caplog: pytest.LogCaptureFixture, mode: str) -> None:
    tags = {
        "mode": "BOOL", "text": "INT", "late": "LINT", "array": "ARRAY[0..3] OF INT",
        "one": {"type": "INT", "address": "ns=2;s=array"}, "raw": "UINT", "dtl": "LREAL",
    }  # fmt: skip
    with connected(device.url, tags, mode=mode) as source:
        for _ in range(3):
            image = source.connector.read()
            found = {path: source.status(path, image).code for path in tags}
            assert found == dict.fromkeys(tags, BAD_TYPE_MISMATCH) | {"raw": GOOD}
    told = sorted(record.getMessage() for record in caplog.records)
    assert len(told) == len(tags) - 1
    assert told[0] == (
        "array: the node is Int16[3], but the register is INT[4]; correct the register's type in the layout"
    )


@MODES
def test_status_and_source_time(device: Device, mode: str) -> None:
    with connected(device.url, {"mode": "INT"}, mode=mode) as source:
        device.ask("set", "mode", "Int32", 8, 0x40900000, 1_700_000_000.25)
        until(lambda: source.status("mode").code == 0x40900000, "the status")
        assert (source.status("mode").source_ns, source.value("mode")) == (1_700_000_000_250_000_000, 8)
        device.ask("set", "mode", "Int32", 9, 0x808B0000, 1_700_000_001)
        until(lambda: source.status("mode").code == 0x808B0000, "the status")
        assert (source.status("mode").source_ns, source.value("mode")) == (1_700_000_001_000_000_000, 8)
        device.ask("set", "mode", "Int32", 3)
        until(lambda: source.status("mode").code == GOOD, "the status")
        assert source.value("mode") == 3


def test_changes_within_the_dead_band_do_not_come(device: Device) -> None:
    device.ask("add", "level", "Float", 10.0)
    device.ask("add", "mark", "Int32", 0)
    tags = {"level": {"type": "REAL", "deadband": 0.1, "scale": 0.1}, "mark": "INT"}
    with connected(device.url, tags) as source:
        assert source.value("level") == pytest.approx(1.0)
        for number, (value, shown) in enumerate([(10.5, 1.0), (9.5, 1.0), (12.0, 1.2), (11.5, 1.2)], 1):
            device.ask("set", "level", "Float", value)
            device.ask("set", "mark", "Int32", number)
            until(lambda number=number: source.value("mark") == number, "the mark")  # type: ignore[misc]
            assert source.value("level") == pytest.approx(shown)


def test_many_nodes_have_several_subscriptions_and_sessions(device: Device) -> None:
    tags = {f"n{number}": {"type": "INT", "address": "ns=2;s=mode"} for number in range(23)}
    with connected(device.url, tags, max_items=4, session_items=10) as source:
        image = source.connector.read()
        assert {source.value(path, image) for path in tags} == {3}
        assert "7 subscriptions, sessions=3" in source.connector.describe()
        assert device.ask("clients") == 3
        assert source.write("n22", 4) == ""
        until(lambda: {source.value(path) for path in tags} == {4}, "the value in all sessions")
        assert source.write("n0", 3) == ""
    until(lambda: device.ask("clients") == 0, "the end of the sessions")


@MODES
def test_a_reload_keeps_values_sessions_and_monitored_items(device: Device, mode: str) -> None:
    def tags(*numbers: int) -> dict[str, Any]:
        return {f"n{number}": {"type": "INT", "address": f"ns=2;s={mode}{number}"} for number in numbers}

    for number in range(12):
        device.ask("add", f"{mode}{number}", "Int16", number)
    device.ask("set", f"{mode}2", "Int16", 2, 0, 1_700_000_000)
    with connected(device.url, tags(*range(7)), mode=mode, max_items=2, session_items=3) as source:
        until(lambda: all(source.status(path).code == GOOD for path in tags(*range(7))), "all values")
        assert device.ask("clients") == 3
        many = [11, 2, 10, 6, 9, 8, 7, 5, 4, 3, 0]
        source.reload(tags(*many))
        image = source.connector.read()
        assert [source.value(f"n{number}", image) for number in (0, 2, 5, 6)] == [0, 2, 5, 6]
        assert source.status("n2", image).source_ns == 1_700_000_000_000_000_000
        until(lambda: all(source.status(path).code == GOOD for path in tags(*many)), "the new values")
        assert [source.value(f"n{number}") for number in many] == many
        for number in many:
            assert source.write(f"n{number}", 50 + number) == ""
        assert [device.ask("get", f"{mode}{number}") for number in many] == [50 + number for number in many]
        assert (device.ask("clients"), sum(device.ask("monitored"))) == (4, 11 * (mode == "subscribe"))
        source.reload(tags(2, 99))
        image = source.connector.read()
        assert source.value("n2", image) == 52
        assert source.status("n99", image).code & 0xFFFF0000 == BAD_NODE_ID_UNKNOWN
        assert (device.ask("clients"), sum(device.ask("monitored"))) == (1, mode == "subscribe")
        source.reload(tags(5))  # no node is the same
        until(lambda: source.status("n5").code == GOOD and source.value("n5") == 55, "the value")
        device.ask("set", f"{mode}5", "Int16", 7)
        until(lambda: source.value("n5") == 7, "a change")
        assert (device.ask("clients"), sum(device.ask("monitored"))) == (1, mode == "subscribe")
    until(lambda: device.ask("clients") == 0, "the end of the sessions")


def test_a_session_lost_after_a_reload_is_noticed(device: Device) -> None:
    tags = {f"n{number}": {"type": "INT", "address": "ns=2;s=mode"} for number in range(2)}
    with connected(device.url, tags, session_items=2) as source:
        source.reload(tags | {"n2": tags["n0"], "n3": tags["n0"]})
        until(lambda: source.status("n3").code == GOOD, "the value in the new session")
        device.ask("expire")
        with pytest.raises(ConnectorError):
            until(lambda: not source.connector.read(), "the end")


def test_the_servers_state_is_a_doubt(device: Device) -> None:
    with connected(device.url, {"mode": "INT"}, timeout=100) as source:
        assert source.connector.doubt == ""
        device.ask("state", 3)
        until(lambda: "Suspended" in source.connector.doubt, "the doubt")
        device.ask("state", 0)
        until(lambda: source.connector.doubt == "", "the end of the doubt")


def test_single_elements_are_not_written_to_a_server_that_would_replace_the_array(device: Device) -> None:
    with connected(device.url, TAGS) as source:
        array = source.layout.registers[source.layout.by_path["array"]]
        (outcome,) = write(source.connector, encode(source.layout.element(array, (1,)), 50, "little"))
        assert "write the whole array" in outcome
        assert device.ask("get", "array") == [1, 2, 3]
        (outcome,) = write(source.connector, [Write(array.offset + 1, 0, b"\1")])
        assert "write the whole element" in outcome


def test_after_a_write_no_older_value_is_shown(device: Device) -> None:
    """The server publishes slowly, so that samples from before the writes are on their way."""
    with connected(device.url, {"mode": "DINT"}, publishing_ms=100, sampling_ms=50) as source:
        for number in range(10, 30):
            assert source.write("mode", number) == ""
            assert source.value("mode") == number
        for _ in range(300):
            assert source.value("mode") == 29
        device.ask("set", "mode", "Int32", 3)
        until(lambda: source.value("mode") == 3, "a change by the device")


def test_a_source_without_a_connection_has_no_image(device: Device) -> None:
    source = Source(device.url, TAGS)
    with pytest.raises(ConnectorError, match="not connected"):
        source.connector.read()
