"""The configuration of the instance under test, written for its start and again for each reload."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from shmio.config import Address
from tests.faults.plc import NUMBER, OTHERS

SIZES: Final = {"fast": 408, "block": 2192, "demo": 408}
PERIODS_MS: Final = {"fast": 5, "block": 20, "demo": 20}
STALE_MS: Final = {"fast": 300, "block": 500, "demo": 500}
NAMES: Final = ("rest", "other")
"""Names between which reloads switch the array after the first word.

Each name makes another layout of the same size.
"""
INJECTED: Final = ("fast", "block")
"""Sources with declared injections."""
EXTRA: Final = "extra"
"""Name of a source that reloads add and remove."""
EMULATED: Final = "plc.db"
"""Layout of the emulator, which does not change with that of the source ``demo``."""

_DB = """DATA_BLOCK DB{number}
{{ S7_Optimized_Access := 'FALSE' }}
   STRUCT
      stamp : LWord;
      {name} : Array[1..{words}] of LWord;
      command : LWord;
      remote : LWord;
      shown : LWord;
      guarded : LWord;
      declared : LWord;
      chained : LWord;
   END_STRUCT;
BEGIN
END_DATA_BLOCK
"""
_SOURCE = """
[[source]]
name = "{name}"
connector = "s7"
layout = "{layout}.db"
host = "127.0.0.1"
port = {port}
dbNumber = {number}
timeout = 400
period_ms = {period_ms}
stale_ms = {stale_ms}
writable = ["command", "remote", "guarded"]
armed = true
"""
DECLARED: Final = (7 + 5) * 3
"""Result of three declared injections on the PLC's 0. Another order gives another value."""
CHAINED: Final = 1 << 32
"""Offset that the chain's declared injection, the outermost, adds."""
PRIORITY: Final = 10
"""Priority of the chain's declared injection, higher than any client's."""
_INJECTIONS = """
[[injection]]
name = "{name}_times"
target = "{name}/declared"
operation = "scale"
value = 3
priority = 2
[[injection]]
name = "{name}_plus"
target = "{name}/declared"
operation = "offset"
value = 5
priority = 1
[[injection]]
name = "{name}_set"
target = "{name}/declared"
operation = "set"
value = 7
[[injection]]
name = "{name}_chained"
target = "{name}/chained"
operation = "offset"
value = {chained}
priority = {priority}
"""
_OTHERS = """
[[emulator]]
name = "plc"
kind = "s7"
layout = "{layout}"
program = "counter"
listen = "{plc}"
[grpc]
listen = ["{grpc}"]
[mqtt]
listen = "{mqtt}"
backlog_mb = 1
[recorder]
"""


class Configuration:
    """Writes supervisor.toml and layouts. ``ports``: addresses of devices, by source, and of listeners."""

    def __init__(self, folder: Path, instance: str, ports: Mapping[str, Address]) -> None:
        self.file = folder / "supervisor.toml"
        self.changes = 0
        """Number of blocks changed so far."""
        self._folder = folder
        self._instance = instance
        self._ports = ports
        self._addresses = {name: ports[name] for name in ("plc", "grpc", "mqtt")}
        self._extra = False
        for name in SIZES:
            self._write_layout(name, NAMES[0])
        (folder / EMULATED).write_bytes((folder / "demo.db").read_bytes())
        self._write()

    @property
    def names(self) -> dict[str, str]:
        """The present name of the array after the first word, by source."""
        texts = {source: (self._folder / f"{source}.db").read_text() for source in SIZES}
        return {source: next(name for name in NAMES if f" {name} :" in text) for source, text in texts.items()}

    def relayout(self, source: str) -> None:
        """Change the layout of a source by another name of its array."""
        now = (self._folder / f"{source}.db").read_text()
        self._write_layout(source, next(name for name in NAMES if name not in now))
        self.changes += 1

    def toggle_extra(self) -> None:
        """Add the source ``extra``, on the same PLC as ``demo``, or remove it."""
        self._extra = not self._extra
        self.changes += self._extra
        self._write()

    def _write_layout(self, source: str, name: str) -> None:
        words = (SIZES[source] - OTHERS) // 8 - 1
        (self._folder / f"{source}.db").write_text(_DB.format(number=NUMBER, name=name, words=words))

    def _write(self) -> None:
        text = f'[instance]\nname = "{self._instance}"\nring_mb = 1\n'
        for name in (*SIZES, *([EXTRA] if self._extra else [])):
            layout = name if name in SIZES else "demo"
            port = self._ports.get(name, self._ports["plc"]).port
            times = {"period_ms": PERIODS_MS[layout], "stale_ms": STALE_MS[layout]}
            text += _SOURCE.format(name=name, layout=layout, port=port, number=NUMBER, **times)
        for name in INJECTED:
            text += _INJECTIONS.format(name=name, chained=CHAINED, priority=PRIORITY)
        self.file.write_text(text + _OTHERS.format(layout=EMULATED, **self._addresses))
