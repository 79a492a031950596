"""Checks the rules of ``[[fabric.rule]]`` against the sources and their layouts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase

from shmio.config import Config
from shmio.endpoints.fabric.feed import rule_for
from shmio.errors import ConfigError
from shmio.fabric.messages import MAX_ENTRY_BYTES
from shmio.layout.model import Layout
from shmio.recording.selection import Selection


def odd_rules(config: Config, layouts: Mapping[str, Layout]) -> Iterator[str]:
    """Yield warnings about rules that are probably not intended.

    Raises:
        ConfigError: A published source is too large for a message.

    """
    fabric = config.fabric
    if fabric is None or fabric.cell is None:
        return
    for index, rule in enumerate(fabric.rule):
        key = f"fabric.rule[{index}]"
        for pattern in rule.patterns:
            if not any(fnmatchcase(source, pattern) for source in layouts):
                yield f"{key}.match: {pattern!r} matches no source"
        for text in Selection(registers=rule.registers).unmatched(layouts):
            yield f"{key}.registers: {text}"
    for source in config.source:
        rule = rule_for(fabric.rule, source.name)
        if rule.send == "nothing" or source.connector == "fabric":
            continue
        size = layouts[source.name].size
        if 2 * size + 512 > MAX_ENTRY_BYTES:  # a frame with injections has two images
            raise ConfigError(
                f"fabric.rule: source {source.name} has {size} bytes, too many for a message of 1 MB; add a "
                f'[[fabric.rule]] with match = "{source.name}" and send = "nothing"'
            )
        if rule.max_rate_hz is not None and 1e9 / rule.max_rate_hz > source.stale_ns:
            yield (
                f"fabric.rule[{fabric.rule.index(rule)}].max_rate_hz: frames of {source.name} come each "
                f"{1 / rule.max_rate_hz:g} s, but are stale after {source.stale_ns / 1e9:g} s; raise max_rate_hz, or "
                "stale_ms of the source"
            )
