"""Every byte of a text comes back as it was. The right characters are those of Python and of the Encoding Standard."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import CharacterError, LayoutError, ValueRangeError
from shmio.layout.document import load_layout
from shmio.layout.encodings import NAMES, canonical, text_encoding
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.frame_codec import FrameCodec
from shmio.layout.values.typed import read_value
from shmio.layout.values.write import encode

TABLE = {"a": "STRING[8]", "b": "ARRAY[0..2] OF STRING[6]", "c": "CHAR", "d": "ARRAY[0..3] OF CHAR", "e": "WSTRING[4]"}


def layout_with(encoding: str) -> Layout:
    return load_layout(place_tags("t", TABLE).with_encoding(encoding).to_json())


def test_characters_of_code_pages() -> None:
    """Windows-1252 as the Encoding Standard has it: bytes without a character are C1 controls."""
    for name, data, text in [
        ("windows-1252", bytes.fromhex("80 81 8d 8f 90 9d 9f ff"), "€\x81\x8d\x8f\x90\x9dŸÿ"),
        ("", bytes.fromhex("80 ff"), "\x80ÿ"),
        ("gbk", bytes.fromhex("ce c2 b6 c8 31"), "温度1"),
        ("gbk", bytes.fromhex("31 ce c2 b6"), "1温\uf7b6"),  # a text that was cut
        ("cp949", bytes.fromhex("bf c2 b5 b5"), "온도"),
        ("cp949", bytes.fromhex("bf 20 ff"), "\uf7bf \uf7ff"),
        ("utf-8", b"\xe2\x82\xac\x80", "€\uf780"),
        ("utf-8", "\uf780".encode(), "\uf7ef\uf79e\uf780"),  # a stand-in that is really there
        ("utf-16-be", bytes.fromhex("0041 d83d d83d de00"), "A\U0010f83d😀"),
        ("utf-16-be", "\U0010f800".encode("utf-16-be"), "\U0010fbfe\U0010fc00"),
    ]:
        encoding = text_encoding(name)
        assert encoding.decode(data) == text, name
        assert encoding.encode(text) == data, name


def test_names_of_encodings() -> None:
    for given_name, wanted in {
        "CP1252": "windows-1252", "latin1": "iso-8859-1", "cp936": "gbk", "GB2312": "gbk", "euc-kr": "cp949",
        "uhc": "cp949", "UTF8": "utf-8", "sjis": "shift-jis",
    }.items():  # fmt: skip
        assert canonical(given_name) == wanted
    for name in NAMES:
        assert canonical(name) == name
    for wrong in ("", "utf-16", "base64", "rot13", "idna", "windows-1259", "a\0b"):
        with pytest.raises(ValueError, match="unknown encoding"):
            canonical(wrong)
    with pytest.raises(ValueError, match="did you mean 'gb2312'"):
        canonical("gb2313")


@given(st.sampled_from([*NAMES, "utf-16-be", "utf-16-le"]), st.binary(max_size=16))
def test_every_sequence_of_bytes_comes_back(name: str, data: bytes) -> None:
    data = data[: len(data) & ~1]
    encoding = text_encoding(name)
    text = encoding.decode(data)
    text.encode()  # JSON and protobuf can hold it
    assert encoding.encode(text) == data


@given(st.sampled_from(["windows-1252", "", "gbk", "cp949", "utf-8"]), st.data())
def test_registers_with_any_bytes_are_written_as_they_were_read(name: str, data: st.DataObject) -> None:
    """Also by one codec for whole frames, which shows the same texts."""
    layout = layout_with(name or "iso-8859-1")
    frame = bytearray(data.draw(st.binary(min_size=layout.size, max_size=layout.size)))
    for one in layout.registers:
        if one.type.startswith("STRING"):
            for place in range(one.count):
                at = one.offset + place * one.element.stride
                frame[at : at + 2] = one.element.length, frame[at + 1] % (one.element.length + 1)
        elif one.type.startswith("WSTRING"):
            frame[one.offset : one.offset + 4] = bytes((4, 0, frame[one.offset] % 5, 0))
    columns = FrameCodec(layout).decode(np.frombuffer(bytes(frame), np.uint8).reshape(1, -1))
    for one in layout.registers:
        value = codec(one, layout.byte_order).decode(frame)
        texts = [text.rstrip("\0") for text in np.asarray(value, object).reshape(-1)]  # numpy drops zeros at the end
        assert np.asarray(columns[one.path][0]).reshape(-1).tolist() == texts, one.path
        (write,) = encode(one, value, layout.byte_order)
        again = bytearray(frame)
        again[write.offset : write.offset + len(write.data)] = write.data
        assert codec(one, layout.byte_order).decode(again) == value
        if "STRING" not in one.type:
            assert again == frame


def test_lengths_are_bytes_and_messages_name_the_encoding() -> None:
    layout = layout_with("gbk")
    register = layout.registers[layout.by_path["a"]]
    assert encode(register, "温度温度")[0].data == b"\x08\x08" + "温度温度".encode("gbk")
    with pytest.raises(ValueRangeError, match=r"STRING\[8\]: the text has 10 bytes, but at most 8 are allowed"):
        encode(register, "温度温度1x")
    with pytest.raises(
        CharacterError, match=r"the register's encoding \(gbk\) cannot hold '✓', character 3 of the text"
    ):
        encode(register, "温 ✓")
    with pytest.raises(CharacterError, match=r"\(windows-1252\) cannot hold '✓', character 2"):
        encode(layout_with("windows-1252").registers[0], "€✓")
    assert encode(layout_with("windows-1252").registers[0], "€")[0].data[:3] == b"\x08\x01\x80"
    with pytest.raises(ValueRangeError, match="CHAR: expected one character of 1 byte in gbk"):
        encode(layout.registers[layout.by_path["c"]], "温")
    assert read_value("'温度'", register) == "温度"


def test_elements_and_slices_have_the_encoding() -> None:
    layout = layout_with("cp949")
    for path in ("b/1", "b/0..1", "d/2", "d/1..3"):
        assert find(layout, path).encoding == "cp949", path
    assert layout.registers[layout.by_path["e"]].encoding == ""
    assert layout.with_encoding("iso-8859-1") == place_tags("t", TABLE)


def test_layouts_of_others_are_checked() -> None:
    text = layout_with("gbk").to_json()
    for wrong in (text.replace(b'"gbk"', b'"punycode"'), text.replace(b'"e","type":"WSTRING[4]"', b'"e","type":"INT"')):
        with pytest.raises(LayoutError):
            load_layout(wrong)
