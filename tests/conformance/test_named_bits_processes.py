"""After any accepted write, exactly what the write names has changed: with servers in processes of their own."""

from __future__ import annotations

import ast
import itertools
import json
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st

from shmio.connectors.opcua.connector import OpcUaConnector
from shmio.connectors.opcua.options import OpcUaOptions
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.local import writer as writer_module
from shmio.model.values import WRITERS
from shmio.testing.conformance import connect
from shmio.testing.mosquitto import Mosquitto, missing
from shmio.testing.ports import reserved_port
from shmio.testing.write_conformance import write as confirmed
from tests.conformance.test_named_bits import (
    INTEGERS,
    SIGNED,
    Key,
    Named,
    Part,
    Tag,
    Writer,
    as_commands,
    random_tags,
    run,
)
from tests.conformance.test_named_bits_endpoints import EXAMPLES, Sources, whole_bytes
from tests.unit.connectors.opcua.device import Device
from tests.unit.endpoints.mqtt.harness import PREFIX, bridge, listening

RESULTS = "shmio/results/me"
UA_TYPES = {
    "BOOL": "Boolean",
    "BYTE": "Byte",
    "SINT": "SByte",
    "INT": "Int16",
    "WORD": "UInt16",
    "DINT": "Int32",
    "UDINT": "UInt32",
    "LINT": "Int64",
    "REAL": "Float",
    "LREAL": "Double",
    "STRING[4]": "String",
}
FIELDS = [
    ("A", "Boolean", ""), ("B", "Boolean", ""), ("Words", "UInt16", "array"), ("Count", "Int32", ""),
    ("Text", "String", ""), ("Real", "Double", ""), ("Flags", "Boolean", "array"),
]  # fmt: skip
MEMBERS = {
    "m_a": ("rec#A", Tag("BOOL", (), ("rec", "A"))),
    "m_words": ("rec#Words", Tag("UINT", (4,), ("rec", "Words"), 1)),
    "m_word": ("rec#Words[2]", Tag("UINT", (), ("rec", "Words", 2))),
    "m_count": ("rec#Count", Tag("DINT", (), ("rec", "Count"))),
    "m_text": ("rec#Text", Tag("STRING[4]", (), ("rec", "Text"))),
    "m_flags": ("rec#Flags", Tag("BOOL", (9,), ("rec", "Flags"))),
}
"""Members of a structure: the node and the member, and the register."""


class OpcUaSourceRig:
    """A server of variables, arrays and a structure; some members are no register's."""

    def __init__(self, stack: ExitStack, _: str, __: Path) -> None:
        self._device = stack.enter_context(Device())
        self._device.ask("define", "Rec", FIELDS)
        self._numbers = itertools.count()
        self._nodes: list[str] = []

    def layout(self, draw: st.DataObject) -> tuple[Layout, Mapping[str, Tag]]:
        noise = random.Random(draw.draw(st.integers(0, 1 << 32)))
        for name in self._nodes:
            self._device.ask("remove", name)
        prefix = f"e{next(self._numbers)}"
        found = random_tags(draw, list(UA_TYPES), lambda kind, shape: ())
        tags = {path: tag._replace(place=(f"{prefix}{path}",)) for path, tag in found.items()}
        self._nodes = [tag.place[0] for tag in tags.values()]
        for tag in tags.values():
            self._device.ask("add", tag.place[0], UA_TYPES[tag.kind], drawn(noise, tag.kind, tag.shape))
        record = {"A": True, "B": True, "Count": -5, "Text": "ab", "Real": 1.5}
        record["Words"], record["Flags"] = drawn(noise, "WORD", (4,)), drawn(noise, "BOOL", (9,))
        self._device.ask("structure", "rec", "Rec", record)
        self._device.ask("allow", "rec")
        given = {path: {"type": tag.type, "address": f"ns=2;s={tag.place[0]}"} for path, tag in tags.items()}
        given |= {path: {"type": tag.type, "address": f"ns=2;s={address}"} for path, (address, tag) in MEMBERS.items()}
        tags |= {path: tag for path, (_, tag) in MEMBERS.items()}
        return place_tags("plant", given).with_statuses(), tags

    def state(self) -> Mapping[Key, object]:
        return {
            key: value
            for name in [*self._nodes, "rec"]
            for steps, leaf in leaves(plain(self._device.ask("get", name)), (name,))
            for key, value in bits(steps, leaf)
        }

    def keys(self, tag: Tag, part: Part) -> set[Key]:
        keys: set[Key] = set()
        for element in part.elements:
            steps: Key = ()
            rest = element
            for length in reversed(tag.shape):
                rest, at = divmod(rest, length)
                steps = (at, *steps)
            steps = (*tag.place, *steps)
            if tag.kind not in INTEGERS:
                keys.add(steps)
                continue
            size = 8 * INTEGERS[tag.kind]
            first, stop = (0, size) if part.bit is None else (part.bit, part.bit + 1)
            if stop == size and tag.kind in SIGNED:
                stop = 64  # the sign is repeated
            keys.update((*steps, "bit", one) for one in range(first, stop))
        return keys

    @contextmanager
    def writer(self, layout: Layout) -> Iterator[Writer]:
        connector = OpcUaConnector(OpcUaOptions(url=self._device.url, timeout=20_000, publishing_ms=10), layout)
        try:
            connect(connector)
            yield as_commands(layout, lambda writes: confirmed(connector, writes))
        finally:
            connector.close()


def drawn(noise: random.Random, kind: str, shape: tuple[int, ...]) -> Any:
    """Draw a value of a type."""
    if shape:
        return [drawn(noise, kind, shape[1:]) for _ in range(shape[0])]
    if kind in INTEGERS:
        size = 8 * INTEGERS[kind]
        return noise.getrandbits(size) - ((1 << size - 1) if kind in SIGNED else 0)
    if kind == "BOOL":
        return noise.random() < 0.5
    return float(noise.randrange(1000)) if "REAL" in kind else "xyz"


def plain(value: Any) -> Any:
    """Return what the server says of a value, with a dict for a structure."""
    if not (isinstance(value, str) and value.startswith("Rec(")):
        return value
    call: Any = ast.parse(value, mode="eval").body
    return {one.arg: ast.literal_eval(one.value) for one in call.keywords}


def leaves(document: Any, steps: Key) -> Iterator[tuple[Key, object]]:
    if isinstance(document, dict | list):
        for key, value in document.items() if isinstance(document, dict) else enumerate(document):
            yield from leaves(value, (*steps, key))
    else:
        yield steps, document


def bits(steps: Key, leaf: object) -> Iterator[tuple[Key, object]]:
    """Yield the bits of an integer, as of 64 bits; for another value, the value."""
    if isinstance(leaf, int) and not isinstance(leaf, bool):
        for bit in range(64):
            yield (*steps, "bit", bit), leaf >> bit & 1
    else:
        yield steps, leaf


class MqttBridge(Sources):
    """The bridge at a broker: values as text on a register's topic."""

    process = "mqtt"
    writer_number = WRITERS["mqtt"]

    def __init__(self, stack: ExitStack, instance: str, folder: Path) -> None:
        self._folder = folder
        super().__init__(stack, instance)

    def serve(self, stack: ExitStack) -> None:
        if reason := missing():
            pytest.skip(reason)
        address = stack.enter_context(reserved_port())
        broker = Mosquitto(self._folder, address)
        stack.callback(broker.stop)
        broker.start()
        stack.enter_context(bridge(self.segment, address))
        with listening(address) as connected:
            connected.until(f"{self.source}/zz/out")
        self._listener = stack.enter_context(listening(address, f"{PREFIX}/{RESULTS}"))

    def write(self, values: Sequence[Named]) -> Sequence[str]:
        return [self._send(part.path, value) for _, part, value in values]

    def _send(self, path: str, value: Any) -> str:
        text = value if isinstance(value, str) else json.dumps(value)
        self._listener.publish(f"{self.source}/{path}/in", text, ResponseTopic=f"{PREFIX}/{RESULTS}")
        told = self._listener.json(RESULTS)
        return "" if told["done"] else told["reason"] or told["outcome"]


FEW = EXAMPLES | {"max_examples": max(5, settings().max_examples // 20)}
RIGS: Mapping[str, Callable[[ExitStack, str, Path], Any]] = {
    "opcua source": OpcUaSourceRig,
    "mqtt": MqttBridge,
}


@pytest.mark.parametrize("name", RIGS)
def test_a_write_changes_exactly_what_it_names(name: str, instance: str, tmp_path: Path) -> None:
    run(
        lambda stack: RIGS[name](stack, instance, tmp_path),
        **EXAMPLES | {"max_examples": max(5, settings().max_examples // 20)},
    )


FAULTY: Mapping[str, tuple[str, Any, str, Any]] = {
    "the bridge writes whole bytes": ("mqtt", writer_module, "encode", whole_bytes),
}


@pytest.mark.parametrize("what", FAULTY)
def test_an_endpoint_that_changes_neighbours_is_found(
    what: str, instance: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, where, attribute, faulty = FAULTY[what]
    monkeypatch.setattr(where, attribute, faulty)
    with pytest.raises(AssertionError, match="changed"):
        run(lambda stack: RIGS[name](stack, instance, tmp_path), **EXAMPLES | {"max_examples": 200})
