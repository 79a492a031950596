"""Node ids of the members of a data block in the OPC UA server of an S7-1500.

The server has all data blocks in the namespace ``http://www.siemens.com/simatic-s7-opcua``. The node
of a member is a text with the names of the block and of the members in quotes, ``"DB201"."Robot_800"
."Axs1_Pos"``; an index of an array of structures follows its name: ``"Axes"[2]."Vel"``. An array of
an elementary type is one node. Source: Siemens, "Communication" function manual, section "Addressing
nodes". It makes no difference whether the block is optimized.
"""

from __future__ import annotations

import re
from typing import Final

from shmio.layout.addresses.opcua import NodeAddress
from shmio.layout.model import Layout, Register
from shmio.layout.topic import decode_segment

NAMESPACE: Final = "http://www.siemens.com/simatic-s7-opcua"
_INDEX: Final = re.compile(r"-?[0-9]+")


def node_address(layout: Layout, register: Register) -> NodeAddress:
    """Return the node id of a register of a data block.

    Each number in the path counts as the index of an array. So the result is wrong if a member's
    name is a number; the user must then give the register's address in a tag table.
    """
    parts: list[str] = [f'"{layout.name}"']
    indices: list[str] = []
    for segment in register.path.split("/"):
        if _INDEX.fullmatch(segment):
            indices.append(segment)
            continue
        parts[-1] += _bracketed(indices)
        indices = []
        parts.append(f'"{decode_segment(segment)}"')
    parts[-1] += _bracketed(indices)
    return NodeAddress(NAMESPACE, ".".join(parts))


def _bracketed(indices: list[str]) -> str:
    return f"[{','.join(indices)}]" if indices else ""
