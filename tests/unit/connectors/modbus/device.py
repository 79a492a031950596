"""A Modbus device for tests: ``device.c``, made with libmodbus."""

from __future__ import annotations

import atexit
import functools
import shutil
import subprocess
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest

from shmio.config import Address

SOURCE = Path(__file__).with_name("device.c")
WORDS = 2000
"""Entries of each table."""
MISSING = "" if Path("/usr/include/modbus/modbus.h").exists() else "no libmodbus here: apt-get install libmodbus-dev"


@functools.cache
def program() -> Path:
    """Compile the device, once for each test run."""
    if MISSING:
        pytest.skip(MISSING)
    folder = Path(tempfile.mkdtemp(prefix="shmio-modbus-"))
    atexit.register(shutil.rmtree, folder)
    target = folder / "device"
    flags = ["-std=gnu11", "-O1", "-Wall", "-Wextra", "-Werror", "-I/usr/include/modbus"]
    done = subprocess.run(["cc", *flags, "-o", target, SOURCE, "-lmodbus"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target


class Device:
    """The running device."""

    def __enter__(self) -> Self:
        self._process = subprocess.Popen([program()], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.address = Address("127.0.0.1", int(self._line()))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate(timeout=60)

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()

    def _ask(self, *words: object) -> str:
        assert self._process.stdin is not None
        self._process.stdin.write(" ".join(map(str, words)) + "\n")
        self._process.stdin.flush()
        return self._line()

    def set(self, table: str, number: int, values: list[int], unit: int = 1) -> None:
        """Set entries of a table."""
        self._ask("set", unit, table[0], number, *values)

    def get(self, table: str, number: int, count: int = 1, unit: int = 1) -> list[int]:
        """Return entries of a table."""
        return [int(word) for word in self._ask("get", unit, table[0], number, count).split()]

    def calls(self) -> list[tuple[int, int, int]]:
        """Return function, address and count of each request since the last call."""
        parts = [one.split() for one in self._ask("calls").strip().split(";") if one]
        return [(int(function), int(address), int(count)) for function, address, count in parts]

    def count(self, address: int, words: int) -> None:
        """Count up in all of these holding registers, and in the upper bits of the byte after them."""
        self._ask("count", address, words)

    def slow(self, pause_ms: int) -> None:
        """Pause before each answer."""
        self._ask("slow", pause_ms)
