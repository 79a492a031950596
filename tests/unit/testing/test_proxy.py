"""Each fault that the fault proxy can cause, as a plain socket sees it."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import pytest

from shmio.config.address import Address
from shmio.testing.ports import reserved_port
from shmio.testing.proxy import FaultProxy


def frame(payload: bytes) -> bytes:
    return b"\x03\x00" + (4 + len(payload)).to_bytes(2, "big") + payload


@pytest.fixture
def server() -> Iterator[Address]:
    """Run a server that sends back what it receives."""
    listener = socket.create_server(("127.0.0.1", 0))
    threads: list[threading.Thread] = []

    def echo(peer: socket.socket) -> None:
        with peer:
            try:
                while data := peer.recv(1 << 16):
                    peer.sendall(data)
            except ConnectionError:
                pass

    def serve() -> None:
        while True:
            try:
                peer, _ = listener.accept()
            except OSError:
                return
            threads.append(threading.Thread(target=echo, args=(peer,), name="echo"))
            threads[-1].start()

    accepting = threading.Thread(target=serve)
    accepting.start()
    yield Address(*listener.getsockname())
    listener.shutdown(socket.SHUT_RDWR)
    accepting.join()
    listener.close()
    for thread in threads:
        thread.join()


@pytest.fixture
def proxy(server: Address) -> Iterator[FaultProxy]:
    with FaultProxy(server) as proxy:
        yield proxy


def connect(proxy: FaultProxy) -> socket.socket:
    return socket.create_connection((proxy.address.host, proxy.address.port), timeout=10)


def receive(client: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := client.recv(size - len(data))):
        data += more
    return data


def assert_echo(client: socket.socket, data: bytes = b"hello") -> None:
    client.sendall(data)
    assert receive(client, len(data)) == data


def test_relays_to_several_clients(proxy: FaultProxy) -> None:
    with connect(proxy) as first, connect(proxy) as second:
        assert_echo(first)
        assert_echo(second)
        assert proxy.accepted == 2


def test_relays_much_more_than_any_buffer(proxy: FaultProxy) -> None:
    data = bytes(range(256)) * 80_000
    with connect(proxy) as client:
        sender = threading.Thread(target=client.sendall, args=(data,))
        sender.start()
        assert receive(client, len(data)) == data
        sender.join()


def test_passes_on_the_end_of_a_stream_after_its_data(proxy: FaultProxy) -> None:
    proxy.delay(0.02, 0.02)
    with connect(proxy) as client:
        client.sendall(b"last words")
        client.shutdown(socket.SHUT_WR)
        assert receive(client, 100) == b"last words"


def test_delays_both_ways_without_limiting_throughput(proxy: FaultProxy) -> None:
    proxy.delay(0.1, 0.15)
    with connect(proxy) as client:
        begun_s = time.monotonic()
        for number in range(200):
            client.sendall(frame(bytes([number])))
        assert receive(client, 1000)[4::5] == bytes(range(200))
        taken_s = time.monotonic() - begun_s
    assert taken_s >= 0.25
    # In sequence they would take 50 s, longer than the time-out of the test.


def test_a_shorter_delay_does_not_reorder_data(proxy: FaultProxy) -> None:
    with connect(proxy) as client:
        proxy.delay(0.2, 0.0)
        client.sendall(b"first")
        assert proxy.accepted == 1
        proxy.delay(0.0, 0.0)
        client.sendall(b"second")
        assert receive(client, 11) == b"firstsecond"


def test_cut(proxy: FaultProxy) -> None:
    with connect(proxy) as client:
        assert_echo(client)
        proxy.cut()
        assert client.recv(1) == b""
    with connect(proxy) as client:
        assert_echo(client)


def test_cut_by_reset(proxy: FaultProxy) -> None:
    with connect(proxy) as client:
        assert_echo(client)
        proxy.cut(reset=True)
        with pytest.raises(ConnectionResetError):
            client.recv(1)


def test_cut_after_some_bytes(proxy: FaultProxy) -> None:
    with connect(proxy) as client:
        proxy.cut_after(7)
        assert_echo(client)
        client.sendall(b"more")
        assert receive(client, 100) == b"mo"
    with connect(proxy) as client:
        assert_echo(client)


def test_freeze_holds_old_and_new_connections(proxy: FaultProxy) -> None:
    with connect(proxy) as old:
        assert_echo(old)
        proxy.freeze()
        with connect(proxy) as new:
            for client in (old, new):
                client.sendall(b"hello")
                client.settimeout(0.05)
                with pytest.raises(TimeoutError):
                    client.recv(1)
            proxy.thaw()
            for client in (old, new):
                client.settimeout(10)
                assert receive(client, 5) == b"hello"


def test_refuse_and_admit_on_the_same_port(proxy: FaultProxy) -> None:
    with connect(proxy) as client:
        assert_echo(client)
        proxy.refuse()
        with pytest.raises(ConnectionResetError):
            client.recv(1)
    for _ in range(2):
        with pytest.raises(ConnectionRefusedError):
            connect(proxy)
        proxy.refuse()
    proxy.admit()
    proxy.admit()
    with connect(proxy) as client:
        assert_echo(client)


def test_a_server_that_is_absent_closes_the_client() -> None:
    with reserved_port() as nobody, FaultProxy(nobody) as proxy, connect(proxy) as client:
        assert client.recv(1) == b""


def test_garble_replaces_one_frame(proxy: FaultProxy) -> None:
    with connect(proxy) as client:
        proxy.garble(b"?!")
        client.sendall(frame(b"one") + frame(b"two"))
        assert receive(client, 9) == b"?!" + frame(b"two")


def test_edit_sees_whole_frames_whatever_the_pieces(proxy: FaultProxy) -> None:
    seen: list[bytes] = []

    def keep_odd(data: bytes) -> bytes | None:
        seen.append(data)
        return data if data[4] % 2 else None

    frames = [frame(bytes([number]) * 50) for number in range(6)]
    stream = b"".join(frames)
    with connect(proxy) as client:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        proxy.edit(keep_odd)
        for at in range(0, len(stream), 17):
            client.sendall(stream[at : at + 17])
        assert receive(client, 3 * 54) == b"".join(frames[1::2])
    assert seen == frames


def test_rewrite_reference(proxy: FaultProxy) -> None:
    with connect(proxy) as client:
        proxy.rewrite_reference(lambda reference: reference + 1, frames=1)
        data = frame(bytes(7) + b"\xff\xff" + bytes(4))
        client.sendall(data * 2)
        assert receive(client, 2 * len(data)) == frame(bytes(13)) + data


def test_hold_and_release_to_the_newest_connection(proxy: FaultProxy) -> None:
    with connect(proxy) as old:
        proxy.hold(frames=1)
        old.sendall(frame(b"late"))
        assert proxy.wait_held()
        assert_echo(old)
        with connect(proxy) as new:
            assert_echo(new)
            proxy.release()
            assert receive(new, 8) == frame(b"late")
            assert_echo(old)


def test_pass_all_ends_faults(proxy: FaultProxy) -> None:
    proxy.garble(b"never seen")
    proxy.cut_after(3)
    proxy.refuse()
    proxy.freeze()
    proxy.pass_all()
    with connect(proxy) as client:
        assert_echo(client)
    assert not proxy.wait_held(0)


def test_without_framing_each_piece_is_a_frame(server: Address) -> None:
    with FaultProxy(server, framing=None) as proxy, connect(proxy) as client:
        proxy.edit(bytes.upper)
        client.sendall(b"plain text")
        assert receive(client, 10) == b"PLAIN TEXT"


def test_stop_ends_everything(server: Address) -> None:
    before = set(threading.enumerate())
    proxy = FaultProxy(server)
    with connect(proxy) as client:
        assert_echo(client)
        proxy.stop()
        proxy.stop()
        assert client.recv(1) == b""
    with pytest.raises(ConnectionRefusedError):
        connect(proxy)
    assert not [thread for thread in set(threading.enumerate()) - before if thread.name != "echo"]
