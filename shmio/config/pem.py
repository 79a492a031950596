"""Load PEM files by TLS itself, and explain errors."""

from __future__ import annotations

import ssl

from shmio.errors import ConfigError


def load_pair(context: ssl.SSLContext, certificate: str, key: str, where: str) -> None:
    """Load a certificate and its key into a context.

    Raises:
        ssl.SSLError: A file is unusable, or the key belongs to another certificate.
        ConfigError: The key needs a passphrase; the message begins with ``where``.

    """
    try:
        context.load_cert_chain(certificate, key, password=_refuse_to_ask)
    except _EncryptedError:
        raise ConfigError(f"{where}.key: {key}: needs a passphrase; use a key without one") from None


def load_authority(context: ssl.SSLContext, name: str, key: str) -> None:
    """Make a context trust the authorities in a file; ConfigError begins with ``key``."""
    try:
        context.load_verify_locations(name)
    except ssl.SSLError as error:
        raise ConfigError(f"{key}: {name}: no usable PEM certificate{detail(error)}") from None
    except OSError as error:
        raise ConfigError(f"{key}: {name}: {error.strerror}") from None


def detail(error: ssl.SSLError) -> str:
    """Return TLS's own reason in brackets, to append to a message, or an empty string."""
    return f" ({error.reason})" if error.reason else ""


class _EncryptedError(Exception):
    pass


def _refuse_to_ask() -> str:
    raise _EncryptedError
