"""Resolve the names of sources and registers in a dump."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from shmio.errors import PathError
from shmio.layout.model import Register
from shmio.layout.topic import Topic, parse_topic
from shmio.recording.reading.blocks import DumpBlock

Chosen = dict[DumpBlock, list[Register]]


class Names:
    """Resolves names in the blocks of a dump."""

    def __init__(self, blocks: Sequence[DumpBlock]) -> None:
        self._blocks = blocks
        self.sources = tuple(dict.fromkeys(block.source for block in blocks))

    def one(self, name: str | None) -> str:
        """Check a source's name, and return it; None stands for the only one. PathError: unknown source."""
        if name is None and len(self.sources) == 1:
            return self.sources[0]
        if name not in self.sources:
            which = "name a source" if name is None else f"no source {name!r}"
            raise PathError(f"{which}; there are: {', '.join(self.sources) or 'none'}")
        return name

    def several(self, names: str | Collection[str] | None) -> set[str]:
        """Check names of sources, and return them; None stands for all. PathError: unknown source."""
        if names is None:
            return set(self.sources)
        return {self.one(name) for name in ([names] if isinstance(names, str) else names)}

    def select(self, paths: Iterable[str]) -> Chosen:
        """Return the registers that paths of any form name, by block. PathError: no such register."""
        default = self.sources[0] if len(self.sources) == 1 else None
        chosen: dict[DumpBlock, dict[str, Register]] = {}
        for path in paths:
            topic = parse_topic(path, self.sources, default)
            if topic.direction == "in":
                raise PathError(f"{path}: a recording has only outputs of a source; leave out /in")
            for block, registers in self._named(path, topic).items():
                chosen.setdefault(block, {}).update((register.path, register) for register in registers)
        return {block: list(chosen[block].values()) for block in self._blocks if block in chosen}

    def of_one_source(self, paths: str | Iterable[str]) -> Chosen:
        """Return the registers that paths name, by block. PathError: none, or of several sources."""
        chosen = self.select([paths] if isinstance(paths, str) else paths)
        sources = sorted({block.source for block in chosen})
        if len(sources) != 1:
            raise PathError(f"registers of {' and '.join(sources) or 'no source'}: name those of one source at a time")
        return chosen

    def _named(self, path: str, topic: Topic) -> Chosen:
        """Look in all blocks of the source, as a reload may have changed the layout."""
        found: Chosen = {}
        problem = PathError(f"{path}: no register of this recording has such a path")
        for block in self._blocks:
            if block.source == topic.source:
                try:
                    registers = block.named(topic)
                except PathError as error:
                    problem = error
                else:
                    if registers:
                        found[block] = registers
        if not found:
            raise problem
        return found
