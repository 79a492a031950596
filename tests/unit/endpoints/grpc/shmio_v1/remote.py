"""A source whose model a client computes, behind an endpoint. The source's process runs in threads."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

from shmio.connectors.models.remote import Remote
from shmio.layout.compiler import Source, compile_sources
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Quality, Segment
from tests.unit.connectors.models.test_stepped import Running
from tests.unit.endpoints.harness import STALE_NS, Endpoint, endpoint

TABLE = b"""
[registers]
target = { type = "LREAL", initial = 1.5 }
speed = "INT"
label = "STRING[8]"
when = "DATE"
"axis/position" = { type = "LREAL", initial = 0.25 }
"axis/moving" = "BOOL"
"axis/ready" = "BOOL"
"axis/count" = "INT"
"axis/name" = "STRING[8]"
row = "ARRAY[1..2, 0..2] OF INT"
lamps = "ARRAY[0..9] OF BOOL"
"""
LAYOUT = compile_sources([Source("drive.toml", TABLE)]).layouts[0]
OUTPUTS = ("axis", "row")
INOUTS = ("lamps",)
WRITABLE = ("target", "speed", "label", "when", "lamps")
LONG_MS = 9000


def spec(source: str, period_ns: int = 20_000_000) -> BlockSpec:
    attributes = Attributes("remote", WRITABLE, stepped=True, outputs=OUTPUTS, inouts=INOUTS)
    return BlockSpec(source, LAYOUT, period_ns, STALE_NS, 1 << 20, attributes)


@contextmanager
def remote_segment(instance: str, *, virtual: bool = True) -> Iterator[Segment]:
    """Create a segment with the source ``drive``, which a client computes, and the source ``cell``."""
    plain = BlockSpec("cell", LAYOUT, 20_000_000, STALE_NS, 1 << 20, Attributes("memory", WRITABLE))
    processes = [ProcessSpec("drive", "source"), ProcessSpec("cell", "source"), ProcessSpec("grpc", "grpc")]
    with Segment.create(instance, [spec("drive"), plain], processes, stepped=virtual) as segment:
        yield segment
        segment.unlink()


def source(timeout_ms: float = LONG_MS) -> Remote:
    return Remote(Remote.Options(list(OUTPUTS), list(INOUTS), {}, timeout_ms), LAYOUT)


def serve_remote(
    instance: str,
    test: Callable[[Endpoint, Running], Awaitable[None]],
    *,
    timeout_ms: float = LONG_MS,
    virtual: bool = True,
) -> None:
    """Run a test with an endpoint and the running process of such a source."""

    async def run(segment: Segment, drive: Running) -> None:
        async with endpoint(segment) as served:
            await test(served, drive)

    with remote_segment(instance, virtual=virtual) as segment, Running(segment, "drive", source(timeout_ms)) as drive:
        asyncio.run(run(segment, drive))


async def shown(drive: Running, quality: Quality) -> None:
    """Wait until the source has published a frame of this quality."""
    while (await asyncio.to_thread(drive.next)).quality is not quality:
        pass
