from __future__ import annotations

import uuid

import pytest

from shmio.layout.addresses.opcua import BrowsePath, NodeAddress, member_text, node_text, parse, parse_member

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
        ("Speed", "is not an address of OPC UA"),
        ("ns=3;Speed", "is not an address of OPC UA"),
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


@pytest.mark.parametrize(
    ("text", "node", "member"),
    [
        ("ns=2;s=Pump#Axis.Speed", NodeAddress(2, "Pump"), ("Axis", "Speed")),
        ("ns=2;s=a##b###Axes[3].X", NodeAddress(2, "a#b#"), ("Axes", (3,), "X")),
        ("nsu=http://x/#a;i=5#[0].Grid[1,2]", NodeAddress("http://x/#a", 5), ((0,), "Grid", (1, 2))),
        ("/Objects/2:a&#b#&[&].c", BrowsePath(((0, "Objects"), (2, "a#b"))), ("[]", "c")),
        ("i=5#a&.b&#&&", NodeAddress(0, 5), ("a.b#&",)),
        ("i=5", NodeAddress(0, 5), ()),
    ],
)
def test_members_of_structures(text: str, node: object, member: object) -> None:
    found = parse_member(text)
    assert found == (node, member)
    if member:
        with pytest.raises(ValueError, match="a member of a structure"):
            parse(text)
        assert parse_member(f"i=1{member_text(found[1])}")[1] == member


def test_a_number_sign_in_an_identifier_is_doubled() -> None:
    assert parse(f"ns=2;{node_text('s=a#b##')}") == NodeAddress(2, "a#b##")


@pytest.mark.parametrize("text", ["i=5#", "i=5#.a", "i=5#a..b", "i=5#a[x]", "i=5#a[1", "i=5#a]", "i=5#a" + ".a" * 64])
def test_wrong_ways_to_members_are_explained(text: str) -> None:
    with pytest.raises(ValueError, match="member"):
        parse_member(text)
