"""Reads campaign files, which declare injections and what is expected of signals."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, field

from shmio.config.declaration import check_declarations
from shmio.config.expectation import expectation_faults
from shmio.config.faults import named
from shmio.config.model import Declaration, Expectation, Section
from shmio.config.read import check_text, convert, read_tables
from shmio.errors import ConfigError


class Campaign(Section):
    """The contents of a campaign file."""

    duration_s: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    injection: list[Declaration] = field(default_factory=list)
    expect: list[Expectation] = field(default_factory=list)


def load_campaign(file: Path) -> Campaign:
    """Read a campaign file with expectations.

    Raises:
        ConfigError: The file is invalid, or has no expectation; the message names the file, the key
            and the remedy.

    """
    return _read(file, "expect")


def read_campaign(file: Path) -> list[Declaration]:
    """Read the ``[[injection]]`` sections of a campaign file.

    Raises:
        ConfigError: The file is invalid; the message names the file, the key and the remedy.

    """
    return _read(file, "injection").injection


def parse_campaign(tables: dict[str, Any]) -> list[Declaration]:
    """Return the injections declared in a campaign's tables, such as ``{"injection": [{"name": …}]}``.

    Raises:
        ConfigError: A table is invalid; the message begins with its key.

    """
    return _parse(tables, "injection").injection


def _read(file: Path, needed: str) -> Campaign:
    tables = read_tables(file)
    try:
        return _parse(tables, needed)
    except ConfigError as error:
        raise ConfigError(f"{file}: {named(str(error), tables)}") from None


def _parse(tables: dict[str, Any], needed: str) -> Campaign:
    for key in ("injection", "expect"):
        if isinstance(tables.get(key), dict):
            raise ConfigError(f"{key}: write [[{key}]] with double brackets, because there can be several")
    check_text(tables, "")
    campaign = convert(tables, Campaign)
    if needed not in tables:
        raise ConfigError(f"{needed}: this key is needed")
    check_declarations(campaign.injection)
    for fault in expectation_faults(campaign.expect):
        raise ConfigError(fault)
    return campaign
