"""Reads the client's certificate, and checks whether a server is trusted.

``trusted`` is a folder with certificates (PEM or DER) of servers, or of authorities that sign them.
The certificate of an unknown server is stored in the folder ``rejected`` beside it, so that the user
can check it and move it to ``trusted``.
"""

from __future__ import annotations

import contextlib
import hashlib
import ipaddress
import logging
import re
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import NameOID

from shmio.config.credentials import read_secret
from shmio.errors import ConfigError, ConnectorError
from shmio.wording import larger_than

MAX_FILE_BYTES: Final = 1 << 16
MAX_FILES: Final = 1000
MAX_REJECTED: Final = 100
_SUFFIXES: Final = frozenset({".der", ".cer", ".crt", ".pem"})
_MIN_KEY_BITS: Final = 2048

log = logging.getLogger("shmio.source")


def read_identity(certificate: Path, key: Path) -> tuple[x509.Certificate, rsa.RSAPrivateKey]:
    """Return the client's certificate and key.

    Raises:
        ConfigError: A file cannot be used, or the key does not belong to the certificate.

    """
    return _identity("", certificate, key, lambda: _read("key", key))


def read_user(certificate: Path, key: Path) -> tuple[x509.Certificate, rsa.RSAPrivateKey]:
    """Return the user's certificate and key. Only its owner may have access to the key's file.

    Raises:
        ConfigError: A file cannot be used, or the key does not belong to the certificate.

    """

    def read_key() -> bytes:
        data = read_secret(f"user_key: {key}", str(key), MAX_FILE_BYTES + 1, instead="a new key and certificate")
        if len(data) > MAX_FILE_BYTES:
            raise ConfigError(f"user_key: {key}: {larger_than(MAX_FILE_BYTES)}")
        return data

    return _identity("user_", certificate, key, read_key)


def _identity(
    prefix: str, certificate: Path, key: Path, read_key: Callable[[], bytes]
) -> tuple[x509.Certificate, rsa.RSAPrivateKey]:
    """Return a certificate and its key.

    Args:
        prefix: The beginning of the names of both keys in the configuration.
        certificate: The file of the certificate.
        key: The file of the key.
        read_key: Returns the contents of the latter. The certificate is read first, and its faults reported first.

    Raises:
        ConfigError: A file cannot be used, or the key does not belong to the certificate.

    """
    found = _certificates(_read(f"{prefix}certificate", certificate))
    if not found:
        raise ConfigError(f"{prefix}certificate: {certificate}: the file has no usable certificate in PEM or DER")
    data = read_key()
    load = serialization.load_pem_private_key if b"-----BEGIN" in data else serialization.load_der_private_key
    try:
        private = load(data, password=None)
    except (ValueError, TypeError):
        raise ConfigError(
            f"{prefix}key: {key}: the file has no usable private key; it must be PEM or DER and not protected by "
            "a password"
        ) from None
    if not isinstance(private, rsa.RSAPrivateKey) or private.key_size < _MIN_KEY_BITS:
        raise ConfigError(f"{prefix}key: {key}: the policies of OPC UA need an RSA key of {_MIN_KEY_BITS} bits or more")
    if private.public_key() != found[0].public_key():
        raise ConfigError(f"{prefix}key: {key}: this key does not belong to the certificate {certificate}")
    return found[0], private


def application_uri(certificate: x509.Certificate) -> str | None:
    """Return the application URI in a certificate, or None."""
    uris = _names(certificate, x509.UniformResourceIdentifier)
    return str(uris[0]) if uris else None


def check_server(data: bytes, trusted: Path, host: str) -> x509.Certificate:
    """Return the certificate of a server if it is trusted.

    Args:
        data: The certificate, or a chain that begins with it, in DER.
        trusted: Folder of trusted certificates.
        host: Name or address of the server in the URL. A certificate must name this host if only the
            authority that signed it is trusted.

    Raises:
        ConnectorError: The server is not trusted; the text says what to do.

    """
    size = 4 + int.from_bytes(data[2:4], "big")
    try:
        certificate = x509.load_der_x509_certificate(data[:size])
    except ValueError:
        raise ConnectorError("the server has no valid certificate") from None
    known = _folder(trusted)
    if certificate not in known:
        issuer = next((one for one in known if _has_signed(one, certificate)), None)
        if issuer is None:
            raise ConnectorError(_reject(certificate, data[:size], trusted))
        check_dates(issuer, "the authority of the server's certificate")
        if not _is_for(certificate, host):
            raise ConnectorError(
                f"the server's certificate is signed by a trusted authority, but is not for {host}; write a "
                "name of the certificate in url, or trust the certificate itself"
            )
    check_dates(certificate, "the server's certificate")
    return certificate


def _reject(certificate: x509.Certificate, data: bytes, trusted: Path) -> str:
    """Store a certificate in the folder ``rejected``; return the text of the error."""
    thumbprint = hashlib.sha1(data, usedforsecurity=False).hexdigest().upper()
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", str(names[0].value))[:60] if names else "server"
    rejected = trusted.with_name("rejected")
    file = rejected / f"{name} [{thumbprint}].der"
    text = f"the server's certificate is not trusted ({name}, SHA-1 {thumbprint})"
    try:
        rejected.mkdir(mode=0o755, exist_ok=True)
        if not file.exists():
            if sum(1 for _ in rejected.iterdir()) >= MAX_REJECTED:
                return f"{text}; it cannot be stored, because {rejected} has {MAX_REJECTED} files; delete old ones"
            file.write_bytes(data)
            # Log the text, too, because the returned text may be cut off where it is shown.
            log.warning("%s; to trust it, run mv '%s' '%s/'", text, file, trusted)
    except OSError as error:
        return f"{text}, and cannot be stored in {rejected}: {error.strerror}"
    return f"{text}; to trust it, run mv '{file}' '{trusted}/'"


def check_dates(certificate: x509.Certificate, what: str) -> None:
    """Raise ConnectorError if a certificate has expired or is not valid yet."""
    now = datetime.now(UTC)
    if now < certificate.not_valid_before_utc:
        raise ConnectorError(f"{what} is valid only from {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC on")
    if now > certificate.not_valid_after_utc:
        raise ConnectorError(f"{what} has expired on {certificate.not_valid_after_utc:%Y-%m-%d}; renew it")


def _folder(trusted: Path) -> list[x509.Certificate]:
    try:
        files = sorted(one for one in trusted.iterdir() if one.suffix.lower() in _SUFFIXES)[:MAX_FILES]
    except OSError as error:
        raise ConnectorError(f"the folder of trusted certificates {trusted}: {error.strerror}") from None
    found: list[x509.Certificate] = []
    for file in files:
        with contextlib.suppress(OSError):
            found += _certificates(file.read_bytes()[:MAX_FILE_BYTES])
    return found


def _certificates(data: bytes) -> list[x509.Certificate]:
    """Return the certificates in ``data`` (PEM or DER); an empty list if they are not valid."""
    try:
        if b"-----BEGIN" in data:
            return list(x509.load_pem_x509_certificates(data))
        return [x509.load_der_x509_certificate(data)]
    except ValueError:
        return []


def _has_signed(authority: x509.Certificate, certificate: x509.Certificate) -> bool:
    try:
        if not authority.extensions.get_extension_for_class(x509.BasicConstraints).value.ca:
            return False
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature, x509.ExtensionNotFound):
        return False
    return True


def _is_for(certificate: x509.Certificate, host: str) -> bool:
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host.lower() in {str(name).lower() for name in _names(certificate, x509.DNSName)}
    return address in _names(certificate, x509.IPAddress)


def _names(certificate: x509.Certificate, kind: type[x509.GeneralName]) -> list[object]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (ValueError, x509.ExtensionNotFound):
        return []
    return [name.value for name in names if isinstance(name, kind)]


def _read(key: str, file: Path) -> bytes:
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{key}: {file}: {error.strerror}") from None
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"{key}: {file}: {larger_than(MAX_FILE_BYTES)}")
    return data
