"""Imports optional libraries, and parts of large ones."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterable
from typing import Any, Final

from shmio.errors import ConfigError, MissingLibraryError

ANALYSIS: Final = "pip install 'shmio[analysis]'"
"""The command that installs the libraries for tables of recordings."""
TESTED_PAHO: Final = "2.2.0"
"""The version of paho-mqtt with which shmio was tested."""


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


def check_paho(names: Iterable[str]) -> None:
    """Check that paho's client has the private names that a subclass of it uses, because any version may change them.

    Args:
        names: The names.

    Raises:
        ConfigError: A name is missing.

    """
    import paho.mqtt  # noqa: PLC0415  most processes do not need it
    from paho.mqtt.client import Client  # noqa: PLC0415
    from paho.mqtt.enums import CallbackAPIVersion  # noqa: PLC0415

    client = Client(CallbackAPIVersion.VERSION2)
    if missing := [name for name in names if not hasattr(client, name)]:
        raise ConfigError(
            f"paho-mqtt {paho.mqtt.__version__} does not have {', '.join(missing)}, which shmio uses; install the "
            f"version with which shmio was tested: pip install paho-mqtt=={TESTED_PAHO}"
        )
