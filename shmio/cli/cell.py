"""The interface that the verbs of ``shmio`` use: an instance on this host, or one behind gRPC."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple, Protocol

from shmio.config import Declaration
from shmio.layout.model import Layout, Register
from shmio.local.reading import Reading
from shmio.local.replays import ReplayRequest
from shmio.model.clock import Clock
from shmio.model.outcome import Outcome
from shmio.model.replay_status import Playing
from shmio.segment.standing_injections import StandingInjection


class Selected(NamedTuple):
    """A register or array element of a source."""

    source: str
    register: Register

    @property
    def path(self) -> str:
        """The register's path with its source."""
        return f"{self.source}/{self.register.path}"


class Change(NamedTuple):
    """A changed reading; ``width`` is the length of the longest watched path, in characters."""

    what: Selected
    now: Reading
    width: int


class Shadow(Protocol):
    """An active injection."""

    number: int

    def set(self, values: Mapping[str, object]) -> Sequence[Outcome]:
        """Set values by path, and return the outcome of each."""


class CampaignEvent(NamedTuple):
    """An event of a declared injection; ``time_s`` is of the instance's clock."""

    time_s: float
    cycle: int
    source: str
    number: int
    what: str
    text: str


class Campaign(Protocol):
    """The declared injections of one campaign."""

    @property
    def stands(self) -> bool:
        """Whether any injection remains, according to the events that :meth:`news` has returned."""

    def news(self) -> list[CampaignEvent]:
        """Return the events since the last call, or since the start."""


class Cell(Protocol):
    """An instance; its methods raise the errors of :mod:`shmio.errors`."""

    @property
    def sources(self) -> list[str]:
        """Names of the sources."""

    def layout(self, source: str) -> Layout:
        """Return the layout of a source; PathError if there is no such source."""

    def readings(self, patterns: Sequence[str], chosen: Sequence[Selected]) -> list[Reading]:
        """Return the present readings of ``chosen``, the registers that the patterns name.

        Readings of one source come from one frame.
        """

    def news(self, patterns: Sequence[str]) -> Iterator[Change]:
        """Yield the present readings of all that the patterns name, then each change.

        NotRunningError or RemoteError ends the iteration when the instance ends.
        """

    def write(self, values: Mapping[str, object], timeout_s: float | None) -> Sequence[Outcome]:
        """Write registers of one source as one command."""

    def inject(self, *paths: str, priority: int, keep: bool, name: str) -> AbstractContextManager[Shadow]:
        """Start an injection for the duration of a ``with`` block, or permanently with ``keep``."""

    def declare(self, declarations: Sequence[Declaration], *, keep: bool) -> AbstractContextManager[Campaign]:
        """Start all declared injections or none, for a ``with`` block or permanently."""

    def injections(self) -> dict[str, tuple[StandingInjection, ...]]:
        """Return the present injections by source, innermost first."""

    def lift(self, source: str, number: int) -> None:
        """Remove an injection."""

    def lift_all(self) -> list[tuple[str, StandingInjection]]:
        """Remove all injections, and return them with their sources."""

    @property
    def clock(self) -> Clock:
        """The state of the instance's clock."""

    def real_sources(self) -> list[str]:
        """Return the names of the sources with a device, which steps do not affect."""

    def step(self, dt_s: float | None, count: int) -> None:
        """Advance the clock by ``count`` steps of ``dt_s`` each."""

    def play(self, rate: float, dt_s: float | None) -> None:
        """Let the clock advance by itself at ``rate`` times real time."""

    def pause(self) -> None:
        """Stop the clock."""

    def release(self) -> None:
        """Return the clock to real time."""

    def replay(self, wanted: ReplayRequest) -> list[Playing]:
        """Control the replayed sources if anything is requested, and return their states."""
