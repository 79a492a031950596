"""The emulated Modbus device under a client that shares no code with it, in both framings."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest

from shmio.config.address import Address
from shmio.connectors.modbus.client import crc
from shmio.connectors.modbus.connector import ModbusConnector, ModbusOptions
from shmio.emulators.device import Served
from shmio.emulators.modbus import ModbusEmulator
from shmio.errors import ConfigError
from shmio.layout.addresses.modbus import Table
from shmio.layout.tags import place_tags
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.write import encode
from shmio.testing.ports import reserved_port

pytest.importorskip("pymodbus")

LAYOUT = place_tags("plant", {
    "word": {"type": "WORD", "address": "holding 0", "writable": True},
    "byte": {"type": "BYTE", "address": "holding 1", "writable": True},
    "text": {"type": "STRING[3]", "address": "holding 2", "writable": True},
    "coils": {"type": "ARRAY[0..9] OF BOOL", "address": "coil 0", "writable": True},
})  # fmt: skip


@contextmanager
def emulated(framing: str) -> Iterator[tuple[Address, ModbusEmulator]]:
    with reserved_port() as address:
        emulator = ModbusEmulator([Served(LAYOUT, {"framing": framing})], "idle", address)
        emulator.start()
        try:
            yield address, emulator
        finally:
            emulator.stop()


class Client:
    """Sends requests as the specification shows them, in either framing."""

    def __init__(self, address: Address, framing: str) -> None:
        self._socket = socket.create_connection((address.host, address.port), 20)
        self._rtu = framing == "rtu"

    def ask(self, request: str) -> str:
        """Return the answer to a request; both are function and data in hexadecimal."""
        data = b"\1" + bytes.fromhex(request)
        if self._rtu:
            self._socket.sendall(data + crc(data))
            answer = self._socket.recv(300)
            assert crc(answer[:-2]) == answer[-2:]
            return answer[1:-2].hex(" ")
        self._socket.sendall(struct.pack(">HHH", 7, 0, len(data)) + data)
        answer = self._socket.recv(300)
        assert struct.unpack_from(">HHHB", answer) == (7, 0, len(answer) - 6, 1)
        return answer[7:].hex(" ")

    def close(self) -> None:
        self._socket.close()


@pytest.mark.parametrize("framing", ["tcp", "rtu"])
def test_each_function_changes_what_it_names(framing: str) -> None:
    with emulated(framing) as (address, emulator), closing(Client(address, framing)) as client:
        words, coils = emulator._words[1, Table.HOLDING], emulator._words[1, Table.COIL]
        words[:] = range(0x1100, 0x1100 + len(words))
        coils[:] = [1] * len(coils)
        before, lit = list(words), list(coils)
        for request, answer, changes in (
            ("05 00 03 00 00", "05 00 03 00 00", {("coil", 3): 0}),
            ("0f 00 04 00 03 01 02", "0f 00 04 00 03", {("coil", 4): 0, ("coil", 6): 0}),
            ("06 00 05 12 34", "06 00 05 12 34", {("word", 5): 0x1234}),
            ("10 00 06 00 02 04 00 01 00 02", "10 00 06 00 02", {("word", 6): 1, ("word", 7): 2}),
            ("16 00 08 ff 00 00 25", "16 00 08 ff 00 00 25", {("word", 8): 0x1125}),
            ("17 00 00 00 01 00 09 00 01 02 ab cd", "17 02 11 00", {("word", 9): 0xABCD}),
            ("16 00 05 00 f2 00 25", "16 00 05 00 f2 00 25", {("word", 5): 0x1234 & 0xF2 | 0x25 & ~0xF2}),
        ):
            assert client.ask(request) == answer
            for (table, at), value in changes.items():
                (lit if table == "coil" else before)[at] = value
            assert (words, coils) == (before, lit), request
        assert client.ask("06 ff ff 00 00") == "86 02"


def test_the_program_may_change_a_word_while_a_client_changes_a_part_of_it() -> None:
    """pymodbus reads the word, and writes it back; what the program has changed in between stays."""
    with emulated("tcp") as (address, emulator), closing(Client(address, "tcp")) as client:
        words = emulator._words[1, Table.HOLDING]
        words[0] = 0x0F0F
        read = emulator._store.async_getValues

        async def changed_in_between(unit: int, function: int, *given: int) -> Any:
            found = await read(unit, function, *given)
            if function == 22:
                words[0] ^= 0xF000
            return found

        emulator._store.async_getValues = changed_in_between  # type: ignore[method-assign, assignment]
        assert client.ask("16 00 00 ff f0 00 05") == "16 00 00 ff f0 00 05"
        assert words[0] == 0xFF05


@pytest.mark.parametrize("framing", ["tcp", "rtu"])
def test_the_connector_writes_parts_of_words(framing: Any) -> None:
    with emulated(framing) as (address, emulator):
        words = emulator._words[1, Table.HOLDING]
        words[:4] = [0xAAAA] * 4
        layout = LAYOUT.with_statuses()
        options = ModbusOptions(host=address.host, port=address.port, framing=framing, timeout=20_000)
        with closing(ModbusConnector(options, layout)) as connector:
            connector.connect()
            for path, value in {"byte": 5, "text": "xyz", "word.%X0": True, "coils/3": True}.items():
                assert connector.write(encode(find(layout, path), value, layout.byte_order)) == [""]
            image = connector.read()
            assert [codec(one, layout.byte_order).decode(image) for one in layout.registers[:3]] == [0xAAAB, 5, "xyz"]
        assert words[:4] == [0xAAAB, 0xAA05, 0x7879, 0x7AAA]
        assert emulator._words[1, Table.COIL][:5] == [0, 0, 0, 1, 0]


def test_all_sources_of_a_device_have_one_framing() -> None:
    served = [Served(LAYOUT, {"framing": "rtu"}), Served(LAYOUT)]
    with pytest.raises(ConfigError, match="framing: the sources of one device"):
        ModbusEmulator(served, "idle", Address("127.0.0.1", 1))
    with (
        emulated("rtu") as (_, emulator),
        pytest.raises(ConfigError, match="restart the instance to change the framing"),
    ):
        emulator.change(served[1:])


def test_a_register_keeps_its_value_when_the_order_of_its_words_changes() -> None:
    layout = place_tags("plant", {"a": {"type": "DINT", "address": "holding 0", "initial": 74}})
    emulator = ModbusEmulator([Served(layout)], "idle", Address("127.0.0.1", 1))
    held = emulator._words[1, Table.HOLDING]
    held[:2] = [0x0001, 0x0002]
    emulator.change([Served(layout, {"word_order": "little"})])
    assert emulator._words[1, Table.HOLDING][:2] == [0x0002, 0x0001]
    with pytest.raises(ConfigError, match="layout: a: the sources that read this register of unit 1 differ"):
        emulator.change([Served(layout), Served(layout, {"word_order": "little"})])
    assert emulator._words[1, Table.HOLDING][:2] == [0x0002, 0x0001]


def test_clients_that_never_send_a_request_make_room(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("shmio.emulators.modbus.MAX_CLIENTS", 2)
    with emulated("tcp") as (address, _), closing(Client(address, "tcp")) as working:
        assert working.ask("03 0000 0001") == "03 02 00 00"
        for _ in range(20):  # they have left when the emulator looks for the one to end
            socket.create_connection((address.host, address.port), 20).close()
        silent = socket.create_connection((address.host, address.port), 20)
        with silent, closing(Client(address, "tcp")) as other:
            assert other.ask("03 0000 0001") == "03 02 00 00"
            assert silent.recv(1) == b""
        assert working.ask("03 0000 0001") == "03 02 00 00"
    assert not caplog.records
