"""Every message about a refusal that a user meets says what to do."""

from __future__ import annotations

import re

import pytest
from snap7.s7protocol import S7_RETURN_CODES

from shmio.connectors.s7 import explain
from shmio.segment._atomics import REASON_SIZE


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x0A, r"^DB201: the block does not exist \(item code 0x0A\).*dbNumber.*optimized"),
        (0x05, r"^DB201 does not have 2180 bytes \(item code 0x05\).*export it again.*Optimized"),
        (0x03, r"access denied \(item code 0x03\); enable.*PUT/GET.*Full access"),
        (0x06, "type or length"),
        (0x07, "type or length"),
        (0x01, "Hardware error"),
        (0x77, "unknown error"),
    ],
)
def test_refused_reads(code: int, text: str) -> None:
    assert re.search(text, explain.explain_read(code, 201, 2180))


def test_refused_writes() -> None:
    assert re.search(r"^DB201 has no byte 99 .*export it again", explain.explain_write(0x05, 201, 99))
    assert re.search("access denied .*PUT/GET", explain.explain_write(0x03, 201, 99))


def test_wrong_block_sizes() -> None:
    assert re.search(r"not have 2180 bytes but 100 bytes .*export it again$", explain.explain_size(201, 2180, 100))
    assert re.search("optimized, clear 'Optimized block access'", explain.explain_size(201, 2180, 0))


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (0x8104, r"\(error 0x8104\); enable .*PUT/GET"),
        (0x8304, "PUT/GET"),
        (0xD241, "protection level.*Full access"),
        (0x8500, "0x8500"),
        (0xEEEE, "unknown error"),
    ],
)
def test_refused_jobs(error: int, text: str) -> None:
    assert re.search(text, explain.explain_error(error))


def test_every_text_fits_into_the_reason_of_a_frame() -> None:
    """A longer text would lose its end, which is the remedy."""
    texts = [explain.explain_error(error) for error in (0x8104, 0x8304, 0xD241, *range(0x8000, 0x8800))]
    for code in range(256):
        texts += [explain.explain_read(code, 65535, 65536), explain.explain_write(code, 65535, 65535)]
    texts += [explain.explain_size(65535, 65536, found) for found in (0, 65535)]
    assert max(len(text.encode()) for text in texts) <= REASON_SIZE


def test_the_known_codes_are_those_of_the_library() -> None:
    assert set(S7_RETURN_CODES) == explain.KNOWN_CODES
