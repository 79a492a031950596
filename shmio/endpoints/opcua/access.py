"""Access control: identifies clients by accounts and certificates, and gives them roles."""

from __future__ import annotations

import hmac
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.x509.oid import NameOID

from shmio.config.credentials import Secret, digest, read_tokens
from shmio.config.model import ROLES, OpcUa
from shmio.endpoints.opcua.certificates import read_certificates

MAX_PASSWORD = 1024


@dataclass(frozen=True)
class User:
    """An identified client.

    Attributes:
        name: Its account, a name in its certificate, or ``anonymous``.
        roles: The roles that it has.
        kind: How it has identified itself: ``account``, ``certificate`` or ``anonymous``.
    """

    name: str
    roles: frozenset[str]
    kind: str = "anonymous"


class Access:
    """Identifies clients, and decides which roles they have."""

    def __init__(self, config: OpcUa) -> None:
        """Read accounts and trusted certificates.

        Raises:
            ConfigError: A token file or a certificate file is unusable.

        """
        self._accounts: Sequence[Secret] = read_tokens(config.account, "opcua.account")
        self._clients = config.client
        self._trusted = [one for name in config.trusted for one in read_certificates("opcua.trusted", Path(name))]
        self.asks_certificates = bool(config.trusted)
        """True if a client needs a trusted certificate to open an encrypted channel."""
        guarded = bool(config.account or config.client)
        self.anonymous = frozenset(config.anonymous if config.anonymous is not None else () if guarded else ROLES)

    def identify(self, name: str | None, password: str | None, certificate: bytes | None) -> User | None:
        """Return the user with these credentials; None if they are wrong or give no role.

        Args:
            name: Name of the account; None if the client has no account.
            password: Password of the account; None if there is none.
            certificate: The certificate of the user or of the client, as DER; None if there is
                none.

        """
        roles = set(self.anonymous)
        who = kind = "anonymous"
        if name is not None:
            account = self._account(name, password or "")
            if account is None:
                return None
            who, kind, roles = account.name, "account", roles | account.roles
        if certificate is not None and (names := self._names(certificate)):
            found = {role for one in self._clients if _matches(one.patterns, names) for role in one.roles}
            if found:
                roles |= found
                who, kind = (names[0], "certificate") if name is None else (who, kind)
        return User(who, frozenset(roles), kind) if roles else None

    def _account(self, name: str, password: str) -> Secret | None:
        """Return the account with this name and password. The time that this takes depends on neither."""
        shown = digest(password[:MAX_PASSWORD].encode())
        found = None
        for account in self._accounts:
            if hmac.compare_digest(account.digest, shown) & (account.name == name):
                found = account
        return found

    def _names(self, certificate: bytes) -> list[str]:
        """Return the names in a trusted certificate; empty if it is not trusted."""
        if not self.trusts(certificate):
            return []
        shown = x509.load_der_x509_certificate(certificate)
        names = [str(one.value) for one in shown.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
        try:
            others = shown.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        except x509.ExtensionNotFound:
            return names
        for kind in (x509.DNSName, x509.UniformResourceIdentifier, x509.RFC822Name):
            names += others.get_values_for_type(kind)
        return [name for name in dict.fromkeys(names) if name]

    def trusts(self, certificate: bytes) -> bool:
        """Return whether a certificate is valid now, and is trusted or was issued by a trusted authority.

        ``certificate`` is in DER.
        """
        try:
            shown = x509.load_der_x509_certificate(certificate)
            now = datetime.now(UTC)
            if not shown.not_valid_before_utc <= now <= shown.not_valid_after_utc:
                return False
            return any(one == shown or _issued(one, shown, now) for one in self._trusted)
        except ValueError:
            return False


def _issued(issuer: x509.Certificate, shown: x509.Certificate, now: datetime) -> bool:
    """Return whether ``issuer`` is the presently valid certificate of an authority that issued ``shown``."""
    try:
        authority = issuer.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    except x509.ExtensionNotFound:
        return False
    if not authority or not issuer.not_valid_before_utc <= now <= issuer.not_valid_after_utc:
        return False
    try:
        shown.verify_directly_issued_by(issuer)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def _matches(patterns: Sequence[str], names: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns for name in names)
