"""Selects the configuration's rule for each register."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from shmio.config import MqttTopic
from shmio.layout.glob import Glob
from shmio.layout.topic import canonical_path, names_part

DEFAULT: Final = MqttTopic(match="**")
"""The rule of registers that no other rule matches."""


class TopicRules:
    """The configuration's rules; the first that matches counts."""

    def __init__(self, topics: Sequence[MqttTopic]) -> None:
        """Compile the rules.

        Raises:
            PathError: A pattern is invalid.

        """
        self._frames = {pattern: rule for rule in topics if rule.payload == "frames" for pattern in rule.patterns}
        rules = [(pattern, rule) for rule in topics if rule.payload != "frames" for pattern in rule.patterns]
        self._parts: dict[str, MqttTopic] = {}
        for pattern, rule in rules:
            if names_part(pattern):
                self._parts.setdefault(canonical_path(pattern, parts=True), rule)
        self._rules = [(Glob(pattern), rule) for pattern, rule in rules if not names_part(pattern)]

    def of(self, source: str, path: str) -> MqttTopic:
        """Return the rule of a register, bit or slice."""
        full = f"{source}/{path}"
        return self._parts.get(full) or self._first(full)[1]

    def parts(self, source: str) -> Iterator[str]:
        """Yield the paths of a source's bits, slices and other parts that have rules of their own."""
        for full, rule in self._parts.items():
            first, _, path = full.partition("/")
            if first == source and rule.publish:
                yield path

    def structure(self, source: str, path: str) -> str | None:
        """Return the structure that a register is published in; empty: the source; None: by itself."""
        glob, rule = self._first(f"{source}/{path}")
        if glob is None or rule.payload != "structure":
            return None
        names = [source, *path.split("/")]
        depths = range(1, len(names))
        return next(("/".join(names[1:n]) for n in depths if glob.matches("/".join(names[:n]))), None)

    def _first(self, full: str) -> tuple[Glob | None, MqttTopic]:
        return next((found for found in self._rules if found[0].matches(full)), (None, DEFAULT))

    def frames(self, source: str) -> MqttTopic | None:
        """Return the rule for a source's whole frames; None: they are not published."""
        rule = self._frames.get(source)
        return rule if rule and rule.publish else None
