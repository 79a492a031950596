"""Split source text into tokens.

The lexer knows one rule of the grammar: the text after ``TITLE =`` is free and ends with the line.
Comments are not tokens: each is stored in the token before it on the same line. Invalid characters
become a token of kind ``FAULT``, which matters only where the parser reads: the code of a function
block may contain anything.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum

MAX_SOURCE_BYTES = 4 << 20
MAX_TOKENS = 500_000
MAX_TOKEN_LENGTH = 4096
MAX_COMMENT = 1000  # characters that are kept


class Kind(Enum):
    """Kind of a token."""

    WORD = "word"
    QUOTED = "quoted name"
    NUMBER = "number"
    STRING = "string"
    PUNCT = "punctuation"
    FAULT = "fault"  # its text is the error message
    END = "end of file"


@dataclass(slots=True)
class Token:
    """A piece of source; ``text`` is as written, but a quoted name has no quotes.

    ``start`` and ``stop`` are character positions in the source, ``line`` and ``column`` count from 1.
    ``comment`` is the text of the comments that follow on the token's line.
    """

    kind: Kind
    text: str
    line: int
    column: int
    start: int
    stop: int
    comment: str = ""

    def __str__(self) -> str:
        if self.kind is Kind.END:
            return "the end of the file"
        return repr(self.text if len(self.text) <= 40 else f"{self.text[:39]}…")

    def is_word(self, *words: str) -> bool:
        """Return whether this is one of the keywords (given in upper case), in any case."""
        return self.kind is Kind.WORD and self.text.upper() in words

    def is_punct(self, text: str) -> bool:
        """Return whether this is the given punctuation."""
        return self.kind is Kind.PUNCT and self.text == text


_TOKEN = re.compile(
    r"""
      (?P<newline>   \r\n | \r | \n )
    | (?P<space>     [^\S\r\n]+ )
    | (?P<line>      //[^\r\n]* )
    | (?P<open>      \(\* | /\* | \(/\* )
    | (?P<title>     TITLE[^\S\r\n]*=[^\r\n]* )
    | (?P<word>      [^\W\d]\w* )
    | (?P<number>    [0-9][0-9_]*(?:\.[0-9][0-9_]*)?(?:[eE][+-]?[0-9]+)? )
    | (?P<quoted>    "(?P<name>[^"\r\n]*)" )
    | (?P<string>    '(?:[^'$\r\n]|\$[^\r\n])*' )
    | (?P<punct>     := | \.\. | [^\s\x00-\x1f\x7f] )
    """,
    re.VERBOSE | re.IGNORECASE,
)
_CLOSE = {"(*": "*)", "/*": "*/", "(/*": "*/)"}
_KINDS = {
    "word": Kind.WORD,
    "number": Kind.NUMBER,
    "quoted": Kind.QUOTED,
    "string": Kind.STRING,
    "punct": Kind.PUNCT,
}
_NEWLINE = re.compile(r"\r\n|\r|\n")


def tokenize(text: str) -> list[Token]:
    """Split a whole source into tokens; the last one is ``Kind.END``.

    A source with more than ``MAX_TOKENS`` is cut there, with a ``FAULT`` token.
    """
    tokens: list[Token] = []
    position, line, line_start = 0, 1, 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        column = position - line_start + 1
        fault, kind = "", None
        if len(tokens) >= MAX_TOKENS:
            fault = f"the file has more than {MAX_TOKENS} tokens"
            stop = len(text)
        elif match is None:
            fault = f"a control character ({ord(text[position]):#04x}) is not allowed here"
            stop = position + 1
        else:
            group, stop = str(match.lastgroup), match.end()
            if group == "newline":
                line, line_start = line + 1, stop
            elif group == "line":
                _attach(tokens, line, match[0].lstrip("/"))
            elif group == "open":
                close = _CLOSE[match[0]]
                end = text.find(close, stop)
                if end < 0:
                    fault = f"the comment that begins here has no {close!r}"
                    stop = len(text)
                else:
                    _attach(tokens, line, text[stop:end])
                    for newline in _NEWLINE.finditer(text, stop, end):
                        line, line_start = line + 1, newline.end()
                    stop = end + len(close)
            elif kind := _KINDS.get(group):
                content = match["name"] if kind is Kind.QUOTED else match[0]
                fault = _problem(kind, content)
                if kind is Kind.PUNCT and content in "'\"":
                    end_of_line = _NEWLINE.search(text, stop)
                    stop = end_of_line.start() if end_of_line else len(text)
                    kind = None
        if fault:
            tokens.append(Token(Kind.FAULT, fault, line, column, position, stop))
        if kind:
            tokens.append(Token(kind, content, line, column, position, stop))
        position = stop
    tokens.append(Token(Kind.END, "", line, position - line_start + 1, position, position))
    return tokens


def _attach(tokens: list[Token], line: int, comment: str) -> None:
    if tokens and tokens[-1].line == line:
        words = " ".join(comment[:MAX_COMMENT].split())
        tokens[-1].comment = f"{tokens[-1].comment} {words}".strip()[:MAX_COMMENT]


def _problem(kind: Kind, content: str) -> str:
    """Return what is wrong with a token, or an empty string."""
    if kind is Kind.PUNCT and content == "'":
        return "the string that begins here has no closing quote on its line"
    if kind is Kind.PUNCT and content == '"':
        return "the quoted name that begins here has no closing quote on its line"
    if kind is Kind.QUOTED and not content:
        return "a quoted name must not be empty"
    if kind is Kind.QUOTED and any(ord(c) < 32 or ord(c) == 127 for c in content):
        return "a name must not contain control characters"
    if len(content) > MAX_TOKEN_LENGTH:
        return f"longer than {MAX_TOKEN_LENGTH} characters"
    return ""
