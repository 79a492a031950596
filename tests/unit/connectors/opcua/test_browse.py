"""``shmio-supervisor browse``: what a server offers, as a tree and as a tag table that can be read at once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.cli import supervisor
from shmio.connectors.opcua import browse as browsing
from shmio.connectors.opcua.connector import OpcUaConnector
from shmio.connectors.opcua.options import OpcUaOptions
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.values.codec import codec
from shmio.model.statuses import GOOD, status_area
from tests.unit.connectors.opcua.device import Device

TREE = """\
Device
  open  BOOL  nsu=http://test/device;s=open  writable
  forces  ARRAY[0..2] OF INT  nsu=http://test/device;s=forces  writable
  raw  (a ByteString cannot be a register)  nsu=http://test/device;s=raw  writable
  Axis
    speed/now  REAL  nsu=http://test/device;s=speed/now  mm/s
"""
TABLE = """\
# a device, imported from {url}
[registers]
"Device/open" = {{ type = "BOOL", address = "nsu=http://test/device;s=open"{writable} }}
"Device/forces" = {{ type = "ARRAY[0..2] OF INT", address = "nsu=http://test/device;s=forces"{writable} }}
"Device/Axis/speed%2Fnow" = {{ type = "REAL", address = "nsu=http://test/device;s=speed/now", unit = "mm/s", \
comment = "of the slide" }}
"""


@pytest.fixture(scope="module")
def server() -> Iterator[Device]:
    with Device() as device:
        device.ask("add", "open", "Boolean", True)
        device.ask("add", "forces", "Int16", [1, -2, 3])
        device.ask("add", "raw", "ByteString", "0102")
        device.ask("group", "Axis", "Device")
        device.ask("add", "speed/now", "Float", 12.5, False, "Axis")
        device.ask("describe", "speed/now", "of the slide", "mm/s")
        device.ask("refer", "Axis", "Device")  # a loop
        device.ask("refer", "Axis", "Axis")
        yield device


def browse(*arguments: object) -> int:
    return supervisor.main(["browse", *map(str, arguments)])


def test_the_tree(server: Device, capsys: pytest.CaptureFixture[str]) -> None:
    assert browse(server.url) == 0
    assert sorted(capsys.readouterr().out.splitlines()) == sorted(TREE.splitlines())
    assert browse(server.url, "Device/Ax*/**", "Device/open") == 0
    shown = capsys.readouterr().out
    assert [line.split()[0] for line in shown.splitlines()] == ["Device", "open", "Axis", "speed/now"]
    assert browse(server.url, "Device/nothing") == 1
    assert "the device offers nothing that matches the patterns; browse without patterns" in capsys.readouterr().err
    assert browse(server.url, "Device/Axis/speed/now") == 1
    assert "write %2F for a / inside a name" in capsys.readouterr().err
    assert browse(server.url, "Device/Axis/speed%2Fnow") == 0


def test_a_tag_table_is_a_layout_at_once(server: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options, writable in (([], ""), (["--writable"], ", writable = true")):
        file = tmp_path / f"tags{len(options)}.toml"
        assert browse(server.url, "-o", file, *options) == 0
        said = capsys.readouterr()
        assert (said.out, said.err) == (
            "", "imported 3 tags from a device\nskipped 1: a ByteString cannot be a register: Device/raw\n"
        )  # fmt: skip
        assert sorted(file.read_text().splitlines()) == sorted(
            TABLE.format(url=server.url, writable=writable).splitlines()
        )
        assert browse(server.url, "-o", file) == 1
        assert "exists already" in capsys.readouterr().err
        (layout,) = (one.with_statuses() for one in compile_sources([Source(file.name, file.read_bytes())]).layouts)
        connector = OpcUaConnector(OpcUaOptions(url=server.url, publishing_ms=10), layout)
        connector.connect()
        image = connector.read()
        connector.close()
        area = status_area(layout)
        assert area is not None
        assert {area.get(image, index).code for index in range(3)} == {GOOD}
        assert {one.path: codec(one, layout.byte_order).decode(image) for one in layout.registers} == {
            "Device/open": True, "Device/forces": [1, -2, 3], "Device/Axis/speed%2Fnow": 12.5
        }  # fmt: skip


def test_the_search_is_bounded(server: Device, capsys: pytest.CaptureFixture[str]) -> None:
    assert browse(server.url, "--limit", 3) == 1
    said = capsys.readouterr()
    assert len(said.out.splitlines()) == 2
    assert (
        "this list is incomplete: the server has more than 3 nodes; select a part of the server by a PATTERN"
        in said.err
    )
    assert browse(server.url, "--depth", 2) == 1
    said = capsys.readouterr()
    assert "Axis" in said.out
    assert "speed" not in said.out
    assert "Device/Axis/speed/now is deeper than 2 levels; set --depth" in said.err


@pytest.fixture(scope="module")
def hostile() -> Iterator[Device]:
    with Device() as device:
        yield device


def test_a_server_with_a_million_nodes(hostile: Device, capsys: pytest.CaptureFixture[str]) -> None:
    hostile.ask("endless", "tree")
    assert browse(hostile.url, "--limit", 1500) == 1
    said = capsys.readouterr()
    assert len(said.out.splitlines()) == 1499
    assert "this list is incomplete: the server has more than 1500 nodes" in said.err
    sent, open_points = hostile.ask("effort")
    assert sent <= 1500 + 20 * 500, "the rest is not asked for"
    assert open_points == 0, "the server need not remember where the search has ended"


def test_a_pattern_finds_a_node_behind_more_than_the_limit(hostile: Device, capsys: pytest.CaptureFixture[str]) -> None:
    hostile.ask("endless", "tree")
    assert browse(hostile.url, "Device/1000/1001000", "--limit", 100) == 0
    assert capsys.readouterr().out.splitlines()[-1].split()[0] == "1001000"
    assert browse(hostile.url, "Device/*/1001000", "--limit", 100) == 1
    assert "more than 100 nodes" in capsys.readouterr().err, "the search may enter each of 1000 objects"


def test_nodes_that_refer_to_each_other_without_end(hostile: Device, capsys: pytest.CaptureFixture[str]) -> None:
    hostile.ask("endless", "circle")
    assert browse(hostile.url, "--limit", 300) == 1
    said = capsys.readouterr()
    assert len(said.out.splitlines()) == 201
    assert "this list is incomplete: the server sends more references than 300 nodes need" in said.err
    sent, open_points = hostile.ask("effort")
    assert sent <= 300 * browsing.REFERENCES_PER_NODE + 20 * 500
    assert open_points == 0


def test_long_names_take_no_more_memory_than_allowed(
    hostile: Device, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(browsing, "MAX_CHARACTERS", 1 << 18)
    hostile.ask("endless", "names")
    assert browse(hostile.url, "--limit", 1000) == 1
    said = capsys.readouterr()
    assert len(said.out.splitlines()) < (1 << 18) / 5000 + 2
    assert "this list is incomplete: the names of the server's nodes are too long" in said.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["http://localhost"], "cannot browse a device with this kind of URL; valid: opc.tcp://HOST:PORT"),
        (["http://localhost"], "such as --connector mtconnect for http://HOST:PORT"),
        (["opc.tcp://user@localhost"], "without a user"),
        (
            ["opc.tcp://127.0.0.1:1", "--set", "timeuot=3"],
            "unknown key 'timeuot' of connector opcua; did you mean 'timeout'?",
        ),
        (["opc.tcp://127.0.0.1:1", "--set", "timeout"], "expected KEY=VALUE"),
        (["opc.tcp://127.0.0.1:1", "--set", "timeout=soon"], "timeout: expected a whole number"),
        (["opc.tcp://127.0.0.1:1", "--set", "security=Sign"], "certificate: this key is needed"),
        (["opc.tcp://127.0.0.1:1", "a//b"], "the pattern has an empty segment"),
        (["opc.tcp://127.0.0.1:1", "-o", "tags.csv"], "choose a name that ends in .toml"),
        (["opc.tcp://127.0.0.1:1"], "connection refused by 127.0.0.1:1: no program listens there; check the address"),
        (["opc.tcp://no.such.host.invalid:1"], "host name 'no.such.host.invalid' cannot be resolved"),
        (["ws://127.0.0.1:1"], "connection refused by 127.0.0.1:1: no program listens there; check the address"),
        (["mqtt://127.0.0.1:1"], "connection refused by 127.0.0.1:1: no program listens there; check the address"),
    ],
)
def test_faults_are_named(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert browse(*arguments) == 1
    assert words in capsys.readouterr().err
