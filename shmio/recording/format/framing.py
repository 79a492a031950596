"""Check the lengths in MCAP records, and unpack chunks. No byte of a file is trusted."""

from __future__ import annotations

import struct
import threading
import zlib
from typing import Final

import zstandard
from mcap.opcode import Opcode

MAX_CHUNK_BYTES: Final = 32 << 20
"""Limit far above a recorder's chunks, which have 1 MiB and one message of at most 2 MiB."""

HEAD: Final = struct.Struct("<BQ")  # of any record: opcode, size of its content
CHUNK: Final = struct.Struct("<QQQI")  # start, end, uncompressed size, CRC; then the compression's name, size, data
FOOTER: Final = struct.Struct("<QQI")  # start of the summary, start of its offsets, CRC of the summary up to here
INDEX: Final = struct.Struct("<HI")  # channel, bytes of the entries that follow
U32: Final = struct.Struct("<I")
U64: Final = struct.Struct("<Q")
SIZES: Final[dict[int, int]] = {Opcode.DATA_END: 4, Opcode.FOOTER: FOOTER.size}


class _OfThread(threading.local):
    """Decompressor of a thread: making one takes longer than unpacking a chunk."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)


_of_thread = _OfThread()


def framed(opcode: int, size: int, look: bytes) -> bool:
    """Return whether the lengths inside a record agree with the length of the whole record.

    This keeps a damaged length from leading the reader past intact records. ``look`` is the
    beginning of the content.
    """
    try:
        if opcode == Opcode.CHUNK:
            (name,) = U32.unpack_from(look, CHUNK.size)
            (data,) = U64.unpack_from(look, CHUNK.size + 4 + name)
            return bool(size == CHUNK.size + 12 + name + data)
        if opcode == Opcode.MESSAGE_INDEX:
            (data,) = U32.unpack_from(look, 2)
            return bool(size == 6 + data)
        if opcode == Opcode.ATTACHMENT:
            (name,) = U32.unpack_from(look, 16)
            (media_type,) = U32.unpack_from(look, 20 + name)
            (data,) = U64.unpack_from(look, 24 + name + media_type)
            return bool(size == 36 + name + media_type + data)
        if opcode == Opcode.METADATA:
            (name,) = U32.unpack_from(look)
            (data,) = U32.unpack_from(look, 4 + name)
            return bool(size == 8 + name + data)
    except struct.error:
        return False
    return size == SIZES.get(opcode, size)


def unpack(content: bytes) -> bytes:
    """Return the uncompressed records of a chunk.

    Raises:
        ValueError: A size, the compression or the checksum is wrong.
        struct.error: The chunk is too short.
        ZstdError: The compressed data is damaged.
    """
    _, _, size, crc = CHUNK.unpack_from(content)
    (name_size,) = U32.unpack_from(content, CHUNK.size)
    at = CHUNK.size + 4 + name_size
    compression = content[CHUNK.size + 4 : at].decode()
    (packed_size,) = U64.unpack_from(content, at)
    packed = memoryview(content)[at + 8 :]
    if packed_size != len(packed):
        raise ValueError("its sizes contradict each other")
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"{size} bytes, more than {MAX_CHUNK_BYTES}")
    if compression == "zstd":
        if zstandard.get_frame_parameters(packed).content_size not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError("its sizes contradict each other")
        data = _of_thread.decompressor.decompress(packed, max_output_size=size)
    elif not compression:
        data = bytes(packed)
    else:
        raise ValueError(f"its compression {compression[:20]!r} is unknown")
    if len(data) != size:
        raise ValueError("its sizes contradict each other")
    if crc and zlib.crc32(data) != crc:
        raise ValueError("its checksum is wrong")
    return data
