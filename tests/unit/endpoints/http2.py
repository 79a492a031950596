"""A gRPC client that sends single HTTP/2 frames, and can stop within any of them (RFC 9113)."""

from __future__ import annotations

import asyncio
import socket
import struct
from typing import Self

from tests.unit.endpoints.harness import TIMEOUT_S

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
DATA, HEADERS, SETTINGS = 0, 1, 4
END_STREAM, ACK, END_HEADERS = 1, 1, 4
RESET = struct.pack("ii", 1, 0)  # SO_LINGER: close with RST


def frame(kind: int, flags: int, stream: int, payload: bytes) -> bytes:
    return len(payload).to_bytes(3, "big") + bytes((kind, flags)) + stream.to_bytes(4, "big") + payload


def headers(method: str, stream: int = 1) -> bytes:
    """Return the headers of a call, without compression (RFC 7541, 6.2.2)."""
    fields = {
        ":method": "POST",
        ":scheme": "http",
        ":path": method,
        ":authority": "test",
        "te": "trailers",
        "content-type": "application/grpc",
    }
    block = b"".join(
        b"\0" + bytes((len(name),)) + name.encode() + bytes((len(value),)) + value.encode()
        for name, value in fields.items()
    )
    return frame(HEADERS, END_HEADERS, stream, block)


def call(method: str, request: bytes, stream: int = 1) -> bytes:
    """Return a whole call with its message."""
    return headers(method, stream) + frame(DATA, END_STREAM, stream, message(request))


def message(data: bytes) -> bytes:
    """Return a message with its gRPC prefix."""
    return b"\0" + len(data).to_bytes(4, "big") + data


class Connection:
    """A client's connection that reads no more than necessary."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self._writer = writer

    @classmethod
    async def open(cls, port: int, *, deaf: bool = False) -> Self:
        """Connect, and wait until the server has sent its HTTP/2 settings.

        ``deaf``: keep the flow-control windows closed, so that no data can arrive.
        """
        connection = cls(*await asyncio.open_connection("127.0.0.1", port))
        await connection.send(PREFACE + frame(SETTINGS, 0, 0, b"\0\4\0\0\0\0" if deaf else b""))
        async with asyncio.timeout(TIMEOUT_S):
            head = await connection.reader.readexactly(9)
            assert head[3] == SETTINGS
            await connection.reader.readexactly(int.from_bytes(head[:3], "big"))
        await connection.send(frame(SETTINGS, ACK, 0, b""))
        return connection

    async def send(self, data: bytes) -> None:
        self._writer.write(data)
        await self._writer.drain()

    async def until_end(self, stream: int) -> None:
        """Read until a call's status arrives."""
        async with asyncio.timeout(TIMEOUT_S):
            while True:
                head = await self.reader.readexactly(9)
                await self.reader.readexactly(int.from_bytes(head[:3], "big"))
                if int.from_bytes(head[5:], "big") == stream and head[3] == HEADERS and head[4] & END_STREAM:
                    return

    async def drop(self, *, reset: bool) -> None:
        """Close the connection: with a reset, or by an end that the server has noticed."""
        if reset:
            end: socket.socket = self._writer.get_extra_info("socket")
            end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            self._writer.transport.abort()
        else:
            self._writer.write_eof()
            async with asyncio.timeout(TIMEOUT_S):
                await self.reader.read()
            self._writer.close()
        try:
            await self._writer.wait_closed()
        except OSError:
            return  # the server closed first
