"""Topics with all types of ``std_msgs``, for tests of both connectors."""

from __future__ import annotations

from typing import Final

_TYPES: Final = {
    "BOOL": "Bool", "SINT": "Int8", "INT": "Int16", "DINT": "Int32", "LINT": "Int64", "USINT": "UInt8",
    "UINT": "UInt16", "UDINT": "UInt32", "ULINT": "UInt64", "BYTE": "UInt8", "WORD": "UInt16", "DWORD": "UInt32",
    "LWORD": "UInt64", "REAL": "Float32", "LREAL": "Float64", "STRING[20]": "String",
}  # fmt: skip

STD_TOPICS: Final[dict[str, tuple[str, str]]] = {
    **{f"one_{kind[:6]}": (kind, name) for kind, name in _TYPES.items()},
    **{
        f"all_{kind[:6]}": (f"ARRAY[1..3] OF {kind}", f"{name}MultiArray")
        for kind, name in _TYPES.items()
        if name not in ("Bool", "String")
    },
}
"""For each topic, the type of its register, and the name of its messages' type."""
