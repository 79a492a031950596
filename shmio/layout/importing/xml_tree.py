"""Parse XML of unknown origin: no entities, no external files, and limits of size and depth."""

from __future__ import annotations

from typing import Final
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from shmio.layout.importing.found import ImportingError

MAX_ELEMENTS: Final = 500_000
MAX_DEPTH: Final = 200


def parse(data: bytes) -> Element:
    """Return the root element. Element names in the tree have no namespaces.

    Raises:
        ImportingError: The data is not XML, has a document type, or is too large or too deep.

    """
    builder = TreeBuilder()
    parser = expat.ParserCreate(namespace_separator="}")
    parser.buffer_text = True
    depth = elements = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, elements
        depth, elements = depth + 1, elements + 1
        if depth > MAX_DEPTH or elements > MAX_ELEMENTS:
            raise ImportingError(
                f"the XML has more than {MAX_ELEMENTS} elements, or is nested more than {MAX_DEPTH} deep"
            )
        builder.start(name.rpartition("}")[2], {key.rpartition("}")[2]: value for key, value in attributes.items()})

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(name.rpartition("}")[2])

    def refuse(*_declaration: object) -> None:
        raise ImportingError(
            "the XML declares a document type, which is not allowed, because it could read files or never end"
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    try:
        parser.Parse(data, True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError, AssertionError) as error:
        raise ImportingError(f"the file is not valid XML: {error}") from None
