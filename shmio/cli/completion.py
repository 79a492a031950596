"""Completes command lines with argcomplete. The shell runs the command, which prints the choices.

argcomplete itself completes options, verbs and choices. This module completes the other arguments,
by their ``dest``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

from shmio.errors import ShmioError
from shmio.libraries import library

PROGRAMS: Final = ("shmio", "shmio-supervisor", "shmio-dump", "shmio-layout", "shmio-campaign")
SHELLS: Final = ("bash", "zsh", "fish")

Completer = Callable[..., Iterable[str]]


def script(shell: str) -> str:
    """Return the code that a shell must run at its start to complete the commands of shmio.

    Raises:
        MissingLibraryError: argcomplete is not installed.

    """
    text: str = _argcomplete().shellcode(PROGRAMS, shell=shell)
    return text


def answer(parser: argparse.ArgumentParser) -> None:
    """Print the possible completions for the shell, and exit.

    Raises:
        MissingLibraryError: argcomplete is not installed.

    """
    completers = _argcomplete().completers
    files = completers.FilesCompleter

    by_dest: dict[str, Completer] = {
        "campaign": files(["toml"]),
        "config": files(["toml"]),
        "directory": completers.DirectoriesCompleter(),
        "instance": _instances,
        "name": _processes,
        "only": _registers,
        "pairs": _registers,
        "patterns": _registers,
        "registers": _registers,
        "source": _sources,
        "sources": _sources,
        "value": _registers,
    }
    if parser.prog in ("shmio-dump", "shmio-campaign"):
        by_dest |= dict.fromkeys(("file", "files"), files(["mem"]))
    for action in _actions(parser):
        if action.choices is None and action.nargs != 0:
            other = files() if "FILE" in str(action.metavar) or action.dest == "types" else _nothing
            action.completer = by_dest.get(action.dest, other)  # type: ignore[attr-defined]  # argcomplete's way
    _argcomplete().autocomplete(parser, always_complete_options=False)


def _argcomplete() -> Any:
    return library("argcomplete", "pip install argcomplete")


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for verb in action.choices.values():
                yield from _actions(verb)


# -- completers ----------------------------------------------------------------------------------------------


def _nothing(**_: object) -> list[str]:
    return []


def _instances(**_: object) -> list[str]:
    from shmio.segment import running_instances  # noqa: PLC0415  nothing else: the user waits for the shell

    return running_instances()


def _processes(parsed_args: argparse.Namespace, **_: object) -> list[str]:
    """Return the process names for ``restart`` and ``logs``."""
    from shmio.cli.target import target  # noqa: PLC0415

    try:
        with target(parsed_args).open() as segment:
            names = [slot.name for slot in segment.processes]
    except ShmioError:
        return []
    return ["supervisor", *names] if parsed_args.verb == "logs" else names


def _sources(parsed_args: argparse.Namespace, **_: object) -> list[str]:
    return list(_paths(parsed_args))


def _registers(prefix: str, parsed_args: argparse.Namespace, **_: object) -> list[str]:
    """Return the paths that begin with the prefix, each up to its next slash."""
    found = _paths(parsed_args)
    paths = [f"{source}/{path}" for source, ones in found.items() for path in ones]
    if len(found) == 1 and not any(path.startswith(prefix) for path in paths):
        paths = [path for ones in found.values() for path in ones]  # the only source's name may be left out
    ends = ((path, path.find("/", len(prefix)) + 1) for path in paths if path.startswith(prefix))
    return sorted({path[:end] if end else path for path, end in ends})


def _paths(options: argparse.Namespace) -> dict[str, list[str]]:
    """Return paths by source.

    They come from the recordings on the command line, or from the instance.
    """
    files = getattr(options, "files", None) or [getattr(options, "file", None)]
    try:
        return _recorded(files) if hasattr(options, "output") or files[0] else _running(options)
    except (ShmioError, OSError):
        return {}


def _recorded(files: list[Any]) -> dict[str, list[str]]:
    from shmio.recording.dump import open_dump  # noqa: PLC0415

    found: dict[str, list[str]] = {}
    with open_dump([file for file in files if file is not None]) as dump:
        for block in dump.blocks:
            found.setdefault(block.source, []).extend(register.path for register in block.layout.registers)
    return found


def _running(options: argparse.Namespace) -> dict[str, list[str]]:
    from shmio.cli.target import target  # noqa: PLC0415
    from shmio.local.attach import Attachment  # noqa: PLC0415

    if getattr(options, "host", None) is not None:
        return {}
    with Attachment(target(options).open()) as attachment:
        layouts = attachment.layouts()
        return {source: [register.path for register in layout.registers] for source, layout in layouts.items()}
