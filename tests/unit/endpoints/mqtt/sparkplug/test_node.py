"""An edge node of Sparkplug B: its protocol rules, and its messages as another implementation reads them."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.endpoints.mqtt.sparkplug.node import MAX_METRICS, REBIRTH, Command, EdgeNode, Sample, parts_of
from shmio.endpoints.mqtt.topics import Message
from shmio.errors import CommandError, PathError, ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.values.codec import codec
from shmio.segment import Quality
from shmio.wire import sparkplug_b_pb2 as wire

NODE = Path(__file__).parents[2] / "node"
NOW_MS = 1_700_000_000_000
AT_MS = NOW_MS - 5

_TYPES = (
    ("BOOL", 1), ("SINT", 1), ("USINT", 1), ("INT", 2), ("UINT", 2), ("DINT", 4), ("UDINT", 4), ("LINT", 8),
    ("ULINT", 8), ("REAL", 4), ("LREAL", 8), ("TIME", 4), ("DATE", 2), ("STRING[10]", 12),
)  # fmt: skip
VALUES: dict[str, Any] = {
    "BOOL": True, "SINT": -128, "USINT": 255, "INT": -2, "UINT": 65535, "DINT": -(2**31), "UDINT": 2**32 - 1,
    "LINT": -5_000_000_000, "ULINT": 2**64 - 1, "REAL": 0.5, "LREAL": -1e300, "TIME": -1, "DATE": "2024-02-29",
    "STRING[10]": "grün",
}  # fmt: skip


def _registers() -> list[Register]:
    found, offset = [], 0
    for name, size in _TYPES:
        found.append(Register(name, name, (), offset, 0 if name == "BOOL" else None, size, 1))
        offset += size + size % 2
    for name, size in (("BOOL", 3), ("INT", 24), ("REAL", 48), ("STRING[10]", 144)):
        found.append(Register(f"row/{name}", name, ((1, 3), (0, 3)), offset, None, size, 12))
        offset += size + size % 2
    return found


REGISTERS = _registers()
LAYOUT = Layout("ALL", None, 512, False, tuple(REGISTERS))
AXIS = Layout("AXIS", None, 4, False, (Register("position", "REAL", (), 0, None, 4, 1),))


def node(*, datatypes: bool = True) -> EdgeNode:
    edge = EdgeNode("plant", "a50", lambda: NOW_MS, datatypes=datatypes)
    edge.define({name: parts_of(layout, layout.registers) for name, layout in (("cell", LAYOUT), ("axis", AXIS))})
    return edge


def payload(message: Message) -> wire.Payload:
    return wire.Payload.FromString(message.payload)


def samples(edge: EdgeNode, device: str = "cell", **values: Any) -> list[Sample]:
    given = VALUES | values if device == "cell" else values
    return [Sample(metric, given.get(name), AT_MS) for name, metric in edge.metrics[device].items()]


def bd_seq(message: Message) -> int:
    return next(metric.long_value for metric in payload(message).metrics if metric.name == "bdSeq")


def test_a_session_starts_with_a_will_and_a_birth_of_its_number() -> None:
    edge = node()
    first = edge.will()
    assert (first.topic, first.qos) == ("spBv1.0/plant/NDEATH/a50", 1)
    assert not payload(first).HasField("seq")
    birth = edge.birth()
    assert (birth.topic, birth.qos, payload(birth).seq) == ("spBv1.0/plant/NBIRTH/a50", 0, 0)
    assert bd_seq(birth) == bd_seq(first)
    (rebirth,) = [metric for metric in payload(birth).metrics if metric.name == REBIRTH]
    assert (rebirth.boolean_value, rebirth.HasField("alias")) == (False, False)
    assert bd_seq(edge.birth()) == bd_seq(first), "a requested birth belongs to the same session"
    assert bd_seq(edge.will()) == (bd_seq(first) + 1) % 256
    assert bd_seq(edge.death()) == (bd_seq(first) + 1) % 256


def test_a_process_that_restarts_soon_starts_a_new_session() -> None:
    first = EdgeNode("plant", "a50", lambda: NOW_MS)
    second = EdgeNode("plant", "a50", lambda: NOW_MS + 250)
    assert bd_seq(first.will()) != bd_seq(second.will())


def test_sequence_numbers_span_all_devices_and_restart_at_a_birth() -> None:
    edge = node()
    edge.will()
    (position,) = edge.metrics["axis"].values()
    numbers = [payload(edge.birth()).seq, payload(edge.device_birth("cell", samples(edge))).seq]
    numbers += [payload(edge.device_birth("axis", [])).seq]
    numbers += [payload(edge.data("axis", [Sample(position, 1.5, AT_MS)])).seq for _ in range(300)]
    numbers += [payload(edge.device_death("axis")).seq]
    assert numbers == [number % 256 for number in range(304)]
    assert payload(edge.birth()).seq == 0


def test_a_device_is_born_until_its_death_or_the_next_session() -> None:
    edge = node()
    edge.will()
    edge.birth()
    assert not edge.is_born("axis")
    birth = edge.device_birth("axis", [])
    assert edge.is_born("axis")
    assert birth.topic == "spBv1.0/plant/DBIRTH/a50/axis"
    (metric,) = payload(birth).metrics
    assert (metric.name, metric.is_null, metric.timestamp) == ("position", True, NOW_MS)
    assert list(metric.properties.keys) == ["Quality", "Reason"]
    assert metric.properties.values[0].int_value == 0
    assert edge.device_death("axis").topic == "spBv1.0/plant/DDEATH/a50/axis"
    assert not edge.is_born("axis")
    edge.device_birth("axis", [])
    edge.will()
    assert not edge.is_born("axis")


def test_aliases_are_unique_in_the_node_and_replace_names_in_data() -> None:
    edge = node(datatypes=False)
    edge.will()
    edge.birth()
    births = [payload(edge.device_birth(device, samples(edge, device))) for device in ("cell", "axis")]
    aliases = [metric.alias for birth in births for metric in birth.metrics]
    assert len(set(aliases)) == len(aliases) == len(REGISTERS) + 12 - 1 + 1
    (position,) = edge.metrics["axis"].values()
    data = payload(edge.data("axis", [Sample(position, 2.0, AT_MS)], historical=True))
    (metric,) = data.metrics
    assert (metric.alias, metric.float_value, metric.timestamp, metric.is_historical) == (aliases[-1], 2.0, AT_MS, True)
    assert not metric.HasField("name")
    assert not metric.HasField("datatype")


def test_quality_and_reason_are_properties_of_a_metric() -> None:
    edge = node()
    (position,) = edge.metrics["axis"].values()
    doubtful = Sample(position, 2.0, AT_MS, Quality.UNCERTAIN, "the CPU is in STOP")
    (metric,) = payload(edge.data("axis", [doubtful])).metrics
    quality, reason = metric.properties.values
    assert (quality.type, quality.int_value, reason.string_value) == (3, 500, "the CPU is in STOP")


def test_values_survive_a_round_trip() -> None:
    edge = node()
    rows: dict[str, Any] = {
        "row/BOOL": [[True, False, True, True], [False] * 4, [True] * 4],
        "row/INT": [[-1, 2, -3, 32767], [0] * 4, [-32768] * 4],
        "row/REAL": [[0.5, -1.5, 3.0, 2.0**90], [0.0] * 4, [1.0] * 4],
        **{f"row/STRING[10]/{i}/{j}": f"{i} {j}" for i in (1, 2, 3) for j in (0, 1, 2, 3)},
    }
    birth = payload(edge.device_birth("cell", samples(edge, **rows)))
    for found in birth.metrics:
        metric = edge.metrics["cell"][found.name]
        value = metric.take(found)
        assert value == (VALUES | rows)[found.name], found.name
        codec(metric.register).encode_into(value, bytearray(LAYOUT.size))


def test_an_array_with_an_invalid_element_is_null() -> None:
    row = Layout("ROW", None, 8, False, (Register("at", "TIME_OF_DAY", ((0, 1),), 0, None, 8, 2),))
    edge = EdgeNode("plant", "a50", lambda: NOW_MS)
    edge.define({"cell": row.registers})
    (metric,) = edge.metrics["cell"].values()
    (found,) = payload(edge.data("cell", [Sample(metric, [5, None], AT_MS)])).metrics
    assert found.is_null
    assert not found.WhichOneof("value")


def test_an_array_of_large_numbers_keeps_all_their_digits() -> None:
    row = Layout("ROW", None, 24, False, (Register("at", "ULINT", ((0, 2),), 0, None, 24, 3),))
    edge = EdgeNode("plant", "a50", lambda: NOW_MS)
    edge.define({"cell": row.registers})
    (metric,) = edge.metrics["cell"].values()
    value = [0, 2**64 - 1, 2**53 + 1]
    (found,) = payload(edge.data("cell", [Sample(metric, value, AT_MS)])).metrics
    assert found.bytes_value == b"".join(one.to_bytes(8, "little") for one in value)
    assert metric.take(found) == value


def commanded(edge: EdgeNode, device: str = "axis", **fields: Any) -> Command:
    given = wire.Payload(timestamp=NOW_MS, metrics=[wire.Metric(**fields)])
    return edge.command(f"spBv1.0/plant/DCMD/a50/{device}", given.SerializeToString())


def test_commands_use_names_or_aliases() -> None:
    edge = node()
    (position,) = edge.metrics["axis"].values()
    assert edge.commands == ["spBv1.0/plant/NCMD/a50", "spBv1.0/plant/DCMD/a50/+"]
    assert commanded(edge, name="position", float_value=2.5) == Command(device="axis", values={"position": 2.5})
    assert commanded(edge, alias=position.alias, double_value=3.5).values == {"position": 3.5}
    assert commanded(edge, name="", alias=position.alias, float_value=4.5).values == {"position": 4.5}
    assert commanded(edge, "cell", name="DINT", int_value=2**32 - 7).values == {"DINT": -7}
    assert commanded(edge, "cell", name="DINT", long_value=2**64 - 7).values == {"DINT": -7}
    assert commanded(edge, "cell", name="UINT", long_value=7).values == {"UINT": 7}
    rebirth = wire.Payload(metrics=[wire.Metric(name=REBIRTH, boolean_value=True)]).SerializeToString()
    assert edge.command("spBv1.0/plant/NCMD/a50", rebirth).rebirth


@pytest.mark.parametrize(
    ("device", "fields", "error", "message"),
    [
        (
            "axis",
            {"name": "positron", "float_value": 1},
            PathError,
            "unknown metric 'positron'; did you mean 'position'?",
        ),
        ("axis", {"alias": 1, "float_value": 1}, PathError, "unknown metric 'alias 1'"),  # an alias of another device
        ("axis", {"float_value": 1}, PathError, "unknown metric 'alias 0'"),
        ("axle", {"name": "position", "float_value": 1}, PathError, "unknown device 'axle'; "),
        ("axis", {"name": "position"}, ValueRangeError, "there is no value"),
        ("axis", {"name": "position", "is_null": True, "float_value": 1}, ValueRangeError, "there is no value"),
        (
            "axis",
            {"name": "position", "string_value": "1"},
            ValueRangeError,
            "the field string_value does not fit the type REAL",
        ),
        ("cell", {"name": "BOOL", "int_value": 1}, ValueRangeError, "the field int_value does not fit the type BOOL"),
        ("cell", {"name": "row/INT", "bytes_value": b"\0" * 23}, ValueRangeError, "all of the array's 12 elements"),
        ("cell", {"name": "row/BOOL", "bytes_value": b"\x0d\0\0\0\0\0"}, ValueRangeError, "12 bits"),
    ],
)
def test_invalid_commands_are_refused(
    device: str, fields: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        commanded(node(), device, **fields)


def test_a_command_needs_metrics_without_repeats_and_within_the_limits() -> None:
    edge = node()
    topic = "spBv1.0/plant/DCMD/a50/axis"
    one = wire.Metric(name="position", float_value=1)
    for metrics, message in (([], "no metrics"), ([one, one], "given twice"), ([one] * (MAX_METRICS + 1), "most")):
        with pytest.raises(ValueRangeError, match=message):
            edge.command(topic, wire.Payload(metrics=metrics).SerializeToString())
    with pytest.raises(ValueRangeError, match="longer than 1048576 bytes"):
        edge.command(topic, bytes((1 << 20) + 1))
    with pytest.raises(PathError, match="accepts only"):
        edge.command("spBv1.0/plant/NCMD/a50", wire.Payload(metrics=[one]).SerializeToString())


METRICS = st.lists(
    st.builds(
        wire.Metric,
        name=st.sampled_from(["", "DINT", "BOOL", "row/INT", "row/BOOL", "STRING[10]", "ULINT", REBIRTH]) | st.text(),
        alias=st.integers(0, 2**64 - 1) | st.integers(0, 30),
        datatype=st.integers(0, 2**32 - 1),
        is_null=st.booleans(),
    ),
    max_size=5,
)
FIELDS: st.SearchStrategy[dict[str, Any]] = st.fixed_dictionaries(
    {},
    optional={
        "int_value": st.integers(0, 2**32 - 1),
        "long_value": st.integers(0, 2**64 - 1),
        "float_value": st.floats(width=32),
        "double_value": st.floats(),
        "boolean_value": st.booleans(),
        "string_value": st.text(),
        "bytes_value": st.binary(max_size=40),
    },
)


@given(METRICS, st.lists(FIELDS, max_size=5))
def test_any_command_gives_values_of_its_registers_or_is_refused(
    metrics: list[wire.Metric], fields: list[dict[str, Any]]
) -> None:
    edge = node()
    for metric, given_fields in zip(metrics, fields, strict=False):
        for name, value in given_fields.items():
            setattr(metric, name, value)
    data = wire.Payload(metrics=metrics).SerializeToString()
    try:
        command = edge.command("spBv1.0/plant/DCMD/a50/cell", data)
    except (ValueRangeError, PathError):
        return
    for path, value in command.values.items():
        with suppress(ValueRangeError):
            codec(edge.metrics["cell"][path].register).encode_into(value, bytearray(LAYOUT.size))


def _length(size: int) -> bytes:
    found = bytearray()
    while size > 127:
        found.append(size & 0x7F | 0x80)
        size >>= 7
    return bytes([*found, size])


def _nested() -> bytes:
    data = b""
    for _ in range(2000):
        data = b"\x12" + _length(len(data)) + data  # metrics of a template
        data = b"\x92\x01" + _length(len(data)) + data  # template_value of a metric
    return b"\x12" + _length(len(data)) + data


@pytest.mark.parametrize("data", [_nested(), b"\x1b" * 100_000], ids=["templates", "groups"])
def test_deeply_nested_payloads_are_refused(data: bytes) -> None:
    with pytest.raises((ValueRangeError, PathError)):
        node().command("spBv1.0/plant/DCMD/a50/cell", data)


def test_a_register_that_is_not_writable_is_reported_before_its_invalid_value() -> None:
    def check(device: str, register: Register) -> None:
        raise CommandError(f"{device}/{register.path} is not writable")

    data = wire.Payload(metrics=[wire.Metric(name="DINT", string_value="x")]).SerializeToString()
    with pytest.raises(CommandError, match="cell/DINT is not writable"):
        node().command("spBv1.0/plant/DCMD/a50/cell", data, check)


@given(st.binary(max_size=200))
def test_garbage_is_refused(data: bytes) -> None:
    for topic in ("spBv1.0/plant/DCMD/a50/cell", "spBv1.0/plant/NCMD/a50"):
        with pytest.raises((ValueRangeError, PathError)):
            node().command(topic, data)


def test_elements_of_arrays_can_be_separate_metrics() -> None:
    edge = EdgeNode("plant", "a50", lambda: NOW_MS)
    edge.define({"cell": parts_of(LAYOUT, LAYOUT.registers, single=True)})
    assert len(edge.metrics["cell"]) == len(REGISTERS) + 4 * (12 - 1)
    edge.will()
    edge.birth()
    born = {metric.name: metric.datatype for metric in payload(edge.device_birth("cell", [])).metrics}
    assert (born["row/BOOL/3/2"], born["row/INT/1/0"], born["row/REAL/2/3"]) == (11, 3, 9)
    assert commanded(edge, "cell", name="row/INT/2/1", int_value=7).values == {"row/INT/2/1": 7}
    assert commanded(edge, "cell", name="row/BOOL/2/1", boolean_value=True).values == {"row/BOOL/2/1": True}


def test_texts_of_an_array_are_separate_metrics() -> None:
    found = [register.path for register in parts_of(LAYOUT, LAYOUT.registers)]
    assert len(found) == len(REGISTERS) + 12 - 1
    assert found[-2:] == ["row/STRING[10]/3/2", "row/STRING[10]/3/3"]


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node")
def test_another_implementation_reads_and_commands_the_node() -> None:
    assert (NODE / "node_modules").exists(), f"packages for Node are not installed: run npm ci --prefix {NODE}"
    edge = node()
    edge.will()
    scalars = [sample for sample in samples(edge) if "row" not in sample.metric.name]
    given = [edge.birth().payload, edge.device_birth("cell", samples(edge)).payload]
    given.append(edge.data("cell", scalars, historical=True).payload)
    command = {
        "timestamp": NOW_MS,
        "metrics": [
            {"name": "DINT", "type": "Int32", "value": -5},
            {"name": "LREAL", "type": "Double", "value": 2.25},
            {"name": "STRING[10]", "type": "String", "value": "für"},
            {"name": "BOOL", "type": "Boolean", "value": False},
        ],
    }
    lines = [json.dumps({"decode": base64.b64encode(data).decode()}) for data in given]
    lines.append(json.dumps({"encode": command}))
    done = subprocess.run(
        ["node", NODE / "sparkplug.js"], input="\n".join(lines), capture_output=True, text=True, timeout=60, check=True
    )
    birth, device, data, encoded = json.loads(done.stdout)
    assert birth["seq"] == 0
    assert {metric["name"]: metric["value"] for metric in birth["metrics"]}[REBIRTH] is False
    found = {metric["name"]: metric["value"] for metric in device["metrics"] if "row" not in metric["name"]}
    assert found == VALUES | {"ULINT": 18446744073709552000}  # JavaScript's numbers have 53 bits
    aliases = {metric.alias: name for name, metric in edge.metrics["cell"].items()}
    assert {aliases[int(metric["alias"])]: metric["value"] for metric in data["metrics"]} == found
    assert all(metric["isHistorical"] and int(metric["at"]) == AT_MS for metric in data["metrics"])
    assert edge.command("spBv1.0/plant/DCMD/a50/cell", base64.b64decode(encoded)).values == {
        "DINT": -5, "LREAL": 2.25, "STRING[10]": "für", "BOOL": False,
    }  # fmt: skip
