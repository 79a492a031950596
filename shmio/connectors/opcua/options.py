"""The keys of a source with ``connector = "opcua"``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal
from urllib.parse import urlsplit

import msgspec

from shmio.config import Address

DEFAULT_PORT: Final = 4840
_Count = Annotated[int, msgspec.Meta(ge=1, le=100_000)]


class OpcUaOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Address of the server, and how to read from it.

    Raises:
        ValueError: The URL is wrong, or keys contradict each other.
    """

    url: Annotated[str, msgspec.Meta(min_length=1, max_length=1000)]
    timeout: Annotated[int, msgspec.Meta(ge=10, le=600_000)] = 4000
    """Time-out in ms for each answer, and maximum time in ms for which the server may be silent."""
    mode: Literal["subscribe", "poll"] = "subscribe"
    nodes: Literal["addresses", "siemens"] = "addresses"
    """The origin of node ids: the addresses in the layout, or the names in an S7-1500's data block."""
    sampling_ms: Annotated[int, msgspec.Meta(ge=-1, le=3_600_000)] = 50
    """Interval in ms at which the server samples a node. 0: the fastest it can; -1: the publishing interval."""
    publishing_ms: Annotated[int, msgspec.Meta(ge=1, le=3_600_000)] = 100
    queue: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 1
    """Maximum number of samples of a node that the server keeps between two publications."""
    max_items: _Count = 1000
    """Maximum number of nodes in a subscription."""
    session_items: _Count = 10_000
    """Maximum number of nodes in a session."""
    security: Literal["None", "Sign", "SignAndEncrypt"] = "None"
    policy: Literal["Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss"] = "Basic256Sha256"
    certificate: str | None = None
    key: str | None = None
    trusted: str | None = None
    """Folder of trusted certificates."""
    username: Annotated[str, msgspec.Meta(min_length=1, max_length=256)] | None = None
    password_file: str | None = None
    user_certificate: str | None = None
    """File of the certificate with which the user logs in."""
    user_key: str | None = None
    insecure: bool = False
    """True to allow sending a password to another host over an unencrypted channel."""

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        try:
            port = parts.port
        except ValueError:
            port = 0
        if parts.scheme != "opc.tcp" or not parts.hostname or port == 0 or "@" in parts.netloc:
            raise ValueError(f"url: expected opc.tcp://HOST:PORT, without a user, found {self.url!r}")
        secured = self.security != "None"
        for name in ("certificate", "key", "trusted"):
            if secured and getattr(self, name) is None:
                raise ValueError(f"{name}: this key is needed with security = {self.security!r}")
            if not secured and getattr(self, name) is not None:
                raise ValueError(f'{name}: this key has no effect without security = "SignAndEncrypt" or "Sign"')
        if (self.user_certificate is None) != (self.user_key is None):
            raise ValueError("user_certificate: give both user_certificate and user_key, or neither")
        if self.user_certificate is not None and self.username is not None:
            raise ValueError("user_certificate: the user has either a certificate or a password; remove one of them")
        if self.user_certificate is not None and not secured:
            raise ValueError(
                "user_certificate: the server can check it only with security = 'SignAndEncrypt' or 'Sign'"
            )
        if (self.username is None) != (self.password_file is None):
            raise ValueError("username: give both username and password_file, or neither")
        if self.username and self.security != "SignAndEncrypt" and not self.address.loopback and not self.insecure:
            raise ValueError(
                "username: shmio would send the password over the network without encryption; set security = "
                "'SignAndEncrypt', or write insecure = true in the same section"
            )

    @property
    def address(self) -> Address:
        """Host and port of the server."""
        parts = urlsplit(self.url)
        return Address(parts.hostname or "", parts.port or DEFAULT_PORT)

    @property
    def full_url(self) -> str:
        """The URL with its port."""
        parts = urlsplit(self.url)
        return self.url if parts.port else parts._replace(netloc=f"{parts.netloc}:{DEFAULT_PORT}").geturl()

    @property
    def peer(self) -> str:
        """``host:port`` for messages."""
        return str(self.address)


@dataclass(frozen=True)
class Credentials:
    """Certificates and password of a client.

    Attributes:
        application_uri: The client's URI, which is also in its certificate.
        identity: The client's certificate and private key, as objects of the library cryptography;
            None without security.
        password: The user's password; empty if there is none.
        user: The user's certificate and private key; None if the user has no certificate.

    """

    application_uri: str = "urn:shmio:client"
    identity: tuple[Any, Any] | None = None
    password: str = ""
    user: tuple[Any, Any] | None = None
