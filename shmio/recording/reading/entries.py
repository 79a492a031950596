"""The entries of a dump, with their times and blocks."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from itertools import groupby, islice
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np

from shmio.recording.format.encoding import Gap, encode_frame
from shmio.recording.reading.batch import HEAD, Batch
from shmio.recording.reading.blocks import Contents, DumpBlock
from shmio.recording.reading.part import Part
from shmio.recording.reading.reader import Item
from shmio.segment import Frame

BATCH_FRAMES: Final = 256

ItemT_co = TypeVar("ItemT_co", bound=Item, covariant=True)


class Entry(NamedTuple, Generic[ItemT_co]):
    """A recorded item with its log time (UTC); ``block`` is None for items of the whole instance."""

    time_ns: int
    block: DumpBlock | None
    item: ItemT_co


def messages_of(
    part: Part, within: Contents, channels: Collection[int], from_ns: int, to_ns: int
) -> Iterator[tuple[Contents, Entry[Item]]]:
    """Yield the messages of a file's channels in a range of log times, with the file's contents."""
    for channel, log_ns, item in part.messages(channels, from_ns, to_ns):
        block = (
            within.numbered.get((item.source, item.block))
            if isinstance(item, Gap)
            else within.blocks.get(channel.number)
        )
        yield within, Entry(log_ns, block, item)


def batches_of(frames: Iterable[Entry[Frame]], *, raw: bool) -> Iterator[tuple[DumpBlock, Batch]]:
    """Yield frames as arrays in batches; ``raw`` for the source's images, not the consumers'."""
    for block, of_block in groupby(frames, key=lambda entry: entry.block):
        while block is not None and (some := list(islice(of_block, BATCH_FRAMES))):
            items = [entry.item for entry in some]
            data = b"".join(encode_frame(f)[: HEAD.itemsize] + (f.raw if raw else f.image) for f in items)
            records = np.frombuffer(data, np.uint8).reshape(len(items), HEAD.itemsize + block.layout.size)
            times = np.array([entry.time_ns for entry in some], np.int64)
            yield block, Batch(times, records, [frame.reason for frame in items])


def latest_of(part: Part, within: Contents, source: str, time_ns: int) -> Entry[Frame] | None:
    """Return the last frame of a source in a file at or before a time."""
    for messages in part.messages_before(within.frames(source), time_ns):
        for message in reversed(messages):
            if isinstance(message.item, Frame):
                return Entry(message.log_ns, within.blocks[message.channel.number], message.item)
    return None
