"""Values, quality and recovery of the connector, tested with an agent in another language."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest

from agent import Agent
from shmio.connectors import registry
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec
from shmio.model.statuses import StatusArea, describe
from shmio_mtconnect.connector import MTConnectConnector, MTConnectOptions

TAGS: dict[str, object] = {
    "x": {"type": "LREAL", "address": "VMC/X/act"},
    "y": {"type": "INT", "address": "VMC/base/Y/POSITION.ACTUAL", "scale": [10.0, 1.0]},
    "running": {"type": "BOOL", "address": "exec=ACTIVE"},
    "execution": {"type": "STRING[20]", "address": "VMC/controller/path/EXECUTION"},
    "position": {"type": "ARRAY[0..2] OF REAL", "address": "pos"},
    "vibration": {"type": "ARRAY[0..3] OF INT", "address": "vib"},
    "level": {"type": "USINT", "address": "hyd"},
    "fault": {"type": "STRING[60]", "address": "hyd"},
    "is_fault": {"type": "BOOL", "address": "hyd=Fault"},
    "parts": {"type": "UINT", "address": "count"},
    "set": {"type": "INT", "address": "set"},
    "gone": {"type": "INT", "address": "VMC/gone"},
    "either": {"type": "REAL", "address": "VMC/act"},
}


class Reader:
    """A connector, and the values and statuses of its images."""

    def __init__(self, agent: Agent, **options: int) -> None:
        self.layout = place_tags("device", TAGS).with_statuses()
        keys = {"timeout": 500, "interval": 5, "heartbeat": 50} | options
        self.connector = MTConnectConnector(MTConnectOptions(url=f"http://{agent.address}", **keys), self.layout)

    def read(self) -> dict[str, object]:
        """Return for each path the value, or the name of its status if it has no value."""
        raw, area = self.connector.read(), StatusArea(self.layout)
        found: dict[str, object] = {}
        for index, register in enumerate(self.layout.registers):
            code = area.get(raw, index).code
            found[register.path] = describe(code).split()[0] if code else codec(register, "little").decode(raw)
        return found

    def until(self, condition: Callable[[dict[str, object]], bool]) -> dict[str, object]:
        """Read until a condition is true."""
        end = time.monotonic() + 10
        while not condition(found := self.read()):
            assert time.monotonic() < end, found
        return found

    def error(self) -> str:
        """Read until the connection is lost. Return the message."""
        end = time.monotonic() + 10
        while time.monotonic() < end:
            try:
                self.connector.read()
            except ConnectorError as error:
                return str(error)
        raise AssertionError("the connection was not lost")


@pytest.fixture
def agent() -> Iterator[Agent]:
    """Provide an agent."""
    with Agent() as running:
        yield running


@pytest.fixture
def reader(agent: Agent) -> Iterator[Reader]:
    """Provide a reader of the agent."""
    made = Reader(agent)
    yield made
    made.connector.close()


@pytest.mark.parametrize("version", ["1.3", "1.8", "2.3"])
def test_values_of_all_kinds(agent: Agent, reader: Reader, version: str) -> None:
    """Check samples, events, vectors, time series and conditions, from ``current`` and from the stream."""
    agent.tell(version=version)
    agent.set(Xact="1.5")
    reader.connector.connect()
    first = reader.read()
    assert (first["x"], first["y"]) == (1.5, "BadNoData")
    assert first["gone"] == "BadNodeIdUnknown"
    assert first["either"] == "BadConfigurationError"
    assert first["set"] == "BadNotSupported"
    agent.set(Yact="2.5", exec="ACTIVE", pos="1 2.5 -3e1", vib="9 1 2 3 4", count="70000")
    agent.condition("hyd", "Warning", "W1", "Oil <low>")
    agent.condition("hyd", "Fault", "F7", "Pump")
    found = reader.until(lambda one: one["level"] == 2)
    assert found == first | {
        "y": 26,
        "running": True,
        "execution": "ACTIVE",
        "position": [1.0, 2.5, -30.0],
        "vibration": [1, 2, 3, 4],
        "level": 2,
        "fault": "Fault [F7] Pump",
        "is_fault": True,
        "parts": "BadOutOfRange",
    }
    agent.condition("hyd", "Normal", "F7")
    assert reader.until(lambda one: one["level"] == 1)["fault"] == "Warning [W1] Oil <low>"
    agent.condition("hyd", "Normal")
    assert reader.until(lambda one: one["level"] == 0)["fault"] == "Normal"
    agent.condition("hyd", "Unavailable")
    agent.set(exec="INTERRUPTED", Xact="UNAVAILABLE", Yact="fast", vib="1 2", count="7")
    found = reader.until(lambda one: one["parts"] == 7)
    assert (found["level"], found["x"], found["y"]) == ("BadNoData", "BadNoData", "BadTypeMismatch")
    assert (found["vibration"], found["running"], found["execution"]) == ("BadOutOfRange", False, "INTERRUPTED")


def test_source_time_is_the_timestamp(agent: Agent, reader: Reader) -> None:
    """Check timestamps with fractions of any length."""
    agent.tell(set={"Xact": "1"}, at="2024-02-29T12:00:00.123456789Z")
    agent.tell(set={"Yact": "1"}, at="2024-02-29T13:00:00+01:00")
    reader.connector.connect()
    raw, area = reader.connector.read(), StatusArea(reader.layout)
    second_ns = 1_709_208_000_000_000_000
    assert [area.get(raw, index).source_ns for index in (0, 1)] == [second_ns + 123_456_789, second_ns]


def test_active_conditions_of_the_present_state(agent: Agent, reader: Reader) -> None:
    """All active conditions are in ``current``. When the worst one ends, the other one remains."""
    agent.condition("hyd", "Fault", "F7", "Pump")
    agent.condition("hyd", "Warning", "W1", "Oil")
    reader.connector.connect()
    assert reader.read()["fault"] == "Fault [F7] Pump"
    agent.condition("hyd", "Normal", "F7")
    reader.until(lambda one: one["fault"] == "Warning [W1] Oil")


def test_a_restarted_agent_is_read_anew(agent: Agent, reader: Reader) -> None:
    """The agent's sequence starts again, and the connector starts with the present state."""
    agent.set(Xact="1", count="1")
    reader.connector.connect()
    agent.tell(restart=True)
    assert "has restarted" in reader.error()
    agent.set(Xact="2")
    reader.connector.connect()
    found = reader.read()
    assert (found["x"], found["parts"]) == (2.0, "BadNoData")


def test_a_missing_heartbeat(agent: Agent, reader: Reader) -> None:
    """The connection is open but silent. No old value stays good."""
    reader.connector.connect()
    agent.tell(silent=True)
    assert "no answer" in reader.error()


def test_a_stream_that_is_behind_is_uncertain(agent: Agent) -> None:
    """The stream catches up, in the order of the observations."""
    reader = Reader(agent, count=2)
    agent.set(count="0")
    reader.connector.connect()
    agent.tell(silent=True)
    for number in range(200):
        agent.set(count=str(number))
    agent.tell(silent=False)
    seen: list[object] = []
    doubts: set[bool] = set()

    def caught_up(found: dict[str, object]) -> bool:
        seen.append(found["parts"])
        doubts.add("raise count" in reader.connector.doubt)
        return found["parts"] == 199 and not reader.connector.doubt

    reader.until(caught_up)
    reader.connector.close()
    numbers = [number for number in seen if isinstance(number, int)]
    assert numbers == sorted(numbers)
    assert doubts == {True, False}


def test_observations_that_fell_out_of_the_buffer(agent: Agent, reader: Reader) -> None:
    """The stream ends with the agent's error, and the next connection begins with the present state."""
    reader.connector.connect()
    agent.tell(silent=True)
    agent.tell(buffer=20)
    for number in range(40):
        agent.set(count=str(number))
    agent.tell(silent=False)
    assert "OUT_OF_RANGE" in reader.error()
    reader.connector.connect()
    assert reader.read()["parts"] == 39


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (("garbage", "", 0), "not valid XML"),
        (("<html/>", "", 0), "where MTConnectDevices is expected"),
        (("<!DOCTYPE a [<!ENTITY b 'cc'>]><MTConnectDevices>&b;", "", 0), "document type"),
        (("<MTConnectDevices>", "<a>", 100), "nested more than 64"),
        (("<MTConnectDevices>", "x", 2_000_000), "more than 1048576 characters"),
        (("<MTConnectDevices>", "<DataItem id='a'/>", 1_000_000), "more than 100000 data items"),
        (("<MTConnectDevices>", f"<a b='{'x' * 10_000}'/>", 4000), "more than 32 MiB"),
        (("<MTConnectDevices>", "", 0), "not valid XML"),
        (("<MTConnectError><Errors><Error errorCode='X'>so</Error></Errors></MTConnectError>", "", 0), "reports: X so"),
    ],
    ids=["garbage", "html", "entities", "depth", "text", "items", "size", "cut", "error"],
)
def test_hostile_documents(agent: Agent, answer: tuple[str, str, int], error: str) -> None:
    """The connector refuses each document with a reason, and within its limits."""
    reader = Reader(agent, timeout=60_000)  # a busy host needs seconds for the largest
    agent.tell(raw=answer)
    with pytest.raises(ConnectorError, match=error):
        reader.connector.connect()
    reader.connector.close()


def test_an_older_observation_is_never_shown(agent: Agent, reader: Reader) -> None:
    """The stream sends an observation again that is older than the present one."""
    agent.set(count="1")
    agent.set(count="2")
    head = '<MTConnectStreams><Header instanceId="1000" nextSequence="100" lastSequence="99"/><Events>'
    old = '<PartCount dataItemId="count" sequence="12" timestamp="2024-01-01T00:00:00Z">1</PartCount>'
    new = '<Execution dataItemId="exec" sequence="99" timestamp="2024-01-01T00:00:00Z">ACTIVE</Execution>'
    text = f"{head}{old}{new}</Events></MTConnectStreams>"
    agent.tell(parts=[f"{PART}Content-length: {len(text)}\r\n\r\n{text}", 0])
    reader.connector.connect()
    assert reader.until(lambda one: one["running"] is True)["parts"] == 2


PART = "--part-1000\r\nContent-type: text/xml\r\n"


@pytest.mark.parametrize(
    ("parts", "error"),
    [
        ([f"{PART}\r\n<a/>", 0], "sends a part of unknown bytes"),
        ([f"{PART}Content-length: 99999999\r\n\r\n", 0], "sends a part of 99999999 bytes"),
        ([f"{PART}Content-length: -1\r\n\r\n", 0], "sends a part of -1 bytes"),
        ([PART + "a: b\r\n" * 100, 0], "more than 32 headers"),
        (["x" * 100_000, 0], "a header of more than 4096 bytes"),
        (["<html>\r\n", 0], "where a part begins"),
        (["--part-1000--\r\n", 0], "has ended the stream"),
        ([f"{PART}Content-length: 13\r\n\r\n<!DOCTYPE a>\n", 0], "document type"),
        ([f"{PART}Content-length: 3\r\n\r\n<a>", 0], "MTConnectStreams is expected"),
        (["\r\n" * 10_000, 20], "no answer"),
    ],
    ids=["no length", "long", "negative", "headers", "line", "html", "end", "entities", "other", "drip"],
)
def test_hostile_streams(agent: Agent, parts: list[object], error: str) -> None:
    """The connector refuses each stream with a reason. A part that never ends counts as a missing heartbeat."""
    reader = Reader(agent)
    agent.tell(parts=parts)
    reader.connector.connect()
    assert error in reader.error()
    reader.connector.close()


@pytest.mark.parametrize("part", ["headers", "content"])
def test_a_document_that_drips(agent: Agent, part: str) -> None:
    """The document as a whole is late, although another byte always arrives in time."""
    reader = Reader(agent, timeout=300)
    agent.tell(drip=part)
    with pytest.raises(ConnectorError, match=r"no answer from .* within 300 ms"):
        reader.connector.connect()
    reader.connector.close()


@pytest.mark.parametrize(
    "tag",
    [
        "REAL",
        {"type": "REAL", "address": "a//b"},
        {"type": "INT", "address": "exec=ACTIVE"},
        {"type": "DTL", "address": "a"},
    ],
)
def test_registers_that_it_cannot_read_are_refused(tag: object) -> None:
    """The message names the register."""
    with pytest.raises(ConfigError, match="speed"):
        MTConnectConnector(MTConnectOptions(url="http://a"), place_tags("device", {"speed": tag}).with_statuses())


@pytest.mark.parametrize(
    "url", ["ftp://host:1", "http://", "http://a b", "http://a:99999", "http://u@a", "http://a/?b"]
)
def test_addresses_of_agents(url: str) -> None:
    """Other schemes, invalid hosts and ports, users and queries are refused."""
    with pytest.raises(ValueError, match="url"):
        MTConnectOptions(url=url)


def test_shmio_finds_it_by_its_entry_point() -> None:
    """The test needs an installed package: pip install -e ."""
    assert registry.load("mtconnect") is MTConnectConnector
