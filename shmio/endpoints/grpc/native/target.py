"""What an Inject call stands over: registers by patterns, and bytes and bits by ranges."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from typing import Final, NamedTuple

import numpy as np

from shmio.endpoints.grpc.encoding import field
from shmio.endpoints.grpc.native.columns import Array
from shmio.endpoints.grpc.native.selection import MAX_PATTERNS, Place
from shmio.endpoints.grpc.native.values import MAX_VALUES
from shmio.endpoints.grpc.topics import Topics
from shmio.errors import PathError, ValueRangeError
from shmio.layout.topic import Topic, shorten
from shmio.layout.write import Write, merge
from shmio.wire import shmio_v1_pb2 as wire

_RANGES: Final = wire.Table.DESCRIPTOR.fields_by_name["ranges"].number
_PIECES: Final = wire.Update.DESCRIPTOR.fields_by_name["pieces"].number


class Target(NamedTuple):
    """A place, the topics that patterns name in it, and ranges."""

    place: Place
    topics: tuple[Topic, ...]
    ranges: tuple[wire.Range, ...]


def target_of(topics: Topics, lay: wire.Lay) -> Target:
    """What it is to stand over. PathError, ValueRangeError."""
    if not (lay.patterns or lay.ranges):
        raise ValueRangeError("no pattern is given, and no range: an injection stands over something")
    for name, given in (("patterns", len(lay.patterns)), ("ranges", len(lay.ranges))):
        if given > MAX_PATTERNS:
            raise ValueRangeError(f"{given} {name}, {MAX_PATTERNS} are the most: use stars, or structures")
    found = tuple(dict.fromkeys(topics.topic(pattern) for pattern in lay.patterns))
    places = {Place(topic.source, topic.direction == "in") for topic in found}
    if len({place.source for place in places}) > 1:
        raise PathError("one injection is over one source: lay one for each, with a stream each")
    if len(places) > 1:
        raise PathError(f"{shorten(lay.patterns[0])}, …: an injection is over /out or over /in, not over both")
    if lay.direction not in wire.Direction.values():
        raise ValueRangeError(f"direction: {lay.direction} is none; 0 is /out, 1 is /in")
    if lay.source:
        topic = topics.topic(lay.source)
        if topic.path or topic.direction:
            raise PathError(f"source: {shorten(lay.source)} is not a source's name")
        places.add(Place(topic.source, places.pop().inward if places else lay.direction == wire.DIRECTION_IN))
    if len(places) != 1:
        raise PathError("source: ranges without a pattern need to be told whose bytes they are")
    return Target(places.pop(), found, tuple(lay.ranges))


class Ranges:
    """The bytes and bits that an injection is over besides registers."""

    def __init__(self, ranges: Iterable[wire.Range], size: int) -> None:
        """``size``: of the block. ValueRangeError: beyond it, or no range."""
        self._spans: list[tuple[slice, int]] = []
        self._bits = np.zeros(size, np.uint8)
        for one in ranges:
            if not one.size or one.offset + one.size > size:
                raise ValueRangeError(
                    f"ranges: {one.size} bytes from byte {one.offset} on are none, or not all in the block, which has "
                    f"{size}"
                )
            if one.mask > 0xFF:
                raise ValueRangeError(f"ranges: the mask {one.mask} has bits that a byte has not")
            span, mask = slice(one.offset, one.offset + one.size), one.mask or 0xFF
            self._spans.append((span, mask))
            self._bits[span] |= mask

    @property
    def bits(self) -> bytes:
        """An image of the block in which they are set."""
        return self._bits.tobytes()

    @property
    def table(self) -> bytes:
        """What a serialised ``Table`` has of them."""
        return b"".join(
            field(_RANGES, wire.Range(offset=span.start, size=span.stop - span.start, mask=mask).SerializeToString())
            for span, mask in self._spans
        )

    def differing(self, image: bytes, before: bytes | None) -> bytes:
        """What an ``Update`` has of them: of each from the first byte that differs to the last; else all of them."""
        new = np.frombuffer(image, np.uint8)
        changed = np.full(len(image), 0xFF, np.uint8) if before is None else new ^ np.frombuffer(before, np.uint8)
        return b"".join(self._pieces(new, changed))

    def touched(self, image: bytes, mask: bytes) -> bytes:
        """The same of what a mask of the block has bits of."""
        return b"".join(self._pieces(np.frombuffer(image, np.uint8), np.frombuffer(mask, np.uint8)))

    def _pieces(self, image: Array, changed: Array) -> Iterator[bytes]:
        for span, mask in self._spans:
            places = np.flatnonzero(changed[span] & mask)
            if len(places):
                start, stop = span.start + int(places[0]), span.start + int(places[-1]) + 1
                data = (image[start:stop] & mask).tobytes()
                yield field(_PIECES, wire.Piece(offset=start, data=data, mask=mask).SerializeToString())


def raw_writes(pieces: Collection[wire.Piece], bits: bytes) -> list[Write]:
    """What raw bytes that a client gives write; ``bits``: what its injection is over.

    ValueRangeError: it is not over all of them, or they are too many.
    """
    if len(pieces) > MAX_VALUES:
        raise ValueRangeError(f"{len(pieces)} pieces, {MAX_VALUES} are the most: join neighbours, or give less at once")
    cover = np.frombuffer(bits, np.uint8)
    image, given = np.zeros(len(bits), np.uint8), np.zeros(len(bits), np.uint8)
    spans = []
    for piece in pieces:
        span = slice(piece.offset, piece.offset + len(piece.data))
        wanted = cover[span] & (piece.mask or 0xFF if piece.mask <= 0xFF else 0)
        if not piece.data or span.stop > len(bits) or not wanted.all():
            raise ValueRangeError(
                f"pieces: the injection is not over all of the {len(piece.data)} bytes from byte {piece.offset} on"
            )
        image[span] ^= (image[span] ^ np.frombuffer(piece.data, np.uint8)) & wanted
        given[span] |= wanted
        spans.append((span.start, span.stop))
    return merge(image.tobytes(), given.tobytes(), spans)
