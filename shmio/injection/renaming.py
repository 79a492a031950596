"""Renames the sources in a declared injection, for an instance in which they have other names."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from shmio.config import Declaration
from shmio.errors import ConfigError, PathError
from shmio.injection.language import Reference, nodes, parse_condition
from shmio.layout.topic import parse_topic


def renamed(declaration: Declaration, names: Mapping[str, str], default: str | None = None) -> Declaration:
    """Return a declaration whose paths name the sources as another instance does.

    Paths of sources that are not in ``names`` stay as they are.

    Args:
        declaration: The declaration.
        names: The new name of each source, by its present name.
        default: The source of paths that name none; None if there is no such source.

    Raises:
        ConfigError: The condition is invalid. The message begins with the key ``when``.

    """
    target, when = declaration.target, declaration.when
    if default is None and all(name == other for name, other in names.items()):
        return declaration
    new_target = (
        _renamed(target, names, default)
        if isinstance(target, str)
        else [_renamed(one, names, default) for one in target]
    )
    new_when = None if when is None else _renamed_condition(when, names, default)
    return msgspec.structs.replace(declaration, target=new_target, when=new_when)


def _renamed(text: str, names: Mapping[str, str], default: str | None) -> str:
    try:
        topic = parse_topic(text, names, default)
    except PathError:
        return text
    if topic.source not in names:
        return text
    return "/".join(part for part in (names[topic.source], topic.path, topic.direction) if part)


def _renamed_condition(text: str, names: Mapping[str, str], default: str | None) -> str:
    try:
        tree = parse_condition(text)
    except ConfigError as error:
        raise ConfigError(f"when: {error}") from None
    found = {one.at: one.path for one in nodes(tree) if isinstance(one, Reference)}
    for at, path in sorted(found.items(), reverse=True):
        start = at - 1
        stop = start + len(path) + (2 if text[start] in "\"'" else 0)
        new = _renamed(path, names, default)
        if new == path:
            continue
        mark = "'" if '"' in new else '"'
        if mark in new:
            raise ConfigError(f"when: the name {path} has both kinds of quotes; rename the register")
        text = f"{text[:start]}{mark}{new}{mark}{text[stop:]}"
    return text
