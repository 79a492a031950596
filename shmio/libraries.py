"""Imports optional libraries."""

from __future__ import annotations

import importlib
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
