"""Access control: tokens, certificates, and the roles of the listening addresses."""

from __future__ import annotations

import hmac
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Final, NamedTuple

import grpc

from shmio.audit.trail import Actor
from shmio.config import Address, Grpc, UnixAddress, parse_address
from shmio.config.credentials import Secret, digest, read_tokens
from shmio.config.listening import encrypted, takes_tokens
from shmio.config.model import ROLES, Client
from shmio.endpoints.grpc.server.connections import peer_of
from shmio.errors import ShmioError

READ: Final = "read"
WRITE: Final = "write"
INJECT: Final = "inject"
CONTROL: Final = "control"

_SERVICES: Final[Mapping[str, Mapping[str, str]]] = {
    "simulation.server.SimlogAPI": {
        READ: "GetTopic Subscribe",
        WRITE: "Publish",
        INJECT: "Inject",
        CONTROL: "setStepSize step",
    },
    "simlog.server.SimlogAPI": {
        READ: "GetTopicInfo CreateSubscriber Subscribe Read",
        WRITE: "Publish Write PublishSynch",
        INJECT: "Inject",
    },
    "shmio.v1.Shmio": {
        READ: "GetLayouts GetStatus Read Subscribe Events ListInjections WatchClock ListSnapshots",
        WRITE: "Write Simulate",
        INJECT: "Inject Declare Lift LiftAll",
        CONTROL: "Step Steps SetStepSize Play Pause Release Replay SaveSnapshot RestoreSnapshot DeleteSnapshot",
    },
    "com.ttsnetwork.simulator3.SimServerAPI": {
        READ: "subscribe",
        CONTROL: "step start stop pause",
    },
    "grpc.health.v1.Health": {READ: "Check Watch List"},
    "grpc.reflection.v1alpha.ServerReflection": {READ: "ServerReflectionInfo"},
}
"""The calls of each service, grouped by the role that they need."""


def _calls() -> Iterator[tuple[str, str]]:
    for service, roles in _SERVICES.items():
        for role, names in roles.items():
            for name in names.split():
                yield f"/{service}/{name}", role


NEEDS: Final[Mapping[str, str]] = dict(_calls())
"""The role that each call needs, by the call's full name."""

_ACTIONS: Final[Mapping[str, str]] = {
    "setStepSize": "step size",
    "SetStepSize": "step size",
    "Steps": "step",
    "start": "play",
    "stop": "pause",
    "LiftAll": "lift",
    "PublishSynch": "write",
    "Publish": "write",
}


def action_of(method: str) -> str:
    """Return the name that a call's action has in the audit log, from the call's full name."""
    if NEEDS.get(method) == READ:
        return "read"
    name = method.rpartition("/")[2]
    return _ACTIONS.get(name, name.lower())


_SCHEME: Final = "bearer "
_NAMES: Final = ("x509_common_name", "x509_subject_alternative_name")
_LOCAL: Final = ("unix:", "ipv4:127.", "ipv6:%5B::1%5D:", "ipv6:[::1]:")


class DeniedError(ShmioError):
    """The server refuses a call before the call has any effect. The message says what to do."""

    def __init__(self, code: grpc.StatusCode, message: str) -> None:
        super().__init__(message)
        self.code = code


class WrongTokenError(DeniedError):
    """The client shows a token that is not configured."""


class Credentials(NamedTuple):
    """A client's credentials: the hash of its token, and the names in its certificate."""

    token: bytes | None = None
    names: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, metadata: Iterable[tuple[str, str | bytes]], shown: Mapping[str, Iterable[bytes]] | None
    ) -> Credentials:
        """Read the credentials of a call.

        Args:
            metadata: The call's metadata.
            shown: The authentication context of the call's connection.

        """
        token = None
        for key, value in metadata:
            if key == "authorization":
                text = value if isinstance(value, str) else value.decode("latin-1")
                # A header of another scheme is hashed as a whole, and matches no token.
                bare = text[len(_SCHEME) :] if text.lower().startswith(_SCHEME) else text
                token = digest(bare.strip().encode())
        if not shown:
            return cls(token)
        names = [value.decode("utf-8", "replace") for key in _NAMES for value in shown.get(key, ())]
        return cls(token, tuple(name for name in dict.fromkeys(names) if name))


@dataclass(frozen=True, slots=True)
class Keys:
    """The configured tokens, and the configured patterns for names in certificates. A reload replaces the object."""

    secrets: Sequence[Secret] = ()
    clients: Sequence[Client] = ()

    @classmethod
    def of(cls, config: Grpc) -> Keys:
        """Read the tokens and patterns of a configuration.

        Raises:
            ConfigError: The file of a token is not usable.

        """
        return cls(read_tokens(config.token), tuple(config.client))

    def secret(self, shown: bytes) -> Secret | None:
        """Return the token with this hash; None if there is none.

        The duration of the search does not depend on the hash.
        """
        found = None
        for secret in self.secrets:
            if hmac.compare_digest(secret.digest, shown):
                found = secret
        return found

    def roles(self, names: Sequence[str]) -> frozenset[str]:
        """Return the roles of a certificate with these names."""
        return frozenset(
            role
            for client in self.clients
            for role in client.roles
            if any(fnmatchcase(name, pattern) for pattern in client.patterns for name in names)
        )


class ListenerAccess:
    """Decides which calls a client may make at one listening address.

    ``keys`` may be replaced at any time.
    """

    def __init__(self, keys: Keys, anonymous: Iterable[str] = ROLES, *, takes_tokens: bool = True) -> None:
        """Create the access rules of one address.

        Args:
            keys: The tokens and patterns.
            anonymous: Roles of clients without credentials.
            takes_tokens: Whether clients may send tokens to this address. They must not, if it is
                plain text.

        """
        self.keys = keys
        self.anonymous = frozenset(anonymous)
        self._takes_tokens = takes_tokens

    def admit(self, method: str, shown: Credentials) -> str | None:
        """Check whether a client may make a call.

        Args:
            method: The full name of the call.
            shown: The client's credentials.

        Returns:
            The name of the client's token; None if it has no configured token.

        Raises:
            DeniedError: The client may not make this call.

        """
        needed = NEEDS.get(method)
        if needed is None:
            raise DeniedError(grpc.StatusCode.PERMISSION_DENIED, f"{method}: no role allows this call")
        secret = None if shown.token is None else self._secret(shown.token)
        if needed in self.anonymous:
            return secret.name if secret else None
        by_name = self.keys.roles(shown.names)
        if needed in by_name or (secret is not None and needed in secret.roles):
            return secret.name if secret else None
        raise self._denial(method, needed, secret, shown, by_name)

    def actor(self, shown: Credentials, peer: str) -> Actor:
        """Return a client's identity for the audit log, even if its token is unknown or lacks a role."""
        secret = None if shown.token is None else self.keys.secret(shown.token)
        if secret is not None:
            return Actor("token", secret.name, peer)
        return Actor("certificate", shown.names[0], peer) if shown.names else Actor("anonymous", "", peer)

    def _secret(self, shown: bytes) -> Secret | None:
        if not self.keys.secrets:
            return None  # no tokens are configured
        if not self._takes_tokens:
            raise DeniedError(
                grpc.StatusCode.UNAUTHENTICATED,
                "this address is plain text, which others can read, so it accepts no tokens; use the address with TLS, "
                "and have this token replaced, because others may know it now",
            )
        secret = self.keys.secret(shown)
        if secret is None:
            raise WrongTokenError(
                grpc.StatusCode.UNAUTHENTICATED,
                "the token is not in [[grpc.token]]; send authorization: Bearer TOKEN with a token that is; after a "
                "change of a token's file, run shmio-supervisor reload",
            )
        return secret

    def _denial(
        self, method: str, needed: str, secret: Secret | None, shown: Credentials, by_name: frozenset[str]
    ) -> DeniedError:
        call = method.rpartition("/")[2]
        if secret is not None:
            who, roles, where = f"token {secret.name!r}", secret.roles | by_name, "its roles in [[grpc.token]]"
        elif by_name:
            who, roles, where = f"the certificate of {shown.names[0]!r}", by_name, "its roles in [[grpc.client]]"
        elif self._takes_tokens and self.keys.secrets:
            gives = f"gives {_listed(self.anonymous)}" if self.anonymous else "gives nothing"
            return DeniedError(
                grpc.StatusCode.UNAUTHENTICATED,
                f"{call} needs the role {needed}, and this address {gives} without a token; send "
                "authorization: Bearer TOKEN with a token of [[grpc.token]]",
            )
        elif shown.names:
            who, roles, where = f"the certificate of {shown.names[0]!r}", self.anonymous, "[[grpc.client]]"
        else:
            who, roles, where = "this address", self.anonymous, "the roles of the address in [[grpc.address]]"
        return DeniedError(
            grpc.StatusCode.PERMISSION_DENIED,
            f"{call} needs the role {needed}; {who} has {_listed(roles)}; add the role to {where}",
        )


def holder_of(
    peer: str, metadata: Iterable[tuple[str, str | bytes]], shown: Mapping[str, Iterable[bytes]] | None
) -> object:
    """Return the identity of a client, as the owner of the names that it chooses.

    The identity is the client's credentials or, without credentials, the client's host. All
    connections of a client therefore have equal identities, whatever their ports.
    """
    credentials = Credentials.of(metadata, shown)
    if credentials.token or credentials.names:
        return credentials
    address = peer_of(peer)
    if peer.startswith("unix:") or (address is not None and address[0].is_loopback):
        return "this host"
    return peer if address is None else address[0]


def host_of(peer: str) -> str:
    """Return the host of a client, without its port."""
    address = peer_of(peer)
    return peer if address is None else str(address[0])


def client_of(peer: str, token: str | None) -> str:
    """Return the name under which a client's calls count towards its limits.

    This is the name of the client's token. Without a token, it is the client's host; for a client
    on this host, it is the connection.
    """
    if token is not None:
        return f"token {token}"
    return peer if peer.startswith(_LOCAL) else peer.rpartition(":")[0]


def _listed(roles: Iterable[str]) -> str:
    return ", ".join(role for role in ROLES if role in roles) or "none"


class Listener(NamedTuple):
    """A listening address, its access rules, and whether it is encrypted."""

    address: Address | UnixAddress
    access: ListenerAccess
    encrypted: bool = False


class Listeners:
    """All listening addresses. They share the tokens and certificate patterns."""

    def __init__(self, config: Grpc) -> None:
        """Read the configuration.

        Raises:
            ConfigError: The file of a token is not usable.

        """
        keys = Keys.of(config)
        self._listeners = {
            key: Listener(
                parse_address(address.listen),
                ListenerAccess(keys, address.roles, takes_tokens=takes_tokens(config, address)),
                encrypted(config, address),
            )
            for key, address in config.listening.items()
        }

    @property
    def listeners(self) -> list[Listener]:
        """The listening addresses."""
        return list(self._listeners.values())

    def take(self, config: Grpc) -> None:
        """Adopt the tokens, clients and roles of a changed configuration.

        Raises:
            ConfigError: The file of a token is not usable. The previous settings remain in effect.

        """
        keys = Keys.of(config)
        for key, address in config.listening.items():
            if key in self._listeners:
                access = self._listeners[key].access
                access.keys, access.anonymous = keys, frozenset(address.roles)
