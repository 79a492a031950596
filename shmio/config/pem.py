"""PEM files, tried by TLS itself, and what is wrong with one in words."""

from __future__ import annotations

import ssl

from shmio.errors import ConfigError


def load_pair(context: ssl.SSLContext, certificate: str, key: str, where: str) -> None:
    """Have a context show this certificate.

    ssl.SSLError; ConfigError, beginning with ``where``: it needs a passphrase.
    """
    try:
        context.load_cert_chain(certificate, key, password=_refuse_to_ask)
    except _EncryptedError:
        raise ConfigError(f"{where}.key: {key}: needs a passphrase; give one that needs none") from None


def load_authority(context: ssl.SSLContext, name: str, key: str) -> None:
    """Have a context trust this one. ConfigError, with its key in front."""
    try:
        context.load_verify_locations(name)
    except ssl.SSLError as error:
        raise ConfigError(f"{key}: {name}: no usable PEM certificate{detail(error)}") from None
    except OSError as error:
        raise ConfigError(f"{key}: {name}: {error.strerror}") from None


def detail(error: ssl.SSLError) -> str:
    """What TLS says of it, to go behind what we say."""
    return f" ({error.reason})" if error.reason else ""


class _EncryptedError(Exception):
    pass


def _refuse_to_ask() -> str:
    raise _EncryptedError
