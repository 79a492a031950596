"""Campaigns: files of declared injections for ``shmio inject --file``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from shmio.config.declaration import check_declarations
from shmio.config.faults import named
from shmio.config.model import Declaration, Section
from shmio.config.read import check_text, convert, read_tables
from shmio.errors import ConfigError


class Campaign(Section):
    """The contents of a campaign file."""

    injection: list[Declaration]


def read_campaign(file: Path) -> list[Declaration]:
    """Read the ``[[injection]]`` sections of a campaign file.

    Raises:
        ConfigError: The file is invalid; the message names the file, the key and the remedy.

    """
    tables = read_tables(file)
    try:
        return parse_campaign(tables)
    except ConfigError as error:
        raise ConfigError(f"{file}: {named(str(error), tables)}") from None


def parse_campaign(tables: dict[str, Any]) -> list[Declaration]:
    """Return the declarations in a campaign's tables, such as ``{"injection": [{"name": …}]}``.

    Raises:
        ConfigError: A table is invalid; the message begins with its key.

    """
    if isinstance(tables.get("injection"), dict):
        raise ConfigError("injection: write [[injection]] with double brackets, because there can be several")
    check_text(tables, "")
    campaign = convert(tables, Campaign)
    check_declarations(campaign.injection)
    return campaign.injection
