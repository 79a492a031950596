"""Rules of the section ``[metrics]``."""

from __future__ import annotations

import importlib.util
from typing import Final

from shmio.config.address import Address
from shmio.config.model import Config, Metrics
from shmio.errors import ConfigError

EXTRA: Final = "metrics: the HTTP endpoint needs other libraries: pip install 'shmio[web]'"


def check_metrics(config: Config) -> None:
    """Check the address, plain-text access and patterns.

    Raises:
        ConfigError: A rule is broken.

    """
    metrics = config.metrics
    if metrics is None:
        return
    if (metrics.certificate is None) != (metrics.key is None):
        raise ConfigError("metrics.certificate: give both certificate and key, or neither")
    try:
        address = Address.parse(metrics.listen)
    except ConfigError as error:
        raise ConfigError(f"metrics.listen: {error}") from None
    if not address.loopback and metrics.certificate is None and not metrics.insecure:
        raise ConfigError(
            f"metrics.listen: {metrics.listen} can be reached from other hosts in plain text; this requires "
            "certificate "
            "and key, or insecure = true beside it"
        )


def resolve_metrics(metrics: Metrics, config: Config) -> None:
    """Make the paths in the section absolute."""
    for field in ("certificate", "key"):
        if name := getattr(metrics, field):
            setattr(metrics, field, str(config.path(name)))


def check_library() -> None:
    """Check that the libraries of the HTTP endpoint are installed.

    Raises:
        ConfigError: One of them is not.

    """
    if any(importlib.util.find_spec(name) is None for name in ("uvicorn", "starlette", "prometheus_client")):
        raise ConfigError(EXTRA)
