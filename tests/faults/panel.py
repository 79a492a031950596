"""All checking processes, and what they have reported so far."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Final, Self

from tests.faults.checker import Description
from tests.faults.checks import Counts

MODULES: Final = ("local", "remote", "mqtt", "churn", "writing", "injecting", "chaining", "recorded")
LATE: Final = ("slow", "recorded", "injected")
"""Name prefixes of checkers that see values late, or check one source after the other."""
END_S: Final = 200.0
"""Maximum s for a checker to end. The checker of the recordings first reads the remaining files."""


class Panel:
    """Runs the checkers. A context manager; after its end, the counters are final."""

    def __init__(self, description: Description, environment: dict[str, str], complain: Callable[[str], None]) -> None:
        self.counts: dict[str, Counts] = {}
        self._complain = complain
        self._silent = set(MODULES)
        self._checkers: list[tuple[subprocess.Popen[str], threading.Thread]] = []
        for module in MODULES:
            popen = subprocess.Popen(
                [sys.executable, "-P", "-m", f"tests.faults.{module}", description.to_json()],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=environment,
                text=True,
            )
            thread = threading.Thread(target=self._listen, args=(popen, module))
            thread.start()
            self._checkers.append((popen, thread))

    def _listen(self, popen: subprocess.Popen[str], module: str) -> None:
        assert popen.stdout is not None
        for line in popen.stdout:
            message = json.loads(line)
            if "violation" in message:
                self._complain(f"{module}, at {message['at_ns']}: {message['violation']}")
            else:
                self._silent.discard(module)
                self.counts |= {name: Counts(**counts) for name, counts in message["counts"].items()}

    def behind(self, when_ns: int) -> list[str]:
        """Return the checkers (except :data:`LATE`) without a good value newer than ``when_ns``."""
        late = [n for n, counts in self.counts.items() if counts.since_ns <= when_ns and not n.startswith(LATE)]
        return [*self._silent, *late]

    def check(self) -> None:
        """Report a violation if a checker has ended."""
        for popen, _ in self._checkers:
            if popen.poll() is not None:
                self._complain(f"a checker ended with status {popen.returncode}: {popen.args!r}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for popen, _thread in self._checkers:
            assert popen.stdin is not None
            popen.stdin.close()
        for popen, thread in self._checkers:
            try:
                status = popen.wait(END_S)
            except subprocess.TimeoutExpired:
                popen.kill()
                status = popen.wait()
            thread.join()
            assert popen.stdout is not None
            popen.stdout.close()
            if status < 0:
                self._complain(f"a checker was killed by signal {-status}: {popen.args!r}")
