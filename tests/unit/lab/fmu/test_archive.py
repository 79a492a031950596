"""The description of an exported instance."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

from shmio.lab.fmu.archive import quoteattr


@pytest.mark.parametrize("text", ["speed in m/s²", 'a "quoted" <word> & more', "two\nlines", "\U0001f916"])
def test_text_survives_in_an_attribute(text: str) -> None:
    assert ElementTree.fromstring(f"<a b={quoteattr(text)}/>").get("b") == text


@pytest.mark.parametrize("character", ["\x00", "\x1b", "\ud800", "\uffff"])
def test_characters_that_xml_cannot_contain_become_escape_sequences(character: str) -> None:
    assert ElementTree.fromstring(f"<a b={quoteattr(f'a{character}b')}/>").get("b") == f"a\\u{ord(character):04x}b"
