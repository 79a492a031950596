"""Libraries that not everybody has."""

from __future__ import annotations

import importlib
from typing import Any

from shmio.errors import MissingLibraryError


def library(name: str, remedy: str) -> Any:
    """A module; MissingLibraryError with the remedy where it is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name.partition(".")[0]:
            raise
        raise MissingLibraryError(f"{name.partition('.')[0]} is not installed: {remedy}") from None
