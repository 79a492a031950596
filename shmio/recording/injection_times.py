"""Finds the periods in which injections were active, from events."""

from __future__ import annotations

from typing import Final

from shmio.judging.report import Span
from shmio.segment.events import Event, EventKind

MAX_SPANS: Final = 10_000
"""Maximum number of finished periods to store; later periods are left out."""


class InjectionTimes:
    """The periods in which injections were active, according to the events of their sources.

    A declared injection is active from its activation on; a client's injection is active from its
    first value on.
    """

    def __init__(self) -> None:
        self._names: dict[tuple[str, int], str] = {}
        self._begun: dict[tuple[str, int], int] = {}
        self._over: list[Span] = []

    def follow(self, source: str, event: Event) -> None:
        """Add the next event of a source."""
        key = source, event.injection
        if event.kind == EventKind.INJECTED:
            self._names[key] = event.text
        elif event.kind in (EventKind.ACTIVATED, EventKind.SHADOWED):
            self._names.setdefault(key, event.text)
            self._begun.setdefault(key, event.clock_ns)
        elif event.kind in (EventKind.DEACTIVATED, EventKind.LIFTED) and key in self._begun:
            begin_ns = self._begun.pop(key)
            if len(self._over) < MAX_SPANS:
                self._over.append(Span(self._name(key), source, begin_ns, event.clock_ns))

    @property
    def spans(self) -> list[Span]:
        """The periods, sorted by their start. The end is None if the injection is still active."""
        open_ = [Span(self._name(key), key[0], begin_ns, None) for key, begin_ns in self._begun.items()]
        return sorted([*self._over, *open_], key=lambda span: span.begin_ns)

    def _name(self, key: tuple[str, int]) -> str:
        return self._names.get(key) or str(key[1])
