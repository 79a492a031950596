from __future__ import annotations

import socket

import pytest

from shmio.testing.ports import reserved_port


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_a_reserved_port_refuses_until_a_server_listens(host: str) -> None:
    with reserved_port(host) as address:
        place = (address.host, address.port)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(place)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.create_server(place, family=family) as server, socket.create_connection(place) as client:
            peer, _ = server.accept()
            with peer:
                client.sendall(b"x")
                assert peer.recv(1) == b"x"


def test_two_reserved_ports_differ() -> None:
    with reserved_port() as first, reserved_port() as second:
        assert first != second
