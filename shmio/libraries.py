"""Imports optional libraries, and parts of large ones."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from typing import Any, Final

from shmio.errors import MissingLibraryError

ANALYSIS: Final = "pip install 'shmio[analysis]'"
"""The command that installs the libraries for tables of recordings."""


def library(name: str, remedy: str) -> Any:
    """Import an optional module.

    Raises:
        MissingLibraryError: The library is not installed. The message contains ``remedy``.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name.partition(".")[0]:
            raise
        raise MissingLibraryError(f"{name.partition('.')[0]} is not installed; run {remedy}") from None


def skip_package_code(name: str) -> None:
    """Let later imports of a package's modules not run the package's own code, which may import much more.

    The package then lacks the names that it offers itself. Use this only in a process in which
    nothing needs them. If the package is imported already, nothing changes.
    """
    if name not in sys.modules and (spec := importlib.util.find_spec(name)) is not None:
        sys.modules[name] = importlib.util.module_from_spec(spec)
