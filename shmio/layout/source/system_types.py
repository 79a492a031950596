"""System data types whose layout has a public source.

This module declares the types as a user would, and the placement rules compute the addresses of their
members. For each type, the result agrees with the length or the addresses that the public source
states. ``docs/reference/layout-rules.md`` lists the types.

- ErrorStruct, CREF, NREF: members in Siemens' help on GET_ERROR, lengths in the help on system data types.
- TCON_Param, TADDR_Param: Siemens' help on open user communication has every byte.
- SSL_HEADER: members in Siemens' help on RDSYSST, length in the help on system data types.
- SFB 0 to 5: the simulator awlsim has the interfaces; its tests state the addresses of SFB 0.

For IEC_TIMER and similar types, only the length is public, and not the offsets of the members. Such a
type becomes an array of bytes. Any other system type is an error unless the configuration gives its
size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

from shmio.layout.report import Report
from shmio.layout.source import lexer, parser
from shmio.layout.source.syntax import TypeDeclaration

_TYPES = """
TYPE CREF STRUCT BLOCK_TYPE : Byte; CB_NUMBER : UInt; OFFSET : UDInt; END_STRUCT END_TYPE
TYPE NREF STRUCT AREA : Byte; DB_NUMBER : UInt; OFFSET : UDInt; END_STRUCT END_TYPE
TYPE ErrorStruct STRUCT
  ERROR_ID : Word; FLAGS, REACTION : Byte; CODE_ADDRESS : CREF; MODE : Byte;
  OPERAND_NUMBER, POINTER_NUMBER_LOCATION, SLOT_NUMBER_SCOPE : UInt; DATA_ADDRESS : NREF;
END_STRUCT END_TYPE
TYPE TCON_Param STRUCT
  block_length : UInt := 64; id : CONN_OUC := 1; connection_type : USInt := 17; active_est : Bool := TRUE;
  local_device_id : USInt := 1; local_tsap_id_len, rem_subnet_id_len : USInt; rem_staddr_len : USInt := 4;
  rem_tsap_id_len : USInt := 2; next_staddr_len : USInt; local_tsap_id : Array[1..16] of Byte;
  rem_subnet_id, rem_staddr : Array[1..6] of USInt; rem_tsap_id : Array[1..16] of Byte;
  next_staddr : Array[1..6] of Byte; spare : Word;
END_STRUCT END_TYPE
TYPE TADDR_Param STRUCT
  rem_ip_addr : Array[1..4] of USInt; rem_port_nr : UInt; reserved : Word;
END_STRUCT END_TYPE
TYPE SSL_HEADER STRUCT LENTHDR, N_DR : Word; END_STRUCT END_TYPE
"""
_COUNTER = """
FUNCTION_BLOCK {name}
VAR_INPUT {inputs} : Bool; PV : Int; END_VAR VAR_OUTPUT {outputs} : Bool; CV : Int; END_VAR VAR {edges} : Bool; END_VAR
END_FUNCTION_BLOCK
"""
_TIMER = """
FUNCTION_BLOCK {name}
VAR_INPUT IN : Bool; PT : Time; END_VAR VAR_OUTPUT Q : Bool; ET : Time; END_VAR
VAR STATE : Byte; STIME, ATIME : Time; END_VAR
END_FUNCTION_BLOCK
"""
_COUNTERS = (
    (("SFB0", "CTU"), "CU, R", "Q", "CUO"),
    (("SFB1", "CTD"), "CD, LOAD", "Q", "CDO"),
    (("SFB2", "CTUD"), "CU, CD, R, LOAD", "QU, QD", "CUO, CDO"),
)
_TIMERS = ("SFB3", "TP", "SFB4", "TON", "SFB5", "TOF")

_IEC_TIMERS = (
    "IEC_TIMER",
    "TON_TIME",
    "TOF_TIME",
    "TP_TIME",
    "TONR_TIME",
)
_IEC_LTIMERS = ("IEC_LTIMER", "TON_LTIME", "TOF_LTIME", "TP_LTIME", "TONR_LTIME")
_IEC_COUNTERS = {
    "SINT": "IEC_SCOUNTER", "USINT": "IEC_USCOUNTER", "INT": "IEC_COUNTER", "UINT": "IEC_UCOUNTER",
    "DINT": "IEC_DCOUNTER", "UDINT": "IEC_UDCOUNTER", "LINT": "IEC_LCOUNTER", "ULINT": "IEC_ULCOUNTER",
}  # fmt: skip
_NO_SOURCE = "its placement in a block with standard access has no public source"
_LENGTHS = {
    "IEC_TIMER": 16, "IEC_LTIMER": 32, "IEC_SCOUNTER": 3, "IEC_USCOUNTER": 3, "IEC_COUNTER": 6, "IEC_UCOUNTER": 6,
    "IEC_DCOUNTER": 12, "IEC_UDCOUNTER": 12, "IEC_LCOUNTER": 24, "IEC_ULCOUNTER": 24, "VREF": 12, "CONDITIONS": 52,
    "HSC_PERIOD": 12,
}  # fmt: skip
"""Sizes in bytes, from Siemens' help on system data types; odd sizes are padded as usual."""
# fmt: off
_REFUSED = {
    **dict.fromkeys((
        "TON_TIME", "TOF_TIME", "TP_TIME", "TONR_TIME", "TON_LTIME", "TOF_LTIME", "TP_LTIME", "TONR_LTIME",
        *(f"{kind}_{count}" for kind in ("CTU", "CTD", "CTUD")
          for count in ("SINT", "USINT", "INT", "UINT", "DINT", "UDINT", "LINT", "ULINT")),
        "R_TRIG", "F_TRIG", "TCON_IP_RFC", "TCON_IP_V4_SEC", "TCON_QDN", "TCON_QDN_SEC", "TCON_PHYS", "TCON_FDL",
        "TMAIL_V4", "TMAIL_V6", "TMAIL_FQDN", "IF_CONF_V4", "GEOADDR", "LOG2GEO", "AOM_AID",
        "TCON", "TDISCON", "TSEND", "TRCV", "TSEND_C", "TRCV_C", "TUSEND", "TURCV", "GET", "PUT", "USEND", "URCV",
        "BSEND", "BRCV", "MB_CLIENT", "MB_SERVER", "RDREC", "WRREC", "RALRM", "PID_COMPACT", "PID_3STEP",
        "C_ALARM", "C_ALARM_8", "C_ALARM_8P", "C_AR_SEND", "C_NOTIFY", "C_NOTIFY_8P",
        "ASSOCVALUES",
    ), _NO_SOURCE),
    "TCON_IP_V4": "Siemens' help gives it 14 bytes in one place and 16 in another",
    "VARIANT": "it is a reference, which a data block does not store",
    "VOID": "no value has this type",
}
# fmt: on


@cache
def named() -> Mapping[str, TypeDeclaration]:
    """Return the types whose members have known names but unknown places, by name in lower case.

    Programs name these members: ``"x".PT``, ``"x".CV``. So a server has them as nodes.
    """
    texts = [f"TYPE {name} STRUCT PT, ET : Time; IN, Q : Bool; END_STRUCT END_TYPE" for name in _IEC_TIMERS]
    texts += [f"TYPE {name} STRUCT PT, ET : LTime; IN, Q : Bool; END_STRUCT END_TYPE" for name in _IEC_LTIMERS]
    for kind, counter in _IEC_COUNTERS.items():
        members = f"STRUCT CU, CD, R, LD, QU, QD : Bool; PV, CV : {kind}; END_STRUCT END_TYPE"
        texts += (f"TYPE {name} {members}" for name in (counter, f"CTU_{kind}", f"CTD_{kind}", f"CTUD_{kind}"))
    texts += (f"TYPE {name} STRUCT CLK, Q : Bool; END_STRUCT END_TYPE" for name in ("R_TRIG", "F_TRIG"))
    return _parsed(texts)


@cache
def declarations() -> Mapping[str, TypeDeclaration]:
    """Return the system types whose members are known, by name in lower case."""
    texts = [_TYPES, *(_TIMER.format(name=name) for name in _TIMERS)]
    for names, inputs, outputs, edges in _COUNTERS:
        texts += (_COUNTER.format(name=name, inputs=inputs, outputs=outputs, edges=edges) for name in names)
    return _parsed(texts)


def _parsed(texts: Sequence[str]) -> Mapping[str, TypeDeclaration]:
    text, report = "\n".join(texts), Report(["system types"])
    unit = parser.parse("system types", text, lexer.tokenize(text), report)
    return {declaration.name.lower(): declaration for declaration in unit.types}


def is_known(name: str) -> bool:
    """Return whether the name is that of a system type."""
    return bool(length(name) or refusal(name)) or name.lower() in declarations()


def length(name: str) -> int:
    """Return the size in bytes of a type whose members are not public; 0 for any other type."""
    return _LENGTHS.get(name.upper(), 0)


def refusal(name: str) -> str:
    """Return why a system type cannot be placed, or "" if the name is not that of a system type."""
    return _REFUSED.get(name.upper(), "")
