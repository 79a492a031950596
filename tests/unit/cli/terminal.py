"""Runs a command on a pseudo-terminal."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import termios


class Terminal:
    """Runs a command on a pseudo-terminal of 80 columns and 6 lines."""

    def __init__(self, *words: str, **environment: str) -> None:
        self._master, slave = pty.openpty()
        termios.tcsetwinsize(slave, (24, 200))
        variables = os.environ | {"TERM": "xterm", "COLUMNS": "80", "LINES": "6"} | environment
        self.process = subprocess.Popen(
            words, stdin=slave, stdout=slave, stderr=slave, env=variables, start_new_session=True
        )
        os.close(slave)
        self._data = b""

    def until(self, pattern: str) -> str:
        """Return the output up to the pattern; fail if the command does not print it in time."""
        while not (found := re.search(pattern, text := self._data.decode(errors="ignore"), re.DOTALL)):
            try:
                self._data += os.read(self._master, 65536)
            except OSError:  # the command has ended
                raise AssertionError(f"the command did not print {pattern!r}, but {text!r}") from None
        self._data = text[found.end() :].encode()
        return text[: found.end()]

    def type(self, keys: str) -> None:
        """Send keys as if typed on the keyboard."""
        os.write(self._master, keys.encode())

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._master)
