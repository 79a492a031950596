"""Which instance a verb acts on."""

from __future__ import annotations

import argparse
import tomllib
from pathlib import Path

import msgspec

from shmio.config.model import Name
from shmio.errors import ConfigError, ControlError, NotRunningError
from shmio.segment import Segment, instances

DEFAULT_CONFIG = Path("supervisor.toml")
MAX_FILE_BYTES = 1 << 20


def config_file(arguments: argparse.Namespace) -> Path:
    """The configuration that a verb reads."""
    return arguments.config or DEFAULT_CONFIG


def instance_name(arguments: argparse.Namespace) -> str:
    """The instance: as asked, else of the configuration asked for or here, else the only running one.

    ConfigError: not a name, or none in the file; NotRunningError: none runs; ControlError: several do.
    """
    if arguments.instance is not None:
        return _checked("--instance", arguments.instance)
    if arguments.config is not None or DEFAULT_CONFIG.exists():
        return _named_in(config_file(arguments))
    running = instances()
    if not running:
        raise NotRunningError("no instance is running, and there is no supervisor.toml here")
    if len(running) > 1:
        raise ControlError(f"several instances are running: choose one by --instance ({', '.join(running)})")
    return running[0]


def open_supervised(name: str) -> Segment:
    """Open the segment of an instance that has a living supervisor; NotRunningError otherwise."""
    segment = Segment.open(name)
    if not segment.supervised:
        segment.close()
        raise NotRunningError(
            f"the supervisor of instance {name!r} is dead: shmio-supervisor up takes over, down clears what it left"
        )
    return segment


def _named_in(file: Path) -> str:
    """The name alone: an instance must be stoppable when its file has been spoilt since."""
    try:
        with file.open("rb") as stream:
            tables = tomllib.loads(stream.read(MAX_FILE_BYTES).decode())
        name = tables["instance"]["name"]
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{file}: not TOML: {error}; --instance NAME does without it") from None
    except (KeyError, TypeError):
        raise ConfigError(f"{file}: instance.name: this key is needed; --instance NAME does without it") from None
    return _checked(f"{file}: instance.name", name)


def _checked(key: str, name: object) -> str:
    try:
        return msgspec.convert(name, Name)
    except msgspec.ValidationError:
        raise ConfigError(f"{key}: {name!r} is not a name: at most 40 letters, digits and _ . -") from None
