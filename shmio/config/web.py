"""Checks the sections ``[web]`` and ``[metrics]``, and makes their paths absolute."""

from __future__ import annotations

import importlib.util
from typing import Final

from shmio.config.address import Address
from shmio.config.model import ROLES, Config, Metrics, Web
from shmio.errors import ConfigError
from shmio.wording import PLAIN_REMEDY, plain_text, unknown

EXTRA: Final = "{}: the HTTP endpoint needs other libraries; run pip install 'shmio[web]'"
_LIBRARIES: Final = ("uvicorn", "starlette", "websockets", "prometheus_client")


def check_web(config: Config) -> None:
    """Check the addresses, plain-text access and roles in ``[web]`` and ``[metrics]``.

    Raises:
        ConfigError: A key breaks a rule, or contradicts another key.

    """
    for key, section in http_sections(config):
        if (section.certificate is None) != (section.key is None):
            raise ConfigError(f"{key}.certificate: give both certificate and key, or neither")
        try:
            address = Address.parse(section.listen)
        except ConfigError as error:
            raise ConfigError(f"{key}.listen: {error}") from None
        if not address.loopback and section.certificate is None and not section.insecure:
            raise ConfigError(f"{key}.listen: {plain_text(section.listen, PLAIN_REMEDY)}")
        _check_roles(key, section, address, config)


def http_sections(config: Config) -> list[tuple[str, Metrics]]:
    """Return (name, section) of each of the sections ``[metrics]`` and ``[web]`` that the configuration has."""
    return [(key, section) for key, section in (("metrics", config.metrics), ("web", config.web)) if section]


def _check_roles(key: str, section: Metrics, address: Address, config: Config) -> None:
    """Check the roles of clients without a token, and fill in their default."""
    offered = ROLES if isinstance(section, Web) else ("read",)
    guarded = section.token_file is not None or (config.grpc is not None and bool(config.grpc.token))
    if section.roles is None:
        if not guarded and not address.loopback and isinstance(section, Web):
            raise ConfigError(
                f"web.roles: other hosts can reach {section.listen}; give the roles of users who show no token, such "
                'as roles = ["read"], or add a [[grpc.token]]'
            )
        section.roles = [] if guarded else list(offered)
    for role in section.roles:
        if role not in offered:
            raise ConfigError(f"{key}.roles: {unknown('role', role, offered)}")
    if not section.roles and not guarded:
        what = "the page" if isinstance(section, Web) else "the figures"
        raise ConfigError(f"{key}.roles: nobody could use {what}; give a role, or add a [[grpc.token]]")


def resolve_web(config: Config) -> None:
    """Make the paths in ``[metrics]`` and ``[web]`` absolute."""
    for _, section in http_sections(config):
        for field in ("certificate", "key", "scene", "token_file"):
            if name := getattr(section, field, None):
                setattr(section, field, str(config.path(name)))


def check_library(section: str = "metrics") -> None:
    """Check that the libraries of the HTTP endpoint are installed.

    Args:
        section: Name of the section that needs them, for the message.

    Raises:
        ConfigError: A library is not installed.

    """
    if any(importlib.util.find_spec(name) is None for name in _LIBRARIES):
        raise ConfigError(EXTRA.format(section))
