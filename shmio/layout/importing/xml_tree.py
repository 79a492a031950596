"""Parse XML of unknown origin: no entities, no external files, and limits of size and depth."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final, cast
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from shmio.layout.importing.found import ImportingError

MAX_ELEMENTS: Final = 500_000
MAX_DEPTH: Final = 200


class Node(Element):
    """An element, and the line of the file on which it begins."""

    line = 0

    if TYPE_CHECKING:  # the elements of a tree of nodes are nodes; typeshed knows only Element

        def __iter__(self) -> Iterator[Node]: ...
        def iter(self, tag: str | None = None) -> Iterator[Node]:  # type: ignore[override]
            """Yield this node and the nodes below it with this tag, or all."""

        def iterfind(self, path: str, namespaces: Any = None) -> Iterator[Node]:  # type: ignore[override]
            """Yield the nodes at a path."""

        def find(self, path: str, namespaces: Any = None) -> Node | None:
            """Return the first node at a path."""


def parse(data: bytes) -> Node:
    """Return the root element. Element names in the tree have no namespaces.

    Raises:
        ImportingError: The data is not XML, has a document type, or is too large or too deep.

    """
    builder = TreeBuilder(Node)
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
        named = {key.rpartition("}")[2]: value for key, value in attributes.items()}
        node = cast("Node", builder.start(name.rpartition("}")[2], named))
        node.line = parser.CurrentLineNumber

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
        return cast("Node", builder.close())
    except (expat.ExpatError, ValueError, LookupError, AssertionError) as error:
        raise ImportingError(f"the file is not valid XML: {error}") from None
