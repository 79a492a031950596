"""The process of an exported instance, which steps a laboratory for the FMU's library.

The library starts the process with one argument, the folder of the FMU's resources, and with a
socket as file descriptor 3.
"""

from __future__ import annotations

import os
import socket
import struct
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import msgspec

from shmio.errors import CommandError, ShmioError, ValueRangeError
from shmio.lab.fmu.exchange import KINDS, Values, groups_of
from shmio.lab.fmu.secrets import check_complete
from shmio.lab.laboratory import Laboratory, prepare_laboratory
from shmio.local.attach import Attachment

SOCKET_FD: Final = 3
CONFIG: Final = "cell"
"""Name of the folder with the instance's files, inside the FMU's resources."""
MANIFEST: Final = "export.json"
HELLO, INITIALISE, STEP, END = 1, 2, 3, 4
_HEAD: Final = struct.Struct("=II")
_NUMBERS: Final = struct.Struct("=dd")
_NS: Final = 1e9


class Manifest(msgspec.Struct):
    """What was exported: the file of the configuration, the patterns of registers, and all variables' names."""

    config: str
    patterns: list[str]
    names: list[str]


class Session:
    """Carries out the requests of the FMU's library."""

    def __init__(self, lab: Laboratory, cell: Attachment, manifest: Manifest) -> None:
        """Find the variables.

        Raises:
            ValueRangeError: The variables are not those of the FMU's description.

        """
        self._cell = cell
        groups, _ = groups_of(lab, manifest.patterns)
        if [name for one in groups for name in one.names] != manifest.names:
            raise ValueRangeError("the registers are not those of the export: the models have changed; export again")
        self.values = Values(groups)
        self._sources = list(dict.fromkeys(one.source for one in groups))
        self._now: dict[str, list[Any]] = {}
        self._begun_s = 0.0

    def answer(self, kind: int, message: bytes) -> bytes:
        """Carry out a request, and return the encoded values of all variables.

        Raises:
            ShmioError: The request cannot be carried out.

        """
        first, second = _NUMBERS.unpack_from(message)
        given = self.values.decode(message[_NUMBERS.size :])
        if kind != HELLO:
            self._write(given)
        if kind == INITIALISE:
            self._begun_s = first
        elif kind == STEP:
            clock_s = self._cell.clock.time_ns / _NS
            here_s = clock_s + self._begun_s
            if abs(first - here_s) > 1e-6:
                raise CommandError(f"the step begins at {first:g} s, but the instance is at {here_s:g} s")
            end_ns = round((first + second - self._begun_s) * _NS)
            self._cell.step((end_ns - self._cell.clock.time_ns) / _NS)  # so that rounding to ns does not add up
        images = {source: image_of(self._cell, source) for source in self._sources}
        found = self.values.encode(images)
        self._now = self.values.decode(found)
        return found

    def _write(self, given: dict[str, list[Any]]) -> None:
        wanted: dict[str, dict[str, Any]] = {}
        for path, value in self.values.changes(self._now, given):
            wanted.setdefault(path.partition("/")[0], {})[path] = value
        for values in wanted.values():
            for outcome in self._cell.write(values):
                if not outcome.done:
                    raise CommandError(f"{outcome.path}: {outcome.text}")


def image_of(cell: Attachment, source: str) -> bytes:
    """Return the image that consumers of a source see; all zeros if the source has not published any."""
    block = cell.block(source)
    frame = block.latest()
    return bytes(block.layout.size) if frame is None else frame.image


def main() -> int:
    """Serve one instance of the FMU until the library ends it, and return the exit status."""
    resources = Path(sys.argv[1])
    link = socket.socket(fileno=SOCKET_FD)
    os.dup2(2, 1)  # what models print must not disturb the program's standard output
    with link, ExitStack() as stack:
        try:
            manifest = msgspec.json.decode((resources / MANIFEST).read_bytes(), type=Manifest)
            check_complete(resources / CONFIG / manifest.config)
            lab = stack.enter_context(Laboratory(prepare_laboratory(resources / CONFIG / manifest.config)))
            session = Session(lab, stack.enter_context(lab.attach()), manifest)
        except (ShmioError, OSError, msgspec.MsgspecError) as error:
            _send(link, 1, str(error).encode())
            return 1
        _send(link, 0, struct.pack("=4I", *(session.values.counts[kind] for kind in KINDS)))
        while (request := _receive(link)) is not None and request[0] != END:
            try:
                _send(link, 0, session.answer(*request))
            except ShmioError as error:
                _send(link, 1, str(error).encode())
    return 0


def _send(link: socket.socket, kind: int, message: bytes) -> None:
    link.sendall(_HEAD.pack(kind, len(message)) + message)


def _receive(link: socket.socket) -> tuple[int, bytes] | None:
    """Return the next request; None if the program that runs the FMU has ended."""
    head = _exactly(link, _HEAD.size)
    if head is None:
        return None
    kind, size = _HEAD.unpack(head)
    message = _exactly(link, size)
    return None if message is None else (kind, message)


def _exactly(link: socket.socket, size: int) -> bytes | None:
    data = bytearray()
    while len(data) < size:
        part = link.recv(min(size - len(data), 1 << 20))
        if not part:
            return None
        data += part
    return bytes(data)


if __name__ == "__main__":
    raise SystemExit(main())
