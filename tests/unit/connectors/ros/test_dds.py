"""The ros2 connector with nodes that have their own type definitions."""

from __future__ import annotations

import math
import os
import random
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from shmio.connectors import registry
from shmio.connectors.ros.dds import Ros2Connector, Ros2Options
from shmio.connectors.ros.messages import DEFINITIONS, default
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.values.write import encode
from shmio.model import statuses
from tests.unit.connectors.ros.dds_peer import DOMAIN, Peer
from tests.unit.connectors.source import Source, layout_of

STATE = "sensor_msgs/msg/JointState "


@pytest.fixture(scope="module")
def peer() -> Iterator[Peer]:
    with Peer() as peer:
        yield peer


def tags_of(peer: Peer) -> dict[str, tuple[str, str] | dict[str, Any]]:
    return {
        "j1": ("LREAL", peer.address("states", f"{STATE}position[name=j1]")),
        "j2": ("LREAL", peer.address("states", f"{STATE}position[name=j2]")),
        "mode": ("STRING[20]", peer.address("mode", "std_msgs/String data")),
        "spare": {
            "type": "ARRAY[0..1] OF INT", "address": peer.address("spare", "std_msgs/Int16MultiArray data"),
            "writable": True,
        },
    }  # fmt: skip


@contextmanager
def connected(peer: Peer, tags: dict[str, Any] | None = None, **options: Any) -> Iterator[Source]:
    layout = layout_of(tags or tags_of(peer))
    latched = [f"/{peer.prefix}/mode"] if tags is None else []
    keys: dict[str, Any] = {"domain": DOMAIN, "timeout": 5000, "latched": latched} | options
    source = Source(Ros2Connector(Ros2Options(**keys), layout), layout)
    try:
        source.connector.connect()
        yield source
    finally:
        source.connector.close()


def seen(source: Source, peer: Peer, names: list[str], positions: list[float], sec: int = 0) -> None:
    """Publish joint states until the source shows the first joint."""

    def shown() -> bool:
        peer.ask("state", names, positions, sec)
        return source.code("j1") == 0 and source.value("j1") == positions[names.index("j1")]

    source.until(shown)


def test_joints_by_name_and_a_latched_topic(peer: Peer) -> None:
    peer.ask("mode", "auto")  # before anybody subscribes
    with connected(peer, max_age=0) as source:
        seen(source, peer, ["j2", "j1"], [math.nan, 1.5], 1_700_000_000)
        found = source.value("j2")
        assert isinstance(found, float)
        assert math.isnan(found)
        assert source.source_ns("j1") == 1_700_000_000_000_000_007
        source.until(lambda: source.code("mode") == 0)
        assert source.value("mode") == "auto"
        seen(source, peer, ["j1"], [2.5])
        assert source.code("j2") == statuses.BAD_NOT_FOUND


def test_age_and_a_publisher_that_leaves(peer: Peer) -> None:
    with connected(peer, max_age=100) as source:
        seen(source, peer, ["j1"], [1.0])
        source.until(lambda: source.code("j1") == statuses.BAD_TIMEOUT)
    with Peer() as other:
        tags = tags_of(peer) | {"o": ("LREAL", other.address("states", f"{STATE}position[0]"))}
        with connected(peer, tags, max_age=0) as source:

            def shown() -> bool:
                other.ask("state", ["a"], [4.0])
                return source.code("o") == 0

            source.until(shown)
            seen(source, peer, ["j1"], [3.0])
            other.ask("leave")
            source.until(lambda: source.code("o") == statuses.BAD_NO_COMMUNICATION)
            assert (source.code("j1"), source.value("j1")) == (0, 3.0)
            other.ask("join")
            source.until(shown)


def test_without_any_publisher_the_source_is_bad() -> None:
    with Peer() as peer:
        tags = {"j1": ("LREAL", peer.address("states", f"{STATE}position[0]"))}
        with connected(peer, tags) as source:
            peer.ask("leave")
            with pytest.raises(ConnectorError, match="all publishers"):
                source.until(lambda: False)
            source.connector.close()
            connector = Ros2Connector(Ros2Options(domain=DOMAIN, timeout=100), source.layout)
            with pytest.raises(ConnectorError, match="no publisher or subscriber"):
                connector.connect()
            peer.ask("join")
            source.connector.connect()


def test_a_command_reaches_the_node(peer: Peer) -> None:
    with connected(peer, max_age=0) as source:
        source.until(lambda: source.write(spare=[3, -4]) == [""])  # once it is discovered
        assert peer.ask("commanded") == [3, -4]
        source.read()
        assert (source.value("spare"), source.code("spare")) == ([3, -4], 0)
        assert "writable" in source.write(j1=1.0)[0]
    lonely = {
        "j1": ("LREAL", peer.address("states", f"{STATE}position[0]")),
        "nobody": {"type": "LREAL", "address": "/nobody std_msgs/Float64 data", "writable": True},
    }
    with connected(peer, lonely) as source:
        assert "no node subscribes to /nobody" in source.write(nobody=1.0)[0]


def test_a_write_waits_for_a_subscriber_that_is_not_discovered_yet(peer: Peer) -> None:
    tags = {
        "j1": ("LREAL", peer.address("states", f"{STATE}position[0]")),
        "late": {"type": "INT", "address": peer.address("late", "std_msgs/Int16 data"), "writable": True},
    }
    with connected(peer, tags) as source:
        source.connector.send(encode(source.layout.registers[source.layout.by_path["late"]], 5, "little"))
        assert source.connector.confirm(time.monotonic_ns() + 1_000_000) is None
        peer.ask("open", {"late": "Int16"})
        while (outcome := source.connector.confirm(time.monotonic_ns() + 1_000_000_000)) is None:
            pass
        assert (outcome, peer.ask("received_data", "late")) == ([""], 5)


def descriptors() -> set[int]:
    return {int(path.name) for path in Path("/proc/self/fd").iterdir()}


def test_other_hosts_are_kept_out(peer: Peer) -> None:
    """The library binds its receiving sockets to all addresses, but the connector rebinds them to loopback."""
    before = descriptors()
    devices = []
    with connected(peer):
        for descriptor in descriptors() - before:
            with suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as found:
                if found.family == socket.AF_INET and found.type == socket.SOCK_DGRAM:
                    devices.append(found.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16))
    assert len(devices) >= 2
    assert set(devices) == {b"lo\0"}


def test_garbage_and_large_messages_do_no_harm(peer: Peer) -> None:
    noise = random.Random(7)
    with connected(peer, max_age=0, max_message_bytes=1000) as source:
        seen(source, peer, ["j1"], [1.0])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for port in range(7400 + 250 * DOMAIN, 7400 + 250 * DOMAIN + 24):
                for head in (b"", b"RTPS\x02\x01\x01\x10"):
                    sender.sendto(head + noise.randbytes(200), ("127.0.0.1", port))
        peer.ask("state", ["j1"], [5.0] * 1000)

        def later() -> bool:
            peer.ask("spare", [7, 8])
            return source.value("spare") == [7, 8]

        source.until(later)
        assert source.value("j1") == 1.0
        seen(source, peer, ["j1"], [2.0])


@pytest.mark.parametrize("kind", DEFINITIONS)
def test_each_type_passes_through_its_dds_type(kind: str) -> None:
    pytest.importorskip("cyclonedds")
    from shmio.connectors.ros.dds_types import dds_type, sample_type, to_sample

    message = default(kind)
    data = to_sample(message, kind).serialize()
    assert sample_type(kind).deserialize(data).message == message
    assert dds_type(kind).startswith(f"{kind.partition('/')[0]}::msg::dds_::")


def test_messages_in_the_second_version_of_the_encoding() -> None:
    pytest.importorskip("cyclonedds")
    from shmio.connectors.ros.dds_types import sample_type, to_sample

    message = default("std_msgs/Float64MultiArray") | {"data": [1.0, 2.0]}
    data = to_sample(message, "std_msgs/Float64MultiArray").serialize(use_version_2=True)
    assert sample_type("std_msgs/Float64MultiArray").deserialize(data).message == message


@pytest.mark.parametrize(("name", "library"), [("ros2", "cyclonedds"), ("rosbridge", "websockets")])
def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch, name: str, library: str) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda wanted: None if wanted == library else object())
    kind: Any = registry.load(name)
    options = registry.convert_options(name, {"url": "ws://robot"} if name == "rosbridge" else {})
    with pytest.raises(ConfigError, match=rf"pip install 'shmio\[{name}\]'"):
        kind(options, layout_of({"r": ("LREAL", "/a std_msgs/Float64 data")}))


def test_what_is_wrong_is_said_before_anything_starts() -> None:
    pytest.importorskip("cyclonedds")
    with pytest.raises(ConfigError, match="cannot be read"):
        Ros2Connector(Ros2Options(), layout_of({"r": ("LREAL", "/a my_msgs/Thing x")}))
    with pytest.raises(ValueError, match="peers"):
        Ros2Options(peers=["10.0.0.1"])
    connector = Ros2Connector(
        Ros2Options(interface="none0", domain=DOMAIN), layout_of({"r": ("LREAL", "/a std_msgs/Float64 data")})
    )
    with pytest.raises(ConnectorError, match="interface"):
        connector.connect()
    connector.close()


def test_a_reload_changes_readers_and_writers(peer: Peer) -> None:
    tags = tags_of(peer)
    peer.ask("mode", "auto")
    with connected(peer, {"j1": tags["j1"], "spare": tags["spare"]}, max_age=0) as source:
        seen(source, peer, ["j2", "j1"], [2.5, 1.5], 1_700_000_000)
        present = peer.ask("participants")
        latched = [f"/{peer.prefix}/mode"]
        source.reload({name: tags[name] for name in ("j2", "mode")}, latched=latched)
        source.read()
        assert (source.value("j2"), source.source_ns("j2")) == (2.5, 1_700_000_000_000_000_007)
        source.until(lambda: source.code("mode") == 0)  # it was stored by its publisher
        assert source.value("mode") == "auto"
        spare = ("ARRAY[0..1] OF INT", peer.address("spare", "std_msgs/Int16MultiArray data"))
        source.reload({"mode": tags["mode"], "spare": spare}, latched=latched, qos={"reliability": "reliable"})
        source.reload({"mode": tags["mode"], "spare": tags["spare"]}, latched=latched, qos={"reliability": "reliable"})
        source.until(lambda: source.write(spare=[3, 4]) == [""])
        assert (source.value("mode"), peer.ask("commanded")) == ("auto", [3, 4])
        assert peer.ask("participants") == present
        unknown = {"other": ("STRING[20]", peer.address("nowhere", "std_msgs/String data"))}
        with pytest.raises(ConnectorError, match="no publisher or subscriber"):
            source.reload(unknown, latched=[], timeout=300)


def test_a_reload_may_give_a_topic_another_type(peer: Peer) -> None:
    wrong = {"mode": ("INT", peer.address("mode", "std_msgs/Int16 data")), "j1": tags_of(peer)["j1"]}
    with connected(peer, wrong, max_age=0) as source:
        peer.ask("mode", "auto")
        source.reload({"mode": tags_of(peer)["mode"], "j1": tags_of(peer)["j1"]}, latched=[f"/{peer.prefix}/mode"])
        source.until(lambda: source.code("mode") == 0)
        assert source.value("mode") == "auto"


def test_a_reload_with_a_qos_that_no_publisher_offers_makes_the_last_value_bad(peer: Peer) -> None:
    tags = {name: tags_of(peer)[name] for name in ("j1", "mode")}
    with connected(peer, tags, max_age=0) as source:
        seen(source, peer, ["j1"], [1.5])
        source.reload(tags, topic_qos={f"/{peer.prefix}/states": {"liveliness": "manual_by_topic"}})
        source.read()
        assert source.code("j1") == statuses.BAD_NO_COMMUNICATION


def test_a_topic_that_a_reload_makes_read_only_has_no_subscribers(peer: Peer) -> None:
    peer.ask("request", "heard", "Float64", {})
    heard = {"type": "LREAL", "address": peer.address("heard", "std_msgs/Float64 data"), "writable": True}
    with connected(peer, {"heard": heard}) as source, pytest.raises(ConnectorError, match="no publisher or subscriber"):
        source.reload({"heard": heard | {"writable": False}}, timeout=100)
    peer.ask("withdraw", "heard")
