"""Which of the configuration's rules a register is published by."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from shmio.config import MqttTopic
from shmio.layout.glob import Glob

DEFAULT: Final = MqttTopic(match="**")
"""That of registers that no rule matches."""


class Rules:
    """The rules in their order; of several that match the first counts."""

    def __init__(self, topics: Sequence[MqttTopic]) -> None:
        """PathError: a pattern that is none."""
        self._frames = {pattern: rule for rule in topics if rule.payload == "frames" for pattern in rule.patterns}
        self._rules = [
            (Glob(pattern), rule) for rule in topics if rule.payload != "frames" for pattern in rule.patterns
        ]

    def of(self, source: str, path: str) -> MqttTopic:
        """The rule of a register."""
        full = f"{source}/{path}"
        return next((rule for glob, rule in self._rules if glob.matches(full)), DEFAULT)

    def frames(self, source: str) -> MqttTopic | None:
        """The rule by which a source's frames are published as a whole; None: they are not."""
        rule = self._frames.get(source)
        return rule if rule and rule.publish else None
