"""The schedule of faults: an endless series of rounds that depends on the seed alone."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

SOURCES: Final = ("fast", "block")
"""Sources whose PLC is behind a proxy and records the truth."""
BROKER: Final = "broker"
WORKERS: Final = ("fast", "block", "demo", "plc", "grpc", "mqtt", BROKER, "recorder")
"""Processes that the supervisor starts; ``plc`` emulates the PLC of ``demo``."""
SUPERVISOR: Final = "supervisor"

PROCESS_FAULTS: Final = {"kill": 6, "pause": 3, "hang": 1, "restart": 3, "torn": 2, "relayout": 2}
DEVICE_FAULTS: Final = {
    "delay": 2, "cut": 2, "cut_after": 2, "freeze": 2, "refuse": 2, "garble": 2, "late": 2, "reference": 2, "drop": 2,
    "plc_kill": 2, "plc_pause": 2,
}  # fmt: skip
OTHER_FAULTS: Final = {
    "supervisor_kill": 3,
    "supervisor_pause": 2,
    "clock": 3,
    "midwrite": 3,
    "reload": 2,
    "shm_full": 2,
    "broker_kill": 2,
    "broker_pause": 2,
}
WEIGHTS: Final = PROCESS_FAULTS | DEVICE_FAULTS | OTHER_FAULTS
"""Relative frequency of each kind of fault."""

RESTARTING: Final = {"kill", "hang", "restart", "torn", "broker_kill"}
"""Kinds of faults that replace the target's process."""
RENEWING: Final = {"relayout"}
"""Kinds of faults that may replace the target and reset its number of restarts to 0."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault. It begins ``after_s`` after its round begins. Faults with a duration last ``for_s``."""

    kind: str
    target: str
    after_s: float
    for_s: float
    number: int
    """Random number for all other choices."""

    def __str__(self) -> str:
        return f"{self.kind} {self.target} at +{self.after_s:.2f} s for {self.for_s:.2f} s ({self.number})"


@dataclass(frozen=True, slots=True)
class Round:
    """Faults that happen together. Everything must recover before the next round."""

    faults: tuple[Fault, ...]
    rest_s: float
    """Time without faults after the recovery."""


def rounds(seed: int) -> Iterator[Round]:
    """Yield a seed's rounds, endlessly.

    The faults of a round have different targets. A fault of the supervisor is the only one in its round.
    """
    chance = random.Random(seed)
    kinds, weights = list(WEIGHTS), list(WEIGHTS.values())
    while True:
        count = chance.choices((1, 2, 3), (70, 20, 10))[0]
        faults: dict[str, Fault] = {}
        for kind in chance.choices(kinds, weights, k=count):
            fault = _fault(kind, chance)
            faults.setdefault(fault.target, fault)
        alone = next((fault for fault in faults.values() if fault.target == SUPERVISOR), None)
        yield Round((alone,) if alone else tuple(faults.values()), chance.choice((0.0, chance.uniform(0, 1), 6.0)))


def _fault(kind: str, chance: random.Random) -> Fault:
    target = kind
    if kind in PROCESS_FAULTS:
        target = chance.choice(("fast", "block", "demo") if kind in ("torn", "relayout") else WORKERS)
    elif kind in DEVICE_FAULTS:
        target = f"device of {chance.choice(SOURCES)}"
    elif kind.startswith((SUPERVISOR, BROKER)):
        target = kind.partition("_")[0]
    # Shorter than the 5 s after which the supervisor replaces a process that does not respond.
    for_s = chance.uniform(0.05, 3.0)
    return Fault(kind, target, chance.uniform(0, 1), for_s, chance.getrandbits(32))
