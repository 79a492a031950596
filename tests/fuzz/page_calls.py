"""Calls to the web page's server, over its WebSocket: valid ones of each kind, and a check of the answers."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import msgspec
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from shmio.endpoints.web.tabs import TABS
from shmio.segment import Segment
from tests.unit.endpoints.harness import LAYOUT
from tests.unit.endpoints.web.harness import TIMEOUT_S, processes, spec
from tests.unit.endpoints.web.test_page import Pages, pages

FAILED: Final = "the server failed to do this"
"""How the answer to a call begins that raised an unexpected exception."""
_REGISTER: Final = f"cell/{LAYOUT.registers[0].path}"
RECORDING: Final = Path(__file__).parents[1] / "golden" / "dump" / "closed.mem"
_NAMED: Final[Mapping[str, object]] = {
    "source": "cell",
    "path": _REGISTER,
    "paths": [_REGISTER, f"cell/{LAYOUT.registers[1].path}"],
    "value": "1",
    "name": RECORDING.name,
    "when": f"{_REGISTER} > 1 for 2s",
    "text": f'[[injection]]\nname = "n"\ntarget = "{_REGISTER}"\noperation = "set"\nvalue = 1\n',
    "filter": "a",
    "expanded": ["cell"],
}
_EXAMPLES: Final[Sequence[object]] = ("cell/Inputs", 1, True, None, ["cell/Inputs"], [1], [], {}, {"cell": 1})
_LEFT_OUT: Final = ("overview.restart", "configuration.reload")
"""Calls that only ask the supervisor, of which there is none here."""


_open = ExitStack()
close = _open.close
"""Ends the server, if there is one."""


class _Browser:
    """A segment with one source, a server of its page, and a browser that is connected again when it was refused."""

    def __init__(self) -> None:
        segment = _open.enter_context(Segment.create(f"fuzz-{os.getpid()}", [spec()], processes()))
        _open.callback(segment.unlink)
        segment.writer("cell").publish(bytes(segment.blocks["cell"].layout.size), cycle=1)
        folder = Path(_open.enter_context(TemporaryDirectory(prefix="fuzz-page-")))
        (folder / "cell.log").write_text("2026-01-01T00:00:00Z INFO cell: a line\n")
        shutil.copy(RECORDING, folder)
        roles = ("read", "write", "inject", "control")
        self._pages: Pages = _open.enter_context(pages(segment, (), roles, {"logs": str(folder)}, folder))
        self._socket: ClientConnection | None = None

    def say(self, text: str) -> Mapping[str, Any]:
        """Send a message, and return the answer. It is empty if the server closed the connection."""
        if self._socket is None:
            self._socket = self._pages.open()
        try:
            self._socket.send(text)
            while True:
                message = self._socket.recv(TIMEOUT_S)
                answer = json.loads(message) if isinstance(message, str) else {}
                if "id" in answer:
                    return dict(answer)
        except ConnectionClosed:
            self._socket = None
            return {}


browser = cache(_Browser)


def _arguments(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Return arguments that a call accepts."""
    found: dict[str, Any] = {}
    for field in msgspec.structs.fields(kind):
        for example in (_NAMED.get(field.encode_name, ""), *_EXAMPLES):
            with suppress(msgspec.ValidationError):
                msgspec.convert(example, field.type)
                found[field.encode_name] = example
                break
    return found


def calls() -> list[bytes]:
    """Return a message for each call, and some that are none."""
    found = [b"[]", b"{}", b'{"id": 1, "call": "registers.nothing"}']
    for tab in TABS:
        for name, call in tab.calls.items():
            if name not in _LEFT_OUT:
                found.append(json.dumps({"id": 1, "call": name, "with": _arguments(call.arguments)}).encode())
    return found


def check_call(data: bytes) -> None:
    """Send a call, and check that the server has an answer to it. It closes the connection at what is no text."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    answer = browser().say(text)
    assert not str(answer.get("error", "")).startswith(FAILED), answer
