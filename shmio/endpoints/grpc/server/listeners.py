"""The endpoint's listening addresses and their access rules, which a reload may change."""

from __future__ import annotations

from typing import NamedTuple

from shmio.config import Address, Grpc, UnixAddress, parse_address
from shmio.config.listening import encrypted, takes_tokens
from shmio.endpoints.grpc.server.access import Keys, ListenerAccess


class Listener(NamedTuple):
    """A listening address and its access rules."""

    address: Address | UnixAddress
    access: ListenerAccess
    encrypted: bool = False


class Listeners:
    """All listening addresses; they share tokens and certificate patterns."""

    def __init__(self, config: Grpc) -> None:
        """Read the configuration. ConfigError: a token's file is not usable."""
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
        """Adopt new tokens, clients and roles. ConfigError: the old ones stay."""
        keys = Keys.of(config)
        for key, address in config.listening.items():
            if key in self._listeners:
                access = self._listeners[key].access
                access.keys, access.anonymous = keys, frozenset(address.roles)
