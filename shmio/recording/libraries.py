"""Libraries that not everybody has."""

from __future__ import annotations

import importlib
from typing import Any, Final

from shmio.errors import MissingLibraryError

ANALYSIS: Final = "pip install 'shmio[analysis]'"
"""The extra with all that tables of recordings need."""


def library(name: str, remedy: str) -> Any:
    """A module; MissingLibraryError with the remedy where it is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name.partition(".")[0]:
            raise
        raise MissingLibraryError(f"{name.partition('.')[0]} is not installed: {remedy}") from None
