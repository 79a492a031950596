"""After any accepted write of a consumer, exactly the bits of the source that the write names have changed.

The sources have drawn layouts with every register at a known place. They share one segment, which one
endpoint serves for all examples.
"""

from __future__ import annotations

import asyncio
import json
import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, ExitStack, contextmanager
from typing import Any

import grpc
import pytest
from asyncua import Client, ua
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from shmio.connectors.injection_layers import Owner
from shmio.layout.model import Layout
from shmio.layout.values import index_range as index_range_module
from shmio.layout.values.codec import Value
from shmio.layout.values.index_range import parse
from shmio.layout.values.write import Write, encode
from shmio.local import writer as writer_module
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from tests.conformance.test_named_bits import Key, Named, Part, S7Rig, Tag, Writer, block, noise, run
from tests.unit.endpoints.grpc.services.test_publish import counted, message, publish
from tests.unit.endpoints.grpc.services.test_simlog_v2 import request as request_v2
from tests.unit.endpoints.grpc.shmio_v1.test_write import KINDS
from tests.unit.endpoints.grpc.shmio_v1.test_write import write as write_shmio
from tests.unit.endpoints.harness import STALE_NS, TIMEOUT_S, Endpoint, endpoint
from tests.unit.endpoints.harness import WRITER as GRPC
from tests.unit.endpoints.opcua import harness as opcua
from tests.unit.endpoints.opcua.conftest import standard_nodes  # noqa: F401  used by all tests of this module
from tests.unit.endpoints.opcua.harness import WRITER as OPCUA
from tests.unit.endpoints.plant import GUEST, Plant
from tests.unit.endpoints.web.test_page import pages, said

SOURCES = 6
EXAMPLES: dict[str, Any] = {
    "max_examples": max(30, settings().max_examples // 4),
    "phases": [Phase.generate],
    "report_multiple_bugs": False,
}
"""A failing example is shown as it is: over a server, it takes minutes to find a smaller one."""


def layouts() -> list[tuple[Layout, Mapping[str, Tag]]]:
    """Draw the layouts of the sources."""
    found: list[tuple[Layout, Mapping[str, Tag]]] = []

    @settings(
        suppress_health_check=list(HealthCheck),
        database=None,
        max_examples=3 * SOURCES,
        phases=[Phase.generate],
    )
    @given(st.data())
    def collect(draw: st.DataObject) -> None:
        layout, tags, _ = block(draw)
        found.append((layout, tags))

    collect()
    return sorted(found, key=lambda one: len(one[1]))[-SOURCES:]


class Sources:
    """Some sources in a segment, each with its device. Only the device of the present example runs."""

    process: str
    """Kind and name of the endpoint's process."""
    writer_number: int

    def __init__(self, stack: ExitStack, instance: str) -> None:
        self._drawn = layouts()
        names = [f"s{number}" for number in range(len(self._drawn))]
        specs = [
            BlockSpec(name, layout, 20_000_000, STALE_NS, 1 << 20, Attributes("test", ("**",)))
            for name, (layout, _) in zip(names, self._drawn, strict=True)
        ]
        processes = [ProcessSpec(name, "source") for name in names] + [ProcessSpec(self.process, self.process)]
        self.segment = stack.enter_context(Segment.create(instance, specs, processes))
        stack.callback(self.segment.unlink)
        self._plants = []
        for name in names:
            plant = Plant(self.segment.writer(name))
            stack.callback(plant.stop)
            plant.owners[self.writer_number] = Owner(self.writer_number, 3)
            plant.cycle()
            self._plants.append(plant)
        self._at = 0
        self._busy = threading.Lock()
        self._stop = threading.Event()
        thread = threading.Thread(target=self._cycle)
        thread.start()
        stack.callback(thread.join)
        stack.callback(self._stop.set)
        self.serve(stack)

    def _cycle(self) -> None:
        while not self._stop.wait(0.001):
            with self._busy:
                self.plant.cycle()

    @property
    def plant(self) -> Plant:
        return self._plants[self._at]

    @property
    def source(self) -> str:
        return self.plant.writer.block.source

    def layout(self, draw: st.DataObject) -> tuple[Layout, Mapping[str, Tag]]:
        at = draw.draw(st.integers(0, len(self._drawn) - 1))
        layout, tags = self._drawn[at]
        with self._busy:
            self._at = at
            self.plant.memory[:] = noise(draw, layout.size, tags)
            self.plant.cycle()
        return layout, tags

    def state(self) -> Mapping[Key, object]:
        memory = bytes(self.plant.memory)
        return {("block", 8 * at + bit): byte >> bit & 1 for at, byte in enumerate(memory) for bit in range(8)}

    keys = S7Rig.keys

    @contextmanager
    def writer(self, layout: Layout) -> Iterator[Writer]:
        yield self.write

    def serve(self, stack: ExitStack) -> None:
        """Start the endpoint."""
        raise NotImplementedError

    def write(self, values: Sequence[Named]) -> Sequence[str]:
        """Write through the endpoint; return the outcomes."""
        raise NotImplementedError


def entered(stack: ExitStack, runner: asyncio.Runner, context: AbstractAsyncContextManager[Any]) -> Any:
    """Enter an asynchronous context until the stack ends."""
    found = runner.run(context.__aenter__())
    stack.callback(lambda: runner.run(context.__aexit__(None, None, None)))
    return found


class Grpc(Sources):
    """The gRPC endpoint; one value in each call."""

    process = "grpc"
    writer_number = GRPC

    def serve(self, stack: ExitStack) -> None:
        self._runner = stack.enter_context(asyncio.Runner())
        self._served: Endpoint = entered(stack, self._runner, endpoint(self.segment))

    def write(self, values: Sequence[Named]) -> Sequence[str]:
        return self._runner.run(self._write(values))

    async def _write(self, values: Sequence[Named]) -> Sequence[str]:
        return [await self.send(self._served, f"{self.source}/{part.path}", value) for _, part, value in values]

    async def send(self, served: Endpoint, path: str, value: Value) -> str:
        raise NotImplementedError


class SimlogV1(Grpc):
    """Publish of version 1: values as text."""

    async def send(self, served: Endpoint, path: str, value: Value) -> str:
        _, before = counted(served)
        await publish(served, [message(path, value if isinstance(value, str) else json.dumps(value))])
        return "" if counted(served)[1] == before else "refused"


def exact(value: Any) -> Any:
    """Return a value with texts for the numbers that JSON readers round."""
    if isinstance(value, list):
        return [exact(one) for one in value]
    return str(value) if isinstance(value, int) and abs(value) > 1 << 53 else value


class SimlogV2(Grpc):
    """Publish of version 2: values as JSON has them; a number of more digits as text."""

    async def send(self, served: Endpoint, path: str, value: Value) -> str:
        _, before = counted(served)
        await served.v2.Publish(iter([request_v2(path, exact(value))]), timeout=TIMEOUT_S)
        return "" if counted(served)[1] == before else "refused"


class ShmioV1(Grpc):
    """Write of shmio.v1: several values in a command."""

    async def _write(self, values: Sequence[Named]) -> Sequence[str]:
        try:
            named = {f"{self.source}/{part.path}": value for _, part, value in values}
            answer = await write_shmio(self._served, named)
        except grpc.aio.AioRpcError as error:
            return [error.details() or "refused"]
        return ["" if one.kind == KINDS.KIND_WRITTEN else one.reason for one in answer.outcomes]


TYPES = {
    "BOOL": ua.VariantType.Boolean, "BYTE": ua.VariantType.Byte, "SINT": ua.VariantType.SByte,
    "USINT": ua.VariantType.Byte, "INT": ua.VariantType.Int16, "UINT": ua.VariantType.UInt16,
    "WORD": ua.VariantType.UInt16, "DINT": ua.VariantType.Int32, "UDINT": ua.VariantType.UInt32,
    "DWORD": ua.VariantType.UInt32, "LINT": ua.VariantType.Int64, "REAL": ua.VariantType.Float,
    "LREAL": ua.VariantType.Double,
}  # fmt: skip


class OpcUa(Sources):
    """The OPC UA server: whole values, and parts by their own nodes or by an index range."""

    process = "opcua"
    writer_number = OPCUA

    def serve(self, stack: ExitStack) -> None:
        self._runner = stack.enter_context(asyncio.Runner())
        server = entered(stack, self._runner, opcua.served(self.segment))
        self._client: Client = entered(stack, self._runner, server.client())

    def write(self, values: Sequence[Named]) -> Sequence[str]:
        return self._runner.run(self._write([self._asked(*one) for one in values]))

    def _asked(self, tag: Tag, part: Part, value: Any) -> ua.WriteValue:
        path, indices = part.path, ""
        if tag.shape and part.bit is None and len(part.elements) < math.prod(tag.shape) and part.elements.start % 2:
            path = "/".join(path.split("/")[: -len(tag.shape)])
            indices = index_range(tag.shape, part.elements)
            for _ in range(len(tag.shape) - len(part.shape)):
                value = [value]
        kind = TYPES.get("BOOL" if part.bit is not None else tag.kind, ua.VariantType.String)
        data = ua.DataValue(ua.Variant(value, kind))
        return ua.WriteValue(ua.NodeId(f"{self.source}/{path}", 2), ua.AttributeIds.Value, indices or None, data)

    async def _write(self, asked: list[ua.WriteValue]) -> Sequence[str]:
        found = await self._client.uaclient.write(ua.WriteParameters(asked))
        return ["" if one.is_good() else one.name for one in found]


def index_range(shape: tuple[int, ...], elements: range) -> str:
    """Return the range that names some elements of a row (OPC 10000-4, section 7.27)."""
    texts: list[str] = []
    rest = elements.start
    for length in reversed(shape):
        rest, at = divmod(rest, length)
        texts.insert(0, str(at))
    if len(elements) > 1:
        texts[-1] += f":{int(texts[-1]) + len(elements) - 1}"
    return ",".join(texts)


class WebPage(Sources):
    """The web page's call: values as text."""

    process = "web"
    writer_number = GUEST

    def serve(self, stack: ExitStack) -> None:
        server = stack.enter_context(pages(self.segment, roles=("read", "write")))
        self._browser = stack.enter_context(server.open())

    def write(self, values: Sequence[Named]) -> Sequence[str]:
        return [self._set(part.path, value) for _, part, value in values]

    def _set(self, path: str, value: Any) -> str:
        text = value if isinstance(value, str) else json.dumps(value)
        told = said(self._browser, "registers.set", path=f"{self.source}/{path}", value=text)
        if "error" in told:
            return str(told["error"])
        found = told["result"]
        return "" if found["outcome"] == "written" else found["reason"] or found["outcome"]


RIGS: Mapping[str, Callable[[ExitStack, str], Any]] = {
    "simlog v1": SimlogV1,
    "simlog v2": SimlogV2,
    "shmio.v1": ShmioV1,
    "opcua": OpcUa,
    "web page": WebPage,
}


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prevent commands from expiring because the host is busy."""
    monkeypatch.setattr("shmio.local.writer.WRITE_TIMEOUT_S", TIMEOUT_S)


@pytest.mark.parametrize("name", RIGS)
def test_a_write_changes_exactly_what_it_names(name: str, instance: str) -> None:
    run(lambda stack: RIGS[name](stack, instance), **EXAMPLES)


def whole_bytes(*given: Any) -> list[Write]:
    """Encode a bit as its whole byte."""
    return [write._replace(mask=0) for write in encode(*given)]


FAULTY: Mapping[str, tuple[str, Any, str, Any]] = {
    "simlog v1 writes whole bytes": ("simlog v1", writer_module, "encode", whole_bytes),
    "simlog v2 writes whole bytes": ("simlog v2", writer_module, "encode", whole_bytes),
    "shmio.v1 writes whole bytes": ("shmio.v1", writer_module, "encode", whole_bytes),
    "opcua writes whole bytes": ("opcua", writer_module, "encode", whole_bytes),
    "the web page writes whole bytes": ("web page", writer_module, "encode", whole_bytes),
    "opcua takes the next element": (
        "opcua",
        index_range_module,
        "parse",
        lambda text: [(first + 1, last + 1) for first, last in parse(text)],
    ),
}


@pytest.mark.parametrize("what", FAULTY)
def test_an_endpoint_that_changes_neighbours_is_found(
    what: str, instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, where, attribute, faulty = FAULTY[what]
    monkeypatch.setattr(where, attribute, faulty)
    with pytest.raises(AssertionError, match="changed"):
        run(lambda stack: RIGS[name](stack, instance), **EXAMPLES | {"max_examples": 200})
