"""The endpoint's listening addresses, as they are configured, and again when that is read anew."""

from __future__ import annotations

from typing import NamedTuple

from shmio.config import Address, Grpc, UnixAddress, parse_address
from shmio.config.listening import encrypted, takes_tokens
from shmio.endpoints.grpc.server.access import Keys, ListenerAccess


class Listener(NamedTuple):
    """An address, and who may do what there."""

    address: Address | UnixAddress
    access: ListenerAccess
    encrypted: bool = False


class Listeners:
    """All of them, with the same keys."""

    def __init__(self, config: Grpc) -> None:
        """ConfigError: a token's file will not do."""
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
        """To listen on."""
        return list(self._listeners.values())

    def take(self, config: Grpc) -> None:
        """Take tokens, clients and roles as they are by now; ConfigError: they stay as they were."""
        keys = Keys.of(config)
        for key, address in config.listening.items():
            if key in self._listeners:
                access = self._listeners[key].access
                access.keys, access.anonymous = keys, frozenset(address.roles)
