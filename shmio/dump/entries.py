"""What a dump gives out: something recorded, when, and of which block."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Generic, NamedTuple, TypeVar

from shmio.dump.blocks import Contents, DumpBlock
from shmio.dump.encoding import Gap
from shmio.dump.part import Part
from shmio.dump.reader import Item
from shmio.segment import Frame

ItemT_co = TypeVar("ItemT_co", bound=Item, covariant=True)


class Entry(NamedTuple, Generic[ItemT_co]):
    """Something recorded. ``time_ns``: log time, UTC; ``block`` is None for what is of the instance, as a step."""

    time_ns: int
    block: DumpBlock | None
    item: ItemT_co


def messages_of(
    part: Part, within: Contents, channels: Collection[int], from_ns: int, to_ns: int
) -> Iterator[tuple[Contents, Entry[Item]]]:
    """What the channels of a file hold in a range of log times, with the file's contents."""
    for channel, log_ns, item in part.messages(channels, from_ns, to_ns):
        block = (
            within.numbered.get((item.source, item.block))
            if isinstance(item, Gap)
            else within.blocks.get(channel.number)
        )
        yield within, Entry(log_ns, block, item)


def latest_of(part: Part, within: Contents, source: str, time_ns: int) -> Entry[Frame] | None:
    """The last frame of a source in a file that is not after a time."""
    for messages in part.messages_before(within.frames(source), time_ns):
        for message in reversed(messages):
            if isinstance(message.item, Frame):
                return Entry(message.log_ns, within.blocks[message.channel.number], message.item)
    return None
