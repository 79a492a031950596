"""What the user's verbs act on: an instance of this host (local.py), or one that is reached by gRPC (remote.py)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple, Protocol

from shmio.config import Declaration
from shmio.layout.model import Layout, Register
from shmio.local.reading import Reading
from shmio.local.replays import ReplayRequest
from shmio.local.writer import Outcome
from shmio.model.replay_status import Playing
from shmio.segment.clock import ClockState
from shmio.segment.standing_injections import StandingInjection


class Selected(NamedTuple):
    """A register, or an array's element, of a source."""

    source: str
    register: Register

    @property
    def path(self) -> str:
        """The register's path with its source."""
        return f"{self.source}/{self.register.path}"


class Change(NamedTuple):
    """A reading that differs from the one before. ``width``: of the longest path that is watched."""

    what: Selected
    now: Reading
    width: int


class Shadow(Protocol):
    """An injection that was laid."""

    number: int

    def set(self, values: Mapping[str, object]) -> Sequence[Outcome]:
        """Give values by path; what became of each."""


class CampaignEvent(NamedTuple):
    """What was done with a declared injection: ``what``, at which time of the instance's clock."""

    time_s: float
    cycle: int
    source: str
    number: int
    what: str
    text: str


class Campaign(Protocol):
    """Declared injections that were laid."""

    @property
    def stands(self) -> bool:
        """Whether any of it does, by what :meth:`news` has told."""

    def news(self) -> list[CampaignEvent]:
        """What has happened since it was asked last, or was laid."""


class Cell(Protocol):
    """An instance. Errors are those of :mod:`shmio.errors`."""

    @property
    def sources(self) -> list[str]:
        """Names of the sources."""

    def layout(self, source: str) -> Layout:
        """The layout of a source; PathError."""

    def readings(self, patterns: Sequence[str], chosen: Sequence[Selected]) -> list[Reading]:
        """The chosen registers as of now, which are what the patterns name; those of one source from one frame."""

    def news(self, patterns: Sequence[str]) -> Iterator[Change]:
        """The present readings of all that the patterns name, then each that changes. NotRunningError at the end."""

    def write(self, values: Mapping[str, object], timeout_s: float | None) -> Sequence[Outcome]:
        """Write registers of one source as one command."""

    def inject(self, *paths: str, priority: int, keep: bool, name: str) -> AbstractContextManager[Shadow]:
        """Lay an injection, for the time of a ``with`` block unless it is to be kept."""

    def declare(self, declarations: Sequence[Declaration], *, keep: bool) -> AbstractContextManager[Campaign]:
        """Lay declared injections, all or none, for the time of a ``with`` block unless they are to be kept."""

    def injections(self) -> dict[str, tuple[StandingInjection, ...]]:
        """What stands at present, by source; the innermost first."""

    def lift(self, source: str, number: int) -> None:
        """Lift an injection."""

    def lift_all(self) -> list[tuple[str, StandingInjection]]:
        """Lift all."""

    @property
    def clock(self) -> ClockState:
        """How time stands."""

    def real_sources(self) -> list[str]:
        """Names of the sources that steps do not move: those with a device."""

    def step(self, dt_s: float | None, count: int) -> None:
        """Move time by so many steps."""

    def play(self, rate: float, dt_s: float | None) -> None:
        """Have time step by itself."""

    def pause(self) -> None:
        """Have it step no more by itself."""

    def release(self) -> None:
        """Have it be real again."""

    def replay(self, wanted: ReplayRequest) -> list[Playing]:
        """Move what plays recordings, if anything is wanted; how they play then."""
