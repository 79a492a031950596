"""The state of a computed source in a snapshot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import msgspec

from shmio.connectors.injection_layers import CycleImage
from shmio.connectors.injection_state import LayerState
from shmio.connectors.output import Image
from shmio.errors import SnapshotError
from shmio.model.snapshot import decode_part
from shmio.segment import EventKind, Provenance, Quality, Record

if TYPE_CHECKING:
    from shmio.connectors.base import Computed
    from shmio.connectors.commands import CommandProcessor
    from shmio.connectors.output import Output
    from shmio.segment import BlockWriter


class SourceState(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """The state of a source between two steps.

    Attributes:
        step: The number of the last step.
        time_ns: The instance time in ns.
        utc_ns: UTC in the source's frames at that time, in ns since 1970.
        computed_ns: The instance time in ns of the last computed image; None if there is none.
        raw: The last image, without injections.
        cycle, source_ns, quality, provenance, reason: The fields of the last frame.
        seen: Cycle, instance time and image with which conditions were evaluated last.
        layers: The injections.
        source: The state of the model, or of whatever computes the image.

    """

    step: int
    time_ns: int
    utc_ns: int
    computed_ns: int | None
    raw: bytes
    cycle: int
    source_ns: int
    quality: Quality
    provenance: Provenance
    reason: str
    seen: tuple[int, int, bytes]
    layers: list[LayerState]
    source: bytes


def save_source(
    source: Computed, output: Output, commands: CommandProcessor, name: str, *, step: int, computed_ns: int | None
) -> bytes:
    """Save the state of a source between two steps, and publish an event about it.

    Raises:
        SnapshotError: The state cannot be saved.
        ShmioError: The source's own code failed.

    """
    writer = output.writer
    at_ns = writer.now_ns()
    own = source.save()
    output.flush(now=True)
    with output.lock:
        image = output.last
        if image is None:
            raise SnapshotError("it has not published data yet")
        now = output.injections.now
        saved = SourceState(
            step, writer.block.clock.present_ns(), writer.block.clock.utc_ns(at_ns), computed_ns, image.raw,
            image.cycle, image.source_ns, image.quality, image.provenance, image.reason,
            (now.cycle, now.time_ns, now.raw), commands.injections.save(), own,
        )  # fmt: skip
    writer.event(Record(EventKind.SAVED, name))
    return msgspec.msgpack.encode(saved)


class PreparedSource:
    """The state of a source, after a check. :meth:`restore` restores it."""

    def __init__(self, source: Computed, output: Output, commands: CommandProcessor, data: bytes) -> None:
        """Check the state.

        Raises:
            SnapshotError: The state is damaged, or does not fit the source.

        """
        self.saved = saved = decode_part(data, SourceState)
        size = output.writer.block.layout.size
        if len(saved.raw) != size or len(saved.seen[2]) not in (0, size):
            raise SnapshotError("its image has another size")
        self._output = output
        self._restore_own: Callable[[], None] = source.prepare_restore(saved.source)
        self._restore_layers: Callable[[], Sequence[Record]] = commands.injections.prepare_restore(
            saved.layers, CycleImage(*saved.seen), saved.raw
        )

    def restore(self, writer: BlockWriter, name: str) -> None:
        """Restore the state, and publish an event and a frame. First set the writer's cycle and time.

        Raises:
            ShmioError: The source's own code failed.

        """
        self._restore_own()
        saved = self.saved
        shift_ns = writer.block.clock.utc_ns(writer.now_ns()) - saved.utc_ns  # 0 if time is always virtual
        image = Image(
            saved.raw, saved.cycle, saved.source_ns and saved.source_ns + shift_ns, saved.quality, saved.provenance,
            saved.reason, writer.now_ns(),
        )  # fmt: skip
        with self._output.lock:
            records = self._restore_layers()
            writer.event(Record(EventKind.RESTORED, name))
            self._output.replace(image, records)
