"""An OPC UA server made with node-opcua, which shares no code with ours; ``opcua_server.js`` is its program."""

from __future__ import annotations

import json
import shutil
import subprocess
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest

from shmio.testing.ports import reserved_port

NODE = Path(__file__).parents[2] / "endpoints/node"
MISSING = "" if shutil.which("node") and (NODE / "node_modules/node-opcua-server").exists() else "needs node-opcua"


class NodeServer:
    """A running server with these nodes; it takes up to 12 s to start."""

    def __init__(self, folder: Path, nodes: list[dict[str, Any]], *, secured: bool = False) -> None:
        if MISSING:
            pytest.skip(MISSING)
        self._folder = folder
        self._more = ["secured"] if secured else []
        self._file = folder / "nodes.json"
        self._file.write_text(json.dumps(nodes))
        self._stack = ExitStack()
        self.address = self._stack.enter_context(reserved_port())
        self.url = f"opc.tcp://{self.address}"

    def __enter__(self) -> Self:
        command = [
            "node", str(NODE / "opcua_server.js"), str(self.address.port), str(self._folder / "pki"), str(self._file),
            *self._more,
        ]  # fmt: skip
        with (self._folder / "log").open("w") as log:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
            )
        assert self._process.stdout is not None
        if not any(one.startswith("{") for one in self._process.stdout):
            self.__exit__(None, None, None)
            raise AssertionError((self._folder / "log").read_text())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            try:
                self._process.communicate(timeout=60)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.communicate()
                raise
