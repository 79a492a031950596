"""The server over real sockets; the client of python-snap7 is the independent peer."""

from __future__ import annotations

import contextlib
import random
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest
import snap7
from snap7.type import Area, WordLen

from shmio.config.address import Address
from shmio.connectors.s7 import S7Client, S7Options
from shmio.emulators.s7 import S7Server
from shmio.errors import ConfigError, ConnectorError, EndpointError, ShmioError
from shmio.testing.ports import reserved_port

LOOPBACK = Address("127.0.0.1", 0)


@pytest.fixture
def block() -> bytearray:
    return bytearray(i & 0xFF for i in range(1500))


@pytest.fixture
def server(block: bytearray) -> Iterator[S7Server]:
    before = set(threading.enumerate())
    with S7Server(LOOPBACK, max_clients=4) as server:
        server.add_block(5, block)
        server.start()
        yield server
    assert set(threading.enumerate()) <= before  # a clean stop leaves no thread


@pytest.fixture
def client(server: S7Server) -> Iterator[snap7.Client]:
    client = snap7.Client()
    client.connect(server.address.host, 0, 1, server.address.port)
    yield client
    client.disconnect()
    client.destroy()


def ours(server: S7Server, size: int = 1500) -> S7Client:
    return S7Client(S7Options(host=server.address.host, port=server.address.port), 5, size)


def test_another_client_reads(client: snap7.Client, block: bytearray) -> None:
    assert client.db_read(5, 0, 1500) == block
    assert client.db_read(5, 1499, 1) == block[1499:]


def test_another_client_writes(client: snap7.Client, block: bytearray) -> None:
    client.db_write(5, 100, bytearray(b"hello"))
    assert block[98:107] == bytes((98, 99)) + b"hello" + bytes((105, 106))


def test_another_client_writes_a_bit(client: snap7.Client, block: bytearray) -> None:
    block[7] = 0b1010_0101
    client.write_area(Area.DB, 5, 7 * 8 + 1, bytearray(b"\x01"), WordLen.Bit)
    assert block[7] == 0b1010_0111
    client.write_area(Area.DB, 5, 7 * 8 + 7, bytearray(b"\x00"), WordLen.Bit)
    assert block[7] == 0b0010_0111


def test_a_write_past_the_end_stores_nothing(client: snap7.Client, block: bytearray) -> None:
    before = bytes(block)
    with pytest.raises(Exception, match="0x05"):
        client.db_write(5, 1498, bytearray(b"four"))
    assert block == before


def test_another_client_asks_for_status(client: snap7.Client) -> None:
    assert client.get_cpu_info().ModuleTypeName
    assert client.list_blocks().DBCount == 1


def test_block_transfer_is_refused(client: snap7.Client, block: bytearray) -> None:
    before = bytes(block)
    with pytest.raises(Exception, match=r"class=0x81, code=0x04"):
        client.upload(5)
    assert block == before


def test_answers_while_stopped(client: snap7.Client, server: S7Server, block: bytearray) -> None:
    client.plc_stop()
    assert server.get_status()[1] == "Stop"
    assert client.db_read(5, 0, 4) == block[:4]
    client.plc_hot_start()
    assert server.get_status()[1] == "Run"


def test_only_a_start_command_starts_the_cpu(client: snap7.Client, server: S7Server) -> None:
    client.plc_stop()
    client.compress(1000)
    client.copy_ram_to_rom(1000)
    delete = bytes.fromhex("0300002c 02f080 32 01 0000 0001 001b 0000 28 00000000000000fd 000a 01003042303030303541 05")
    with socket.create_connection(tuple_of(server)) as peer, peer.makefile("rb") as stream:
        peer.settimeout(10)
        peer.sendall(SESSION + delete + b"_DELE")
        stream.read(22)
        assert stream.read(19)[-2:] == b"\x81\x04"
    assert server.get_status()[1] == "Stop"
    client.plc_cold_start()
    assert server.get_status()[1] == "Run"


@pytest.mark.parametrize(
    ("parameters", "data"),
    [
        (b"\x00\x00\x05_DELE", b"_MODU"),
        (b"\x00\x05_MODU\x05_DELE", b""),
        (b"\x00\x09P_PROGRAM\x05_MODU", b""),  # python-snap7's server would start
        (b"\x00\x00\x04_MODU", b""),
        (b"\x00\x00\x09_MODU", b""),
        (b"\xff\xff\x05_MODU", b""),
    ],
    ids=["in the data", "in the argument", "a second one", "too short", "too long", "beyond the end"],
)
def test_service_name_elsewhere_in_the_job_is_ignored(
    client: snap7.Client, server: S7Server, parameters: bytes, data: bytes
) -> None:
    client.plc_stop()
    block = bytes.fromhex("28 000000000000fd") + parameters
    job = bytes.fromhex("32 01 0000 0001") + len(block).to_bytes(2, "big") + len(data).to_bytes(2, "big") + block + data
    with socket.create_connection(tuple_of(server)) as peer, peer.makefile("rb") as stream:
        peer.settimeout(10)
        peer.sendall(SESSION + b"\x03\x00" + (len(job) + 7).to_bytes(2, "big") + b"\x02\xf0\x80" + job)
        stream.read(22)
        assert stream.read(19)[-2:] == b"\x81\x04"
    assert server.get_status()[1] == "Stop"


def test_operating_mode_is_reported(client: snap7.Client) -> None:
    """The mode is the fourth byte in the only record of SZL 0x0424; Snap7 takes all but 8 for STOP."""

    def mode() -> int:
        data = bytes(client.read_szl(0x0424).Data)
        assert data[:4] == bytes.fromhex("0014 0001")  # size and number of the records
        assert data[24:] == bytes(len(data) - 24)
        return data[7]

    assert mode() == 0x08
    client.plc_stop()
    assert mode() == 0x04
    client.plc_hot_start()
    assert mode() == 0x08
    client.plc_stop()
    client.plc_cold_start()
    assert mode() == 0x08


def test_python_snap7_sees_the_operating_mode(client: snap7.Client) -> None:
    """python-snap7 takes any acknowledgement of its query for RUN."""
    assert client.get_cpu_state() == "S7CpuStatusRun"
    client.plc_stop()
    with pytest.raises(Exception, match="code=0x04"):
        client.get_cpu_state()
    client.plc_hot_start()
    assert client.get_cpu_state() == "S7CpuStatusRun"


def test_an_unknown_system_status_list(client: snap7.Client) -> None:
    with pytest.raises(Exception, match=r"0xd402"):
        client.read_szl(0x0999)


def test_the_address_is_exclusive(server: S7Server) -> None:
    second = S7Server(server.address)
    with pytest.raises(EndpointError, match=rf"^cannot listen on {server.address}: .*another program"):
        second.start()
    assert second.stop() == 0


def test_an_address_of_another_machine() -> None:
    with pytest.raises(EndpointError, match=r"^cannot listen on 192\.0\.2\.1:4102: "):
        S7Server(Address("192.0.2.1", 4102)).start()


def test_address_can_be_reused_at_once() -> None:
    with reserved_port() as address:
        for _ in range(2):
            with S7Server(address) as server:
                server.add_block(5, bytearray(4))
                server.start()
                with closing(ours(server, 4)) as client:  # leaves a connection in TIME_WAIT
                    client.connect()
                    assert client.read() == bytes(4)
                    assert server.stop() == 0


def test_server_starts_only_once() -> None:
    with S7Server(LOOPBACK) as server:
        with pytest.raises(ShmioError, match="not started"):
            _ = server.address
        server.start()
        with pytest.raises(ShmioError, match="once"):
            server.start()


def test_duplicate_or_invalid_block_number_is_refused() -> None:
    server = S7Server(LOOPBACK)
    server.add_block(1, bytearray(1))
    for number in (1, 0, 65536):
        with pytest.raises(ConfigError, match=f"^DB{number}"):
            server.add_block(number, bytearray(1))


def test_number_of_clients_is_limited(server: S7Server, block: bytearray) -> None:
    with ExitStack() as stack:
        clients = [stack.enter_context(closing(ours(server))) for _ in range(5)]
        for client in clients[:4]:
            client.connect()
        with pytest.raises(ConnectorError, match="closed the connection"):
            clients[4].connect()
        assert [client.read() for client in clients[:4]] == [block] * 4


def test_clients_that_never_set_up_communication_make_room(server: S7Server, block: bytearray) -> None:
    with ExitStack() as stack:
        working = stack.enter_context(closing(ours(server)))
        working.connect()
        silent = [stack.enter_context(socket.create_connection(tuple_of(server))) for _ in range(3)]
        for peer in silent:
            peer.settimeout(10)
            peer.sendall(SESSION)
            assert peer.recv(100)[5] == 0xD0  # connected, as a real CPU confirms it
        other = stack.enter_context(closing(ours(server)))
        other.connect()
        assert silent[0].recv(1) == b""  # the oldest
        assert working.read() == other.read() == block
        silent[2].sendall(SETUP)
        assert silent[2].recv(100)


def test_stop_ends_clients_in_every_state(server: S7Server) -> None:
    with closing(ours(server)) as client, socket.create_connection(tuple_of(server)) as silent:
        client.connect()
        silent.settimeout(10)
        server.stop()
        with pytest.raises(ConnectorError, match="closed the connection"):
            client.read()
        assert silent.recv(1) == b""


def tuple_of(server: S7Server) -> tuple[str, int]:
    return server.address.host, server.address.port


SESSION = bytes.fromhex("0300001611e00000000100c1020100c2020101c0010a")
SETUP = bytes.fromhex("03000019 02f080 32 01 0000 0001 0008 0000 f0 00 0008 0008 03c0")


@pytest.mark.parametrize(
    "noise",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        bytes(5000),
        b"\x03\x00\x00\x03",
        SESSION + bytes(5000),
        SESSION + b"\x03\x00\x00\x10" + bytes(12),
        SESSION + b"\x03\x00\xff\xff" + bytes(9000),
        SESSION + b"\x03\x00\x03\xc7\x02\xf0\x00" + bytes(960) + b"\x03\x00\x00\x08\x02\xf0\x80\x00",
        SESSION + b"\x03\x00\x00\x11\x02\xf0\x80\x32\x03" + bytes(8),
        SESSION + b"\x03\x00\x00\x19\x02\xf0\x80\x32\x07" + b"\xff" * 16,
        SESSION + bytes.fromhex("03000019 02f080 72 01 0000 0001 0008 0000 f0 00 0008 0008 03c0"),
    ],
)
def test_garbage_ends_only_its_own_connection(server: S7Server, block: bytearray, noise: bytes) -> None:
    with closing(ours(server)) as client, socket.create_connection(tuple_of(server)) as peer:
        client.connect()
        peer.settimeout(10)
        received = b""
        with contextlib.suppress(ConnectionError):  # the server may close before all is sent
            peer.sendall(noise)
            with contextlib.suppress(OSError):  # no longer connected
                peer.shutdown(socket.SHUT_WR)
            while data := peer.recv(4096):
                received += data
        assert len(received) < 200
        assert client.read() == block


JOBS = [
    bytes.fromhex("32 07 0000 0001 0008 0008 00 01 12 04 11 44 01 00 ff 09 0004 0424 0000"),
    bytes.fromhex("32 07 0000 0001 0008 0004 00 01 12 04 11 43 01 00 0a 00 0000"),
    bytes.fromhex("32 01 0000 0001 0010 0000 29 0000000000 09") + b"P_PROGRAM",
    bytes.fromhex("32 01 0000 0001 0014 0000 28 00000000000000fd 0000 09") + b"P_PROGRAM",
]


def test_noise_in_control_and_status_jobs_ends_at_most_its_own_connection(server: S7Server, block: bytearray) -> None:
    noise = random.Random(4)
    before = bytes(block)
    with closing(ours(server)) as client:
        client.connect()
        for _ in range(100):
            pdus = []
            for _ in range(8):
                pdu = bytearray(noise.choice(JOBS))
                for _ in range(noise.randint(0, 3)):
                    pdu[noise.randrange(2, len(pdu))] = noise.randrange(256)
                del pdu[noise.randint(10, 60) :]
                pdus.append(b"\x03\x00" + (len(pdu) + 7).to_bytes(2, "big") + b"\x02\xf0\x80" + pdu)
            with socket.create_connection(tuple_of(server)) as peer:
                peer.settimeout(10)
                received = b""
                with contextlib.suppress(ConnectionError):
                    peer.sendall(SESSION + SETUP + b"".join(pdus))
                    peer.shutdown(socket.SHUT_WR)
                    while data := peer.recv(4096):
                        received += data
            assert len(received) < 8 * 400
            assert client.read() == before


def send_forever(peer: socket.socket, data: bytes) -> None:
    while True:
        peer.send(data)


def test_client_that_reads_no_answers_delays_no_other(server: S7Server, block: bytearray) -> None:
    request = bytes.fromhex("0300001f 02f080 32 01 0000 0001 000e 0000 04 01 12 0a 10 02 0384 0005 84 000000")
    with closing(ours(server)) as client, socket.create_connection(tuple_of(server)) as greedy:
        greedy.settimeout(10)
        greedy.sendall(SESSION)
        greedy.recv(100)
        greedy.sendall(SETUP)
        greedy.recv(100)
        greedy.setblocking(False)
        with pytest.raises(BlockingIOError):
            send_forever(greedy, request * 1000)
        client.connect()
        assert client.read() == block


def test_requests_byte_by_byte_and_many_at_once(server: S7Server, block: bytearray) -> None:
    request = bytes.fromhex("0300001f 02f080 32 01 0000 0002 000e 0000 04 01 12 0a 10 02 0004 0005 84 000000")
    answer = bytes.fromhex("0300001d 02f080 32 03 0000 0002 0002 0008 0000 04 01 ff 04 0020") + block[:4]
    with socket.create_connection(tuple_of(server)) as peer, peer.makefile("rb") as stream:
        peer.settimeout(10)
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        peer.sendall(SESSION)
        stream.read(22)
        peer.sendall(SETUP)
        stream.read(27)
        for byte in request:
            peer.sendall(bytes((byte,)))
        assert stream.read(29) == answer
        peer.sendall(request * 1000)
        assert stream.read(29 * 1000) == answer * 1000
