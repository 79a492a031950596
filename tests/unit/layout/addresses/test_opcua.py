from __future__ import annotations

import uuid

import pytest

from shmio.layout.addresses.opcua import BrowsePath, NodeAddress, parse

GUID = "72962b91-fa75-4ae6-8d28-b404dc7daf63"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("i=2258", NodeAddress(0, 2258)),
        ("ns=3;s=Speed", NodeAddress(3, "Speed")),
        ('ns=3;s="DB201"."Axs1;=x"', NodeAddress(3, '"DB201"."Axs1;=x"')),
        ("nsu=http://maker/device;i=1001", NodeAddress("http://maker/device", 1001)),
        ("nsu=http://maker%3B1/%25a%20b;i=1", NodeAddress("http://maker;1/%a%20b", 1)),
        (f"ns=2;g={GUID}", NodeAddress(2, uuid.UUID(GUID))),
        ("ns=2;b=AQI=", NodeAddress(2, b"\1\2")),
        ("/Objects/2:Device/2:Speed", BrowsePath(((0, "Objects"), (2, "Device"), (2, "Speed")))),
        ("/Objects/2:a&/b&.c&&d e", BrowsePath(((0, "Objects"), (2, "a/b.c&d e")))),
    ],
)
def test_addresses(text: str, expected: object) -> None:
    assert parse(f"  {text} ") == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is missing"),
        ("Speed", "no address of OPC UA"),
        ("ns=3;Speed", "no address of OPC UA"),
        ("ns=70000;s=x", "65535"),
        ("i=4294967296", "4294967295"),
        ("i=-1", "4294967295"),
        ("g=1", "GUID"),
        ("b=%", "base64"),
        ("/", "from character 1 on"),
        ("/Objects//x", "from character 9 on"),
        ("/Objects/2:a.b", "from character 13 on"),
        ("/" + "/".join("x" * 65), "at most 64 steps"),
        ("s=" + "x" * 5000, "4096"),
    ],
)
def test_wrong_addresses_are_explained(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse(text)
