"""Loads models by name: a class of a Python module, or an FMU."""

from __future__ import annotations

import importlib
import inspect
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, TypeGuard

from shmio.errors import ConfigError
from shmio.simulation import fmu
from shmio.simulation.model import Model, explain
from shmio.wording import unknown


def load(text: str, folder: str | Path | None = None) -> type[Model]:
    """Import a model's class, or make one of an FMU.

    Args:
        text: ``package.module:Class``, or the path of an FMU, which ends in ``.fmu``.
        folder: A folder to search for FMUs, and for modules that are not installed, such as the
            configuration's folder; None: no folder.

    Raises:
        ConfigError: The text is malformed, the module or class does not exist, its import fails, or
            the class is not a model.
        ModelError: The FMU cannot be used.

    """
    if fmu.is_fmu(text):
        return fmu.load_fmu(Path(folder or ".") / text)
    name, colon, attribute = text.partition(":")
    if not (colon and attribute.isidentifier() and all(part.isidentifier() for part in name.split("."))):
        raise ConfigError(f"expected package.module:Class or the file of an FMU (.fmu), found {text!r}")
    module = _module(name, folder)
    found: Any = getattr(module, attribute, None)
    if found is None:
        there = [
            name for name, value in vars(module).items() if _is_model(value) and value.__module__ == module.__name__
        ]
        raise ConfigError(unknown("class", attribute, there, name))
    if not _is_model(found):
        raise ConfigError(f"{text} is not a subclass of shmio.simulation.Model")
    if inspect.isabstract(found):
        raise ConfigError(f"{text} has no method {min(found.__abstractmethods__)}(self, time_s, dt_s)")
    return found


def _is_model(value: object) -> TypeGuard[type[Model]]:
    return isinstance(value, type) and issubclass(value, Model)


def _module(name: str, folder: str | Path | None) -> ModuleType:
    if folder is not None and str(folder) not in sys.path:
        sys.path.append(str(folder))  # last, so that no file in the folder hides an installed module
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{name}.".startswith(f"{error.name}."):
            where = "installed" if folder is None else f"installed or in {folder}"
            raise ConfigError(f"there is no module {error.name} that is {where}") from None
        raise ConfigError(f"{name} cannot be imported: {explain(error, name)}") from error
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{name} cannot be imported: {explain(error, name)}") from error
