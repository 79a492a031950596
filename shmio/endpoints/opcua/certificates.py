"""Reads the files of certificates and keys that the section ``[opcua]`` names."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa

from shmio.config import OpcUa
from shmio.errors import ConfigError
from shmio.wording import larger_than

MAX_PEM_BYTES: Final = 1 << 20
MIN_KEY_BITS: Final = 2048


def read_certificates(key: str, file: Path) -> list[x509.Certificate]:
    """Return the certificates in a PEM or DER file.

    Args:
        key: The configuration's key that names the file, for errors.
        file: The file.

    Raises:
        ConfigError: The file is unusable.
    """
    data = _read(key, file)
    try:
        if b"-----BEGIN" in data:
            return list(x509.load_pem_x509_certificates(data))
        return [x509.load_der_x509_certificate(data)]
    except ValueError:
        raise ConfigError(f"{key}: {file}: the file has no usable certificate in PEM or DER") from None


def read_identity(opcua: OpcUa) -> tuple[x509.Certificate, rsa.RSAPrivateKey] | None:
    """Return the server's certificate and key; None if none are configured.

    Raises:
        ConfigError: A file is unusable, or the key does not belong to the certificate.

    """
    if opcua.certificate is None or opcua.key is None:
        return None
    certificate = read_certificates("opcua.certificate", Path(opcua.certificate))[0]
    data = _read("opcua.key", Path(opcua.key))
    try:
        load = serialization.load_pem_private_key if b"-----BEGIN" in data else serialization.load_der_private_key
        key = load(data, password=None)
    except (ValueError, TypeError):
        raise ConfigError(
            f"opcua.key: {opcua.key}: the file has no usable private key; it must be PEM or DER and not protected by "
            "a password"
        ) from None
    if not isinstance(key, rsa.RSAPrivateKey) or key.key_size < MIN_KEY_BITS:
        raise ConfigError(
            f"opcua.key: {opcua.key}: the policies of OPC UA need an RSA key of {MIN_KEY_BITS} bits or more"
        )
    if key.public_key() != certificate.public_key():
        raise ConfigError(f"opcua.key: {opcua.key}: this key does not belong to opcua.certificate")
    return certificate, key


def application_uri(certificate: x509.Certificate) -> str | None:
    """Return the application URI in a certificate; None if there is none."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return None
    found = names.get_values_for_type(x509.UniformResourceIdentifier)
    return found[0] if found else None


def _read(key: str, file: Path) -> bytes:
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_PEM_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{key}: {file}: {error.strerror}") from None
    if len(data) > MAX_PEM_BYTES:
        raise ConfigError(f"{key}: {file}: {larger_than(MAX_PEM_BYTES)}")
    return data
