"""Splits the text of a TOML file into tokens, even if it has faults."""

from __future__ import annotations

import re
from typing import Final

TOKEN: Final = re.compile(
    r"""\#[^\n]*|\"\"\"(?:\\.|[^\\])*?(?:\"{3,5}|\Z)|'''.*?(?:'{3,5}|\Z)|"(?:\\.|[^"\\\n])*"?|'[^'\n]*'?"""
    r"""|\[\[|\]\]|[\[\]{}=.,\n]|[^\s"'\#\[\]{}=.,]+""",
    re.DOTALL,
)
"""Matches a comment, a string, a bracket, a sign, a newline, or a bare word; also a string without its end."""
