"""Payloads of any kind do no more harm than to turn registers bad."""

from __future__ import annotations

import contextlib
import json
import time
from types import SimpleNamespace
from typing import Any, Final

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from shmio.connectors.browsing import Wanted
from shmio.connectors.mqtt import json_path
from shmio.connectors.mqtt import store as store_module
from shmio.connectors.mqtt.address import parse
from shmio.connectors.mqtt.browse import Listener
from shmio.connectors.mqtt.options import MqttOptions
from shmio.connectors.mqtt.store import Store
from shmio.connectors.mqtt.topic import time_ns
from shmio.layout.values.codec import codec
from shmio.model.statuses import (
    BAD_DECODING_ERROR,
    BAD_OUT_OF_RANGE,
    BAD_TIMEOUT,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    StatusArea,
    quality_of,
)
from shmio.model.values import Quality
from shmio.wire import sparkplug_b_pb2 as wire
from tests.unit.connectors.source import layout_of

KINDS: Final = ("BOOL", "SINT", "UDINT", "ULINT", "REAL", "LREAL", "STRING[5]", "WSTRING[5]")
TEXTS = st.one_of(
    st.binary(max_size=40),
    st.text(alphabet="0123456789+-.eEnaif ", max_size=12).map(str.encode),
    st.sampled_from(
        [b"true", b"OFF", b"1", b"", b"\xff", b"-0", b"1e999", b"nan", b"inf", b"0x10", b"1_0", b"\xd9\xa3"]
    ),
    st.floats().map(lambda number: repr(number).encode()),
    st.integers().map(lambda number: str(number).encode()),
)
VALUES = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=False, allow_infinity=False) | st.integers() | st.text(max_size=6),
    lambda inside: st.lists(inside, max_size=4) | st.dictionaries(st.sampled_from("abc"), inside, max_size=3),
    max_leaves=8,
)


def store_of(tags: dict[str, Any], **options: Any) -> Store:
    given = {"url": "mqtt://127.0.0.1", "max_age_ms": 0} | options
    return Store(layout_of(tags), msgspec.convert(given, MqttOptions))


def check(store: Store) -> None:
    """Assert that each register of the image has a value of its type, and a status."""
    raw, area = store.image(0), StatusArea(store.layout)
    for index, register in enumerate(store.layout.registers):
        value = codec(register, store.layout.byte_order).decode(raw)
        if quality_of(area.get(raw, index).code) is Quality.GOOD:
            assert value is not None


@given(st.lists(TEXTS, max_size=4))
def test_texts(payloads: list[bytes]) -> None:
    store = store_of({kind.replace("[", "").replace("]", ""): (kind, "t") for kind in KINDS})
    for payload in payloads:
        store.take("t", payload, retained=False)
        check(store)


@given(VALUES)
@example({"a": [{"a": 1}], "b": {"c": [[1, 2], [3, 4]]}})
def test_json(document: Any) -> None:
    paths = ("$", "$.a", "$.a[0].a", "$.b.c", "$[1]", "$['c']", "$[a=1].b", "$.b[c=x].a")
    tags = {f"{at}/{n}": (kind, f"t {path}") for at, path in enumerate(paths) for n, kind in enumerate(KINDS)}
    tags |= {f"array{at}": ("ARRAY[1..2,1..2] OF INT", f"t {path}") for at, path in enumerate(paths)}
    store = store_of(tags, time="$.a", quality="@.b")
    with contextlib.suppress(UnicodeEncodeError):
        store.take("t", json.dumps(document).encode(), retained=False)
        check(store)


@given(st.binary(max_size=200))
@example(b"[" * 200_000)
@example(b'{"a":' * 5000 + b"1" + b"}" * 5000)
def test_what_is_no_json(payload: bytes) -> None:
    store = store_of({"a": ("INT", "t $.a"), "b": ("STRING[5]", "t")}, will="t $.a")
    store.take("t", payload, retained=False)
    check(store)


@given(VALUES)
def test_times(found: Any) -> None:
    assert 0 <= time_ns(found) < 1 << 63


@given(st.text(max_size=20).map("$".__add__))
def test_paths(text: str) -> None:
    with contextlib.suppress(ValueError):
        assert all(step == 0 or step for step in json_path.parse(text))


SPARKPLUG: Final = {
    "n": ("INT", "sparkplug G/N metric m0"),
    **{f"d/{kind[:5]}".replace("[", ""): (kind, f"sparkplug G/N/D metric m{at % 4}") for at, kind in enumerate(KINDS)},
    "array": ("ARRAY[1..3] OF INT", "sparkplug G/N/D metric m1"),
}


def test_each_topic_has_an_age_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages of other topics do not keep a silent one good, and a new message makes it good again."""
    now_ns = 1_000_000_000
    monkeypatch.setattr(store_module, "time", SimpleNamespace(monotonic_ns=lambda: now_ns, time_ns=time.time_ns))
    store = store_of({"a": ("INT", "a"), "b": ("INT", "b")}, max_age_ms=100)
    area = StatusArea(store.layout)
    for step, (topics, codes) in enumerate((
        ("ab", (GOOD, GOOD)), ("a", (GOOD, GOOD)), ("a", (GOOD, BAD_TIMEOUT)), ("", (GOOD, BAD_TIMEOUT)),
        ("", (BAD_TIMEOUT, BAD_TIMEOUT)), ("b", (BAD_TIMEOUT, GOOD)), ("", (BAD_TIMEOUT, GOOD)),
    )):  # fmt: skip
        for topic in topics:
            store.take(topic, b"1", retained=False)
        image = store.image(now_ns)
        assert (area.get(image, 0).code, area.get(image, 1).code) == codes, step
        now_ns += 60_000_000


def test_a_number_beyond_all_registers_is_bad() -> None:
    store = store_of({"number": ("LREAL", "t")})
    area = StatusArea(store.layout)
    for text, code in ((b"1e308", GOOD), (b"-1e309", BAD_OUT_OF_RANGE), (b"inf", GOOD), (b"1_0", BAD_DECODING_ERROR)):
        store.take("t", text, retained=False)
        assert area.get(store.image(0), 0).code == code


def test_a_metric_without_a_name_and_an_alias_is_no_value() -> None:
    """Alias 0 is a metric of its own."""
    store = store_of({"n": ("INT", "sparkplug G/N metric m0")})
    register, area = store.layout.registers[0], StatusArea(store.layout)
    born = [_metric("bdSeq", None, 4, 0, b"", 1, null=False), _metric("m0", 0, 3, 5, b"", 0, null=False)]
    store.take("spBv1.0/G/NBIRTH/N", wire.Payload(seq=0, metrics=born).SerializeToString(), retained=False)
    assert codec(register, store.layout.byte_order).decode(store.image(0)) == 5
    for seq, alias, code in ((1, 0, GOOD), (2, None, BAD_WAITING_FOR_INITIAL_DATA)):
        data = wire.Payload(seq=seq, metrics=[_metric(None, alias, 3, 6 + seq, b"", 0, null=False)])
        store.take("spBv1.0/G/NDATA/N", data.SerializeToString(), retained=False)
        image = store.image(0)
        assert (codec(register, store.layout.byte_order).decode(image), area.get(image, 0).code) == (7, code)


METRICS = st.builds(
    lambda name, alias, kind, number, data, how, null: _metric(name, alias, kind, number, data, how, null=null),
    st.none() | st.sampled_from(["m0", "m1", "m2", "bdSeq"]),
    st.none() | st.integers(0, 3),
    st.integers(0, 40),
    st.integers(0, (1 << 64) - 1),
    st.binary(max_size=12),
    st.integers(0, 7),
    st.booleans(),
)


def _metric(
    name: str | None, alias: int | None, kind: int, number: int, data: bytes, how: int, *, null: bool
) -> wire.Metric:
    made = wire.Metric(datatype=kind, timestamp=number)
    if name is not None:
        made.name = name
    if alias is not None:
        made.alias = alias
    if how == 0:
        made.int_value = number & 0xFFFFFFFF
    elif how == 1:
        made.long_value = number
    elif how == 2:
        made.double_value = float(number)
    elif how == 3:
        made.bytes_value = data
    elif how == 4:
        made.string_value = data.decode("latin1")
    elif how == 5:
        made.boolean_value = bool(number & 1)
    elif how == 6:
        made.is_null = null
        made.properties.keys.append("Quality")
    return made


@given(
    st.lists(st.tuples(st.sampled_from(["a", "a/b", "//", " $", "a $.b", "spBv1.0/G/DBIRTH/N/D"]), TEXTS), max_size=5)
)
def test_browsing_texts(messages: list[tuple[str, bytes]]) -> None:
    _browse(messages)


@given(VALUES)
@example({"'\"": 1, "": 2, "a": {".": [{"[": "x"}]}})
@example([[[1]]])
def test_browsing_json(document: Any) -> None:
    with contextlib.suppress(UnicodeEncodeError):
        _browse([("a/b", json.dumps(document).encode())])


def _browse(messages: list[tuple[str, bytes]]) -> None:
    """Assert that every address that browsing offers can be read."""
    listener = Listener(MqttOptions(url="mqtt://127.0.0.1"), Wanted())
    for topic, payload in messages:
        listener.take(topic, payload, retained=True)
    for one in listener.found().offers:
        assert bool(one.type) != bool(one.refused)
        if one.type:
            parse(str(one.columns["address"]))


def test_browsing_leaves_out_metrics_whose_names_are_not_utf_8() -> None:
    birth = wire.Payload(seq=0, metrics=[_metric("m0", 0, 3, 5, b"", 0, null=False)]).SerializeToString()
    _browse([("spBv1.0/G/NBIRTH/N", birth.replace(b"m0", b"m\xff"))])


def test_browsing_selects_named_objects() -> None:
    listener = Listener(MqttOptions(url="mqtt://127.0.0.1"), Wanted())
    objects = [{"id": "Line.a", "v": 1}, {"id": "Line.b", "v": 2}]
    listener.take("kep", json.dumps({"values": objects, "others": [{"id": "x"}, {"v": 3}]}).encode(), retained=True)
    assert [one.columns["address"] for one in listener.found().offers if one.type == "LREAL"] == [
        "kep $.values[id='Line.a'].v", "kep $.values[id='Line.b'].v", "kep $.others[1].v",
    ]  # fmt: skip


PAYLOADS = st.builds(
    lambda seq, metrics: wire.Payload(seq=seq, metrics=metrics, timestamp=seq).SerializeToString(),
    st.integers(0, 3),
    st.lists(METRICS, max_size=5),
)


@given(st.lists(st.tuples(st.integers(0, 7), PAYLOADS | st.binary(max_size=30)), max_size=12))
def test_sparkplug(messages: list[tuple[int, bytes]]) -> None:
    store = store_of(dict(SPARKPLUG))
    kinds = ("NBIRTH/N", "DBIRTH/N/D", "NDATA/N", "DDATA/N/D", "NDEATH/N", "DDEATH/N/D", "DBIRTH/N/E", "STATE")
    _browse([(f"spBv1.0/G/{kinds[kind]}", payload) for kind, payload in messages])
    for kind, payload in messages:
        store.take(f"spBv1.0/G/{kinds[kind]}", payload, retained=False)
        check(store)
        for at in range(len(store.layout.registers)):
            with contextlib.suppress(ValueError):
                store.command({at: 1})
