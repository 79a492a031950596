"""The reference of the commands: what ``--help`` of each verb prints, from the parsers themselves."""

from __future__ import annotations

import argparse
import importlib
import os
from collections.abc import Iterator
from typing import Final

COMMANDS: Final = {
    "shmio": "shmio.cli.user:_parser",
    "shmio-supervisor": "shmio.cli.supervisor:_parser",
    "shmio-dump": "shmio.cli.dump:_parser",
    "shmio-layout": "shmio.cli.layout:_parser",
    "shmio-layout import": "shmio.cli.layout_import:parser_of_import",
    "shmio-campaign": "shmio.cli.campaign:_parser",
}
"""The function that makes the parser of each command."""


def pages() -> dict[str, tuple[str, str]]:
    """Return title and text of a page for each command, by its path."""
    os.environ["COLUMNS"] = "86"
    found = {}
    for name, place in COMMANDS.items():
        module, _, function = place.partition(":")
        parser: argparse.ArgumentParser = getattr(importlib.import_module(module), function)()
        title = f"{name} --help"
        found[f"reference/generated/{name.replace(' ', '-')}.md"] = title, _page(title, parser)
    return found


def _page(title: str, parser: argparse.ArgumentParser) -> str:
    parts = [f"# {title}\n\n{parser.description or ''}\n", _help(parser)]
    parts += [f"## {verb}\n\n{_help(inner)}" for verb, inner in _verbs(parser)]
    return "\n".join(parts)


def _help(parser: argparse.ArgumentParser) -> str:
    return f"```text\n{parser.format_help()}```\n"


def _verbs(parser: argparse.ArgumentParser, before: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield the parsers of all verbs, and of their verbs."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                yield f"{before}{name}", inner
                yield from _verbs(inner, f"{before}{name} ")
