"""What reads bytes from the network or from files of others: for each parser, valid inputs and a check.

A check lets only the errors pass that the parser promises. An input of several messages has ``SPLIT`` between them.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import math
import random
import shutil
import socket
import struct
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from asyncua import ua
from google.protobuf.message import DecodeError
from snap7.datatypes import S7Area

from shmio.connectors.modbus.client import ModbusClient
from shmio.connectors.opcua import decode
from shmio.connectors.ros import cdr, websocket
from shmio.connectors.ros import messages as ros
from shmio.connectors.ros.addresses import FieldError, extract, parse
from shmio.connectors.ros.values import ValueConverter
from shmio.connectors.s7 import pdu, userdata
from shmio.connectors.s7.transport import Inbox
from shmio.emulators import s7 as emulator
from shmio.emulators.s7 import Jobs, Memory, ServerOptions
from shmio.endpoints.web.uploads import describe
from shmio.errors import ConnectorError, RecordingError, SnapshotError, ValueRangeError
from shmio.layout.addresses.modbus import Table
from shmio.layout.importing.found import ImportingError
from shmio.layout.importing.importer import import_tags
from shmio.layout.tags import place_tags
from shmio.layout.values.write import encode
from shmio.local import snapshot_file
from shmio.messages import declaration_from_wire, event_from_wire, value_from_wire
from shmio.wire import shmio_v1_pb2, sparkplug_b_pb2
from tests.fuzz.layout_checks import SPLIT
from tests.fuzz.layout_checks import check as check_layout
from tests.fuzz.layout_inputs import Mutator
from tests.fuzz.page_calls import calls, check_call
from tests.unit.connectors.mqtt import test_fuzz as mqtt
from tests.unit.connectors.opcua import test_decode as opcua
from tests.unit.connectors.s7 import test_traffic as s7_answers
from tests.unit.connectors.s7.noise import EMPTY, parts_of
from tests.unit.emulators import test_s7_jobs as s7_jobs
from tests.unit.emulators import test_s7_traffic as s7_requests
from tests.unit.layout.importing import test_importer as importers
from tests.unit.recording.reading.test_reader import look

MAX_INPUT = 8192
GOLDEN = Path(__file__).parents[1] / "golden"


class Parser(NamedTuple):
    """A parser under test."""

    inputs: Callable[[int], Iterator[bytes]]
    """Yields inputs for a seed, without end."""
    check: Callable[[bytes], None]
    share: float = 1.0
    """Its share of the time, compared with other parsers."""


def damaged(seeds: Callable[[], list[bytes]]) -> Callable[[int], Iterator[bytes]]:
    """Return a function that yields valid inputs with damage. Equal seeds of randomness give equal inputs."""

    def inputs(seed: int) -> Iterator[bytes]:
        rng = random.Random(seed)
        valid = seeds()
        while True:
            data = bytearray(rng.choice(valid))
            for _ in range(rng.choice((0, 1, 1, 2, 3, 8, 30))):
                _damage(data, rng, valid)
            yield bytes(data[: max(MAX_INPUT, len(valid[0]) * 2)])

    return inputs


def _damage(data: bytearray, rng: random.Random, valid: list[bytes]) -> None:
    at = rng.randrange(len(data) + 1)
    kind = rng.randrange(8)
    if kind == 0:
        data[at:at] = rng.randbytes(rng.randrange(1, 5))
    elif kind == 1:
        del data[at : at + rng.randrange(1, 30)]
    elif kind == 2 and at < len(data):
        data[at] = rng.randrange(256)
    elif kind == 3 and at < len(data):
        data[at] ^= 1 << rng.randrange(8)
    elif kind == 4:
        number = rng.choice((0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF))
        size = rng.choice((1, 2, 4, 8))
        data[at : at + size] = (number & ((1 << 8 * size) - 1)).to_bytes(size, rng.choice(("big", "little")))
    elif kind == 5:
        start = rng.randrange(len(data) + 1)
        data[at:at] = data[start : start + rng.randrange(1, 200)] * rng.choice((1, 1, 2, 50))
    elif kind == 6:
        other = rng.choice(valid)
        data[at:] = other[rng.randrange(len(other) + 1) :]
    else:
        word = rng.choice(
            (b"null", b"1e999", b"-1", b"{", b"[" * 300, b'"', b"}", b"\xff", b"\0", b"<a>", b",", b"NaN")
        )
        data[at : at + rng.choice((0, len(word)))] = word


# -- S7 ----------------------------------------------------------------------------------------------------------------


def _s7_frames() -> list[bytes]:
    read = pdu.request(1, b"\x04\x01", b"\xff\x04\x00\x20abcd")[4:]
    answer = bytes.fromhex("02f080320300000001000200080000 0401 ff040020") + b"abcd"
    several = bytes.fromhex("02f0803203000000010002000e0000 0402 ff040008 61 00 0a000000")
    setup = bytes.fromhex("02f0803203000000010008000000 00 f0000008000803c0")
    confirm = bytes.fromhex("11d00001000100c0010ac1020100c2020102")
    info = userdata.request(1, userdata.READ_SZL, userdata.szl_data(0x11))[4:]
    return [bytes((which,)) + frame for which in range(6) for frame in (answer, several, setup, confirm, read, info)]


def _check_s7_answer(data: bytes) -> None:
    """Parse a frame, with a right length in its first header, in one of the ways that the connector does."""
    if not data:
        return
    frame = memoryview(struct.pack(">BxH", 3, min(len(data) + 3, 0xFFFF)) + data[1:0xFFFC])
    with suppress(ConnectorError):
        if pdu.frame_length(frame, 0, 8192) != len(frame):
            return
        which = data[0] % 6
        if which == 0:
            pdu.reference_of(frame)
            assert len(pdu.parse_read_answer(frame).data) <= len(frame)
        elif which == 1:
            pdu.parse_items(frame, [1, 4])
        elif which == 2:
            session = pdu.parse_setup_answer(frame, 1, pdu.Session(960, 8))
            assert 1 <= session.jobs <= 8
        elif which == 3:
            pdu.parse_connect_confirm(frame)
        else:
            part = userdata.parse_answer(frame, userdata.READ_SZL)
            userdata.szl_records(part.data, 0x11)
            userdata.parse_clock(part.data)
            userdata.parse_block(part.data, 1)


def _s7_streams() -> list[bytes]:
    answers = [pdu.data_frame(frame[4:]) for frame in _s7_frames()[:4]]
    streams = [b"".join(map(add, answers)) for add in s7_answers.ADDED.values()]
    return [*streams, s7_requests.SETUP + EMPTY + s7_requests.READ_OF_EIGHT, parts_of(answers[0], 3, 9)]


class _Sender:
    """A client that sends given bytes, in pieces, and then leaves."""

    def __init__(self, data: bytes) -> None:
        self._left = data

    def recv_into(self, room: memoryview) -> int:
        count = min(len(room), len(self._left), 97)
        room[:count], self._left = self._left[:count], self._left[count:]
        return count


def _check_s7_stream(data: bytes) -> None:
    """Receive a stream in pieces, as the connector and the emulator do."""
    answers, sender = Inbox(2, 300), _Sender(data)
    with suppress(ConnectorError):
        while received := sender.recv_into(answers.room()):
            answers.add(received)
            while (frame := answers.frame()) is not None:
                assert pdu.FRAME_OVERHEAD <= len(frame) <= 300
                assert int.from_bytes(frame[2:4], "big") == len(frame)
    requests = emulator.Inbox(_Sender(data))  # type: ignore[arg-type]  # it only receives
    with suppress(emulator.ViolationError):
        while requests.receive():
            while (request := requests.pdu()) is not None:
                assert 0 < len(request) <= emulator.MAX_PDU_SIZE


def _check_s7_job(data: bytes) -> None:
    jobs = Jobs(Memory({(S7Area.DB, 1): (block := bytearray(100))}), ServerOptions())
    jobs.answer(s7_jobs.SETUP)
    for job in data.split(SPLIT)[:4]:
        if len(job) >= 10:  # the server reads whole headers
            answer = jobs.answer(memoryview(job))
            assert answer is None or len(answer) <= 960
    assert len(block) == 100


# -- Modbus ------------------------------------------------------------------------------------------------------------


class _Peer:
    """A Modbus device that answers each request, on a connection of its own, with given bytes."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self.answer = b""
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            connection, _ = self._listener.accept()
            with connection, suppress(OSError):
                request = connection.recv(300)
                connection.sendall((request[:2] if self.answer[:2] == b"TT" else self.answer[:2]) + self.answer[2:])


_peer = cache(_Peer)
_MODBUS = b"TT\0\0\0\7\1\3\4\0\1\0\2"


def _check_modbus(data: bytes) -> None:
    peer = _peer()
    peer.answer = data
    client = ModbusClient("127.0.0.1", peer.port, 5000)
    try:
        client.connect()
        client.begin()
        with suppress(ConnectorError):
            assert len(client.read(1, Table.HOLDING, 0, 2)) == 4
    finally:
        client.close()


# -- OPC UA ------------------------------------------------------------------------------------------------------------


def _opcua_messages() -> list[bytes]:
    changes = ua.DataChangeNotification()
    changes.MonitoredItems = [
        ua.MonitoredItemNotification(at, ua.DataValue(variant)) for at, (variant, _) in enumerate(opcua.VALUES)
    ]
    singly = [b"\0" + opcua.read(ua.DataValue(variant)) for variant, _ in opcua.VALUES]
    return [*singly, b"\0" + opcua.WHOLE, b"\1" + opcua.published(changes), b"\1" + opcua.published()]


def _check_opcua(data: bytes) -> None:
    with suppress(decode.MalformedError, decode.FaultError):
        (decode.publish_response if data[:1] == b"\1" else decode.read_response)(data[1:])


# -- MQTT, Sparkplug B, ROS --------------------------------------------------------------------------------------------

_KINDS = ("NBIRTH/N", "DBIRTH/N/D", "NDATA/N", "DDATA/N/D", "NDEATH/N", "DDEATH/N/D", "DBIRTH/N/E", "STATE")


def _sparkplug_messages() -> list[bytes]:
    def payload(seq: int, *kinds: int) -> bytes:
        named = [mqtt._metric(f"m{at}", at, kind, 7, b"abc", kind % 7, null=False) for at, kind in enumerate(kinds)]
        start = [mqtt._metric("bdSeq", None, 4, 0, b"", 1, null=False)]
        return bytes(sparkplug_b_pb2.Payload(seq=seq, metrics=start + named).SerializeToString())

    birth, data = b"\0" + payload(0, 3, 9, 12), b"\2" + payload(1, 3, 22, 12)
    return [SPLIT.join((birth, b"\1" + payload(1, 3, 10, 11, 12), data, b"\3" + payload(2, 3))), birth, data]


def _check_sparkplug(data: bytes) -> None:
    store = mqtt.store_of(dict(mqtt.SPARKPLUG))
    for message in data.split(SPLIT)[:8]:
        if message:
            topic = f"spBv1.0/G/{_KINDS[message[0] % 8]}"
            mqtt._browse([(topic, message[1:])])
            store.take(topic, message[1:], retained=False)
            mqtt.check(store)


def _mqtt_payloads() -> list[bytes]:
    document = json.dumps({"a": [{"a": 1}], "b": {"c": [[1, 2], [3, 4]]}, "t": "2024-02-29T12:00:00Z"}).encode()
    objects = json.dumps([{"id": "x", "v": 5, "q": 192, "t": 1709208000}, {"id": 7, "v": math.nan}]).encode()
    return [document, objects, b"12", b"true", b"-1.5e3", b'"text"', b"[1, [2, 3]]", "Größe".encode()]


def _check_mqtt(data: bytes) -> None:
    paths = ("$", "$.a", "$.a[0].a", "$.b.c", "$[1]", "$[id=x].v")
    tags: dict[str, Any] = {
        f"{at}/{n}": (kind, f"t {path}" if at else "t")
        for at, path in enumerate(paths)
        for n, kind in enumerate(mqtt.KINDS)
    }
    store = mqtt.store_of(tags, time="@.t", quality="@.q")
    store.take("t", data, retained=False)
    mqtt.check(store)
    mqtt._browse([("a/b", data)])


def _ros_messages() -> list[bytes]:
    kinds = sorted(ros.DEFINITIONS)
    return [bytes((at,)) + json.dumps(ros.default(kind)).encode() for at, kind in enumerate(kinds)] + [
        bytes((kinds.index("sensor_msgs/JointState"),)) + b'{"name": ["a"], "position": [0.5], "effort": [1]}',
        b'\0{"layout": {"dim": [{"size": 2, "stride": 2}, {"size": 1, "stride": 1}]}, "data": [NaN, 2]}',
        b'\0{"op": "publish", "topic": "/t", "msg": {"a": [Infinity, 1e999]}}',
    ]


def _cdr_messages() -> list[bytes]:
    """Return a message of each type whose values are all zero, and one with values."""
    kinds = sorted(ros.DEFINITIONS)
    start = b"\0\1\0\0" + bytes(8)
    texts = struct.pack("<I2s2xI2s2xI2s2x", 2, b"f\0", 2, b"a\0", 2, b"b\0")
    numbers = struct.pack("<I4x2d", 2, 1.5, -2.5)
    return [bytes((at,)) + start + bytes(200) for at in range(len(kinds))] + [
        bytes((kinds.index("sensor_msgs/JointState"),)) + start + texts + numbers * 3
    ]


def _check_cdr(data: bytes) -> None:
    kinds = sorted(ros.DEFINITIONS)
    with suppress(ValueError, struct.error):
        kind = kinds[data[0] % len(kinds)] if data else kinds[0]
        found = cdr.decode(data[1:], kind)
        assert found is None or found.keys() == ros.DEFINITIONS[kind].keys()


@cache
def _ros_registers() -> list[ValueConverter]:
    tags = {kind.replace("[", "").replace("]", ""): {"type": kind, "address": "0"} for kind in mqtt.KINDS}
    return [ValueConverter(register, None) for register in place_tags("x", tags).registers]


_MATRIX = parse("/m std_msgs/Float64MultiArray data")


def _check_ros(data: bytes) -> None:
    websocket._read(data[1:])
    found = websocket.decode(msgspec.Raw(data[1:]))
    with suppress(FieldError):
        extract(found, _MATRIX)
    kinds = sorted(ros.DEFINITIONS)
    if found is None or not data:
        return
    if ros.conforms(found, kinds[data[0] % len(kinds)]):
        ros.finite(found)
    for value in found.values() if isinstance(found, dict) else (found,):
        for converter in _ros_registers():
            with suppress(FieldError, ValueRangeError):
                converter.value(value)


# -- gRPC --------------------------------------------------------------------------------------------------------------


def _grpc_messages() -> list[bytes]:
    wire = shmio_v1_pb2
    values = [wire.Value(integer=-5), wire.Value(text="Größe"), wire.Value(number=1.5), wire.Value(unsigned=1 << 63)]
    values.append(wire.Value(list=wire.List(values=[*values, wire.Value(list=wire.List(values=values))])))
    noise = wire.Declaration(name="n", targets=["cell/a"], noise=wire.Noise(amplitude=1.0), when="a > 1", for_s=2.0)
    clamp = wire.Declaration(name="c", targets=["a", "b"], clamp=wire.Clamp(max=2.0), seed=7)
    event = wire.Event(source="cell", text="x")
    return [
        *(b"\0" + bytes(value.SerializeToString()) for value in values),
        *(b"\1" + bytes(one.SerializeToString()) for one in (noise, clamp)),
        b"\2" + bytes(event.SerializeToString()),
    ]


def _check_grpc(data: bytes) -> None:
    which = data[0] % 3 if data else 0
    kind = (shmio_v1_pb2.Value, shmio_v1_pb2.Declaration, shmio_v1_pb2.Event)[which]
    try:
        message: Any = kind.FromString(data[1:])
    except DecodeError:  # grpcio refuses such a message
        return
    with suppress(ValueRangeError):
        if which == 0:
            value = value_from_wire(message, "a")
            for register in mqtt.store_of(
                {kind[:5].replace("[", ""): (kind, "t") for kind in mqtt.KINDS}
            ).layout.registers:
                with suppress(ValueRangeError):
                    encode(register, value)
        elif which == 1:
            declaration_from_wire(message, "injection")
        else:
            event_from_wire(message)


# -- files -------------------------------------------------------------------------------------------------------------


@cache
def _folder() -> Path:
    made = tempfile.mkdtemp(prefix="fuzz-files-")
    atexit.register(shutil.rmtree, made)
    return Path(made)


def _check_recording(data: bytes) -> None:
    file = _folder() / "x.mem"
    file.write_bytes(data)
    with suppress(RecordingError):
        look(file)


def _snapshots() -> list[bytes]:
    file = _folder() / "seed.snapshot"
    head = snapshot_file.SnapshotHead("a50", 1.0, 2, 2, 40_000_000, 20_000_000, {"cell": "00"}, {"plc": "no state"})
    snapshot_file.write_snapshot(file, _folder(), head, {"cell": b"abc"})
    return [file.read_bytes()]


def _check_snapshot(data: bytes) -> None:
    """Read a file, with a checksum that is right."""
    size = snapshot_file._HEADER.size
    file = _folder() / "x.snapshot"
    for content in (data, data[: size - 32] + hashlib.sha256(data[size:]).digest() + data[size:]):
        file.write_bytes(content)
        with suppress(SnapshotError):
            snapshot_file.read_snapshot(file)


def _check_import(data: bytes) -> None:
    with suppress(ImportingError):
        found = import_tags(data)
        if found.tags:
            importers.summary(found)
    for encoding in ("gbk", "utf-16"):
        with suppress(ImportingError):
            import_tags(data, further=importers.FURTHER, encoding=encoding, by_name=True)


def _uploads() -> list[bytes]:
    found = []
    for sample in (*importers.SAMPLES, (GOLDEN.parents[1] / "db201.db").read_bytes()):
        head = json.dumps([{"name": "a.db", "size": len(sample)}]).encode()
        found.append(head + b"\n" + sample)
    return found


def _check_upload(data: bytes) -> None:
    head, _, rest = data.partition(b"\n")
    describe(data)
    with suppress(ValueError, TypeError, LookupError, RecursionError, OverflowError):  # with sizes that fit
        files = json.loads(head)
        files[-1]["size"] += len(rest) - sum(int(file["size"]) for file in files)
        describe(json.dumps(files).encode() + b"\n" + rest)


def _recordings() -> list[bytes]:
    return [(GOLDEN / "dump" / name).read_bytes() for name in ("closed.mem", "killed.mem", "differences.mem")]


PARSERS: dict[str, Parser] = {
    "layout": Parser(lambda seed: iter(Mutator(seed)), check_layout, 3.0),
    "s7-answer": Parser(damaged(_s7_frames), _check_s7_answer),
    "s7-stream": Parser(damaged(_s7_streams), _check_s7_stream),
    "s7-job": Parser(damaged(lambda: [bytes(one) for one in s7_jobs.VALID]), _check_s7_job),
    "modbus": Parser(damaged(lambda: [_MODBUS, b"TT\0\0\0\3\1\x83\2"]), _check_modbus),
    "opcua": Parser(damaged(_opcua_messages), _check_opcua),
    "mqtt": Parser(damaged(_mqtt_payloads), _check_mqtt),
    "sparkplug": Parser(damaged(_sparkplug_messages), _check_sparkplug),
    "ros": Parser(damaged(_ros_messages), _check_ros),
    "ros-cdr": Parser(damaged(_cdr_messages), _check_cdr),
    "grpc": Parser(damaged(_grpc_messages), _check_grpc),
    "recording": Parser(damaged(_recordings), _check_recording),
    "snapshot": Parser(damaged(_snapshots), _check_snapshot),
    "import": Parser(damaged(lambda: importers.SAMPLES), _check_import),
    "upload": Parser(damaged(_uploads), _check_upload),
    "page-call": Parser(damaged(calls), check_call),
}
