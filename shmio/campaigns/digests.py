"""Computes digests of what a run depends on: its campaign, configuration, models and layouts."""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

from shmio.config import Expectation, load
from shmio.errors import ConfigError
from shmio.layout.model import Layout
from shmio.simulation.fmu import is_fmu

MAX_BYTES: Final = 64 << 20
"""Maximum size in bytes of a file that gets a digest."""


def of_file(file: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal, or a text that says why there is none."""
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except OSError as error:
        return f"not readable: {error.strerror}"
    return hashlib.sha256(data).hexdigest() if len(data) <= MAX_BYTES else f"larger than {MAX_BYTES} bytes"


def of_campaign(file: Path, expectations: Iterable[Expectation]) -> Iterator[tuple[str, str]]:
    """Yield a label and a text with the digest: for a campaign file, and for each recording that it names."""
    yield "campaign", f"{file}, sha256 {of_file(file)}"
    for name in dict.fromkeys(one.like for one in expectations if one.like is not None):
        yield "like", f"{name}, sha256 {of_file(file.parent / name)}"


def of_layouts(layouts: Mapping[str, Layout]) -> Iterator[tuple[str, str]]:
    """Yield a label and the digest for the layout of each source."""
    for source, layout in layouts.items():
        yield f"layout of {source}", layout.hash.hex()


def of_configuration(file: Path) -> Iterator[tuple[str, str]]:
    """Yield a label and a text with the digest: for a ``supervisor.toml``, and for the file of each model in it."""
    yield "configuration", f"{file}, sha256 {of_file(file)}"
    try:
        sources = load(file).source
    except ConfigError:  # it was changed since the instance was started
        return
    for source in sources:
        model = source.options.get("model")
        if isinstance(model, str):
            found = _file_of(model, file.resolve().parent)
            yield f"model of {source.name}", model if found is None else f"{model}, sha256 {of_file(found)}"


def _file_of(model: str, folder: Path) -> Path | None:
    """Return the file of a model, an FMU or a Python module; None if no module is found."""
    return folder / model if is_fmu(model) else _module(model.partition(":")[0], folder)


def _module(name: str, folder: Path) -> Path | None:
    """Return the file of a Python module, without importing the module; None if there is none."""
    parts = name.split(".")
    if not all(part.isidentifier() for part in parts):
        return None
    roots = [folder]
    spec = importlib.util.find_spec(parts[0])
    if spec is not None and spec.origin is not None:
        roots.append(
            Path(spec.origin).parent if spec.submodule_search_locations is None else Path(spec.origin).parent.parent
        )
    for root in roots:
        place = root.joinpath(*parts)
        for file in (place.with_suffix(".py"), place / "__init__.py"):
            if file.is_file():
                return file
    return None
