"""Loads models by name: a class of a Python module, or an FMU."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Final, TypeGuard

from shmio.errors import ConfigError
from shmio.simulation import fmu
from shmio.simulation.fmu import DEFAULTS, FmuOptions
from shmio.simulation.model import Model, explain
from shmio.wording import unknown

_OWN: Final = "_beside_configuration"
"""Suffix of the names of modules in the folder that have the names of installed ones."""


_FOLDERS: Final[set[Path]] = set()
"""The folders from which models were loaded."""


def load(text: str, folder: str | Path | None = None, options: FmuOptions = DEFAULTS) -> type[Model]:
    """Import a model's class, or make one of an FMU.

    Args:
        text: ``package.module:Class``, or the path of an FMU, which ends in ``.fmu``.
        folder: A folder to search for FMUs and modules first, such as the configuration's folder;
            None: no folder. A file in it precedes an installed module of the same name, also one of
            Python itself, but not shmio.
        options: How to read an FMU.

    Raises:
        ConfigError: The text is malformed, the module or class does not exist, its import fails, or
            the class is not a model.
        ModelError: The FMU cannot be used.

    """
    if fmu.is_fmu(text):
        return fmu.load_fmu(Path(folder or ".") / text, options)
    if options != DEFAULTS:
        raise ConfigError("strict and text_length are only for FMUs; leave them out")
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
    if folder is not None:
        _FOLDERS.add(Path(folder).resolve())
        if str(folder) not in sys.path:
            sys.path.append(str(folder))  # last, so that no file in the folder hides a module that others import
    own = None if folder is None else _beside(name, Path(folder))
    imported = name
    try:
        if own is not None:
            other = _origin(name.partition(".")[0])
            if other != own:
                installed = other is None or _FOLDERS.isdisjoint(other.parents)
                imported = _import_file(name, own, _OWN if installed else "")
        return importlib.import_module(imported)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{imported}.".startswith(f"{error.name}."):
            where = "installed" if folder is None else f"installed or in {folder}"
            raise ConfigError(f"there is no module {error.name.replace(_OWN, '')} that is {where}") from None
        raise ConfigError(f"{name} cannot be imported: {explain(error, imported)}") from error
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{name} cannot be imported: {explain(error, imported)}") from error


def _beside(name: str, folder: Path) -> Path | None:
    """Return the file in the folder that has a module or its package; None if the module comes from elsewhere."""
    first = name.partition(".")[0]
    if first == "shmio":
        return None  # shmio's own models, such as shmio.simulation.loopback:Loopback
    files = (folder / f"{first}.py", folder / first / "__init__.py")
    return next((file.resolve() for file in files if file.is_file()), None)


def _origin(first: str) -> Path | None:
    """Return the file of the module that ``import first`` gives; None if it has no file."""
    try:
        spec = importlib.util.find_spec(first)
    except ValueError:  # a module without a spec, such as __main__
        return None
    return None if spec is None or not spec.has_location or spec.origin is None else Path(spec.origin).resolve()


def _import_file(name: str, file: Path, suffix: str) -> str:
    """Import the module or package in a file, and return its name.

    With a suffix, it gets a name that no installed module has, and the installed module of the same
    name stays what others import.
    """
    first, dot, rest = name.partition(".")
    own = f"{first}{suffix}"
    if getattr(sys.modules.get(own), "__file__", None) != str(file):
        package = [str(file.parent)] if file.name == "__init__.py" else None
        spec = importlib.util.spec_from_file_location(own, file, submodule_search_locations=package)
        if spec is None or spec.loader is None:
            raise ImportError(f"{file} is not a Python module")
        for old in [one for one in sys.modules if one == own or one.startswith(f"{own}.")]:
            del sys.modules[old]  # of another folder
        module = sys.modules[own] = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[own]
            raise
    return f"{own}{dot}{rest}"
