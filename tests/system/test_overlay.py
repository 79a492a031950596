"""The A50 cell with a tag table over its data block: names for bits and views, in every interface."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from contextlib import closing

import grpc
import pytest
from asyncua.sync import Client

import shmio
from shmio.client import connect
from shmio.config import Address
from shmio.layout.values.frame_codec import FrameCodec
from shmio.local.attach import Attachment
from shmio.recording.dump import open_dump
from shmio.testing.cell import CONFIG, PATIENCE_S, Cell, until
from shmio.testing.ports import reserved_port
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as SimlogV2Stub
from tests.unit.endpoints.mqtt.harness import listening

NAMES = """
[registers]
Release = { address = "Outputs/100.%X2", writable = true, comment = "releases the robot" }
"door/Closed" = "Outputs/110.%X0"
"door/Speed" = { address = "Outputs/120", type = "REAL", unit = "mm/s", writable = true }
lamps = { address = "Outputs/130.%X6", type = "ARRAY[1..4] OF BOOL", writable = true }
"Robot_800/Ready" = "Outputs/140.%X7"
neighbours = { address = "Outputs/110.%X1", type = "ARRAY[1..4] OF BOOL" }
Beat = "Outputs/0"
"""
SOURCE = 'connector = "s7"\nlayout = "db201.db"\ntags = "names.toml"\nwritable = ["Outputs"]\narmed = true\n'
MORE = """
[recorder]
directory = "dumps"

[mqtt]
listen = "{broker}"
prefix = "shmio/test"

[[mqtt.account]]
roles = ["read", "write"]

[opcua]
listen = "{opcua}"
"""


@pytest.fixture(scope="module")
def addresses() -> Iterator[tuple[Address, Address]]:
    with reserved_port() as broker, reserved_port() as opcua:
        yield broker, opcua


@pytest.fixture(scope="module")
def cell(make_shared_cell: Callable[..., Cell], addresses: tuple[Address, Address]) -> Cell:
    """The running cell; each test writes to bytes of its own, which the PLC's program ignores."""
    broker, opcua = addresses
    config = CONFIG.replace('connector = "s7"\nlayout = "db201.db"\n', SOURCE)
    cell = make_shared_cell(config=config + MORE.replace("{broker}", str(broker)).replace("{opcua}", str(opcua)))
    (cell.folder / "names.toml").write_text(NAMES)
    cell.up()
    until(lambda: cell.processes()["cell"]["quality"] == "good", "good quality")
    return cell


@pytest.fixture
def local(cell: Cell) -> Iterator[Attachment]:
    with shmio.attach(cell.instance, writable=True) as local:
        yield local


def test_a_bit_is_written_to_the_controller_without_its_neighbours(cell: Cell, local: Attachment) -> None:
    assert local.write({"cell/Outputs/100": 0b1010_0001})[0].done
    done = cell.run("shmio", "set", "Release", "true")
    assert (done.returncode, done.stdout) == (0, "cell/Release  written\n"), done.stderr
    until(lambda: local["cell/Outputs/100"] == 0b1010_0101, "the bit in its byte")
    found = json.loads(cell.output("shmio", "get", "--json", "Release", "door"))
    assert {path: one["value"] for path, one in found.items()} == {
        "cell/Release": True, "cell/door/Closed": False, "cell/door/Speed": 0.0,
    }  # fmt: skip


def test_a_view_and_its_bytes_are_the_same(local: Attachment) -> None:
    assert local.write({"cell/door/Speed": 2.5, "cell/lamps": [True, False, True, True]})[0].done
    until(lambda: local["cell/Outputs/120..124"] == [*struct.pack(">f", 2.5), 0], "the bytes of the view")
    assert local["cell/Outputs/129..132"] == [0, 0x40, 0b11, 0]
    assert local.write({"cell/Outputs/120": 0xC0, "cell/Outputs/131": 0})[0].done
    until(lambda: local["cell/door/Speed"] == -2.5, "the view of the bytes")
    assert local["cell/lamps"] == [True, False, False, False]
    refused = local.write({"cell/Outputs/120..123": [0x7F, 0xC0, 0, 0]})[0]
    assert not refused.done
    assert refused.text.startswith("door/Speed: NaN and infinities are written only if")


def test_what_is_injected_over_a_name_is_injected_over_its_bytes(local: Attachment) -> None:
    assert local.write({"cell/Outputs/110": 0x81})[0].done
    until(lambda: local["cell/door/Closed"] is True, "the written bit")
    with local.inject("cell/door/Closed") as bit:
        bit.set({"cell/door/Closed": False})
        until(lambda: local["cell/Outputs/110"] == 0x80, "the byte with the injected bit")
        with local.inject("cell/Outputs/110") as whole:  # the newer one is outermost
            whole.set({"cell/Outputs/110": 0x0F})
            until(lambda: local["cell/door/Closed"] is True, "the bit of the injected byte")
        until(lambda: local["cell/door/Closed"] is False, "the older injection again")
        assert local["cell/Outputs/110"] == 0x80
    until(lambda: local["cell/Outputs/110"] == 0x81, "the controller's byte")


def test_an_injection_on_in_has_the_name(local: Attachment) -> None:
    with local.inject("cell/Release/in") as shadow:
        assert local.write({"cell/Release": False})[0].done
        assert next(shadow.diverted(PATIENCE_S)).values == {"Release": False}
    with local.inject("cell/Outputs/100/in") as shadow:
        assert local.write({"cell/Release": True})[0].done
        assert next(shadow.diverted(PATIENCE_S)).values == {"Outputs/100.%X2": True}


def test_old_clients_find_names_but_their_structures_are_those_of_the_block(cell: Cell, local: Attachment) -> None:
    with grpc.insecure_channel(str(cell.grpc)) as channel:
        first, second = SimlogAPIStub(channel), SimlogV2Stub(channel)  # type: ignore[no-untyped-call]
        topic = v1.TopicDescriptor(path="cell/door/Closed")
        assert first.GetTopic(topic, timeout=PATIENCE_S, wait_for_ready=True).msgType == "bool"
        read = second.Read(v2.ReadRequest(path=["cell/Robot_800", "cell/door", "cell/Release"]), timeout=PATIENCE_S)
        robot, door, release = read.messages
        assert sorted(robot.value.struct_value) == [f"Axs{axis}_Pos" for axis in range(1, 7)]
        assert sorted(door.value.struct_value) == ["Closed", "Speed"]
        assert release.type == v2.BOOL
        stream = first.Subscribe(v1.TopicDescriptor(path="cell/Release/in"), timeout=PATIENCE_S)
        stream.initial_metadata()
        assert local.write({"cell/Outputs/100": 4})[0].done
        assert next(stream).value == "true"
        stream.cancel()


def test_shmio_v1_reads_subscribes_and_decodes_names(cell: Cell, local: Attachment) -> None:
    with connect(str(cell.grpc)) as remote:
        (layout,) = remote.layouts().values()
        speed = layout.registers[layout.places["door/Speed"]]
        assert (speed.unit, speed.over) == ("mm/s", "Outputs/120")
        assert len(layout.own) == len(layout.registers) - 7
        with remote.subscribe("cell/Robot_800/Ready", "cell/Outputs/140") as updates:
            assert not next(updates)["cell/Robot_800/Ready"]
            assert [one.kind for one in remote.write({"cell/Outputs/140": 0x80})] == ["written"]
            update = next(one for one in updates if one["cell/Robot_800/Ready"])
            assert update["cell/Outputs/140"] == 0x80
        assert [one.kind for one in remote.write({"cell/lamps": [False, True, True, False]})] == ["written"]
        until(lambda: local["cell/lamps"] == [False, True, True, False], "the lamps")
        image = local.frame("cell").frame.image
        assert layout.value(image, "lamps").tolist() == [False, True, True, False]
        assert layout.value(image, "Robot_800/Ready") is True
        (row,) = FrameCodec(layout).decode(image)
        assert row["lamps"].tolist() == [False, True, True, False]


def test_shmio_v1_injects_under_the_name(cell: Cell, local: Attachment) -> None:
    assert local.write({"cell/Outputs/110": 0})[0].done
    until(lambda: local["cell/door/Closed"] is False, "the written byte")
    with connect(str(cell.grpc)) as remote, remote.inject("cell/door/Closed") as shadow:
        shadow.set({"cell/door/Closed": True})
        until(lambda: local["cell/Outputs/110"] == 1, "the injected bit in its byte")
        provenances = {one.path: str(one.provenance) for one in remote.get("cell/door/Closed", "cell/neighbours")}
        assert provenances == {"cell/door/Closed": "injected", "cell/neighbours": "live"}
    until(lambda: local["cell/door/Closed"] is False, "the controller's value")


def test_mqtt_and_opc_ua_have_the_names(cell: Cell, addresses: tuple[Address, Address], local: Attachment) -> None:
    broker, opcua = addresses
    with listening(broker, protocol=4) as listener:
        listener.publish("cell/Release/in", "true")
        assert listener.json("cell/Release/in/result")["done"]
    until(lambda: local["cell/Release"] is True, "the written bit")
    with Client(f"opc.tcp://{opcua}") as client:
        node = client.get_node("ns=2;s=cell/Release")
        assert node.read_value() is True
        node.write_value(False)
        assert client.get_node("ns=2;s=cell/lamps").read_value() == local["cell/lamps"]
    until(lambda: local["cell/Outputs/100.%X2"] is False, "the bit written by OPC UA")


def test_a_recording_has_the_names(cell: Cell, local: Attachment) -> None:
    assert local.write({"cell/door/Speed": 7.5})[0].done
    cell.output("shmio-dump", "record", "--for", "0.5", "-o", "more")
    (file,) = (cell.folder / "more").iterdir()
    lines = cell.output("shmio-dump", "cat", "--json", str(file), "cell/door/Speed").splitlines()
    values = [line["values"]["door/Speed"] for line in map(json.loads, lines) if "frame" in line]
    assert values[0] == 7.5
    cell.output("shmio-dump", "cut", str(file), "-o", "part.mem", "--only", "cell/Release")
    with closing(open_dump(cell.folder / "part.mem")) as dump:
        assert [one.path for one in dump.blocks[0].layout.registers] == ["Outputs", "Release"]


def test_a_reload_changes_the_names_only(cell: Cell, local: Attachment) -> None:
    before = cell.processes()
    (cell.folder / "names.toml").write_text(NAMES.replace('Beat = "Outputs/0"', 'Pulse = "Outputs/0.%X0"'))
    cell.output("shmio-supervisor", "reload")
    until(lambda: cell.processes()["cell"]["quality"] == "good", "good quality")
    found = json.loads(cell.output("shmio", "get", "--json", "Pulse", "Release"))
    assert sorted(found) == ["cell/Pulse", "cell/Release"]
    assert cell.run("shmio", "get", "Beat").returncode == 1
    assert cell.processes()["plc"]["pid"] == before["plc"]["pid"], "the emulator does not know the names"
