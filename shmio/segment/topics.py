"""Topics that a program names together."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from shmio.errors import PathError
from shmio.layout.topic import Topic, parse_topic
from shmio.segment.block import Block


def of_one_source(what: str, paths: Collection[str], blocks: Mapping[str, Block]) -> tuple[Block, list[Topic]]:
    """The block and the topics of paths that must be of one source; PathError. ``what`` they are given for."""
    default = next(iter(blocks)) if len(blocks) == 1 else None
    topics = [parse_topic(path, blocks, default) for path in paths]
    for path, topic in zip(paths, topics, strict=True):
        if topic.source not in blocks:
            raise PathError(f"{path}: nothing is served under {topic.source} in this version")
    sources = {topic.source for topic in topics}
    if len(sources) != 1:
        raise PathError(f"one {what} is for one source, these are for {', '.join(sorted(sources)) or 'none'}")
    return blocks[sources.pop()], topics
