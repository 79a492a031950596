"""Split source text into tokens, and read them with a cursor.

The lexer knows one rule of the grammar: the text after ``TITLE =`` may be anything and ends with
the line. Comments are not tokens; the token before a comment on the same line stores it. Invalid
characters become a token of kind ``FAULT``. This is an error only if the parser reads the token,
because the code of a function block, which the parser skips, may contain anything.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum

from shmio.errors import Diagnostic, ShmioError
from shmio.layout.report import Report
from shmio.layout.source.syntax import Position

MAX_SOURCE_BYTES = 4 << 20
MAX_TOKENS = 500_000
_MAX_TOKEN_LENGTH = 4096
_MAX_COMMENT = 1000  # characters that are kept


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
    """A token; ``text`` is as written, but without the quotes of a quoted name.

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
        """Return whether the token is one of the keywords ``words`` (in upper case), whatever its own case."""
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
                is_value = bool(tokens) and tokens[-1].is_punct(":=")  # an attribute of SIMATIC SD may be ""
                fault = "" if kind is Kind.QUOTED and not content and is_value else _problem(kind, content)
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
        words = " ".join(comment[:_MAX_COMMENT].split())
        tokens[-1].comment = f"{tokens[-1].comment} {words}".strip()[:_MAX_COMMENT]


def _problem(kind: Kind, content: str) -> str:
    """Return a message about the error in a token, or "" if it has none."""
    if kind is Kind.PUNCT and content == "'":
        return "the string that begins here has no closing quote on its line"
    if kind is Kind.PUNCT and content == '"':
        return "the quoted name that begins here has no closing quote on its line"
    if kind is Kind.QUOTED and not content:
        return "a quoted name must not be empty"
    if kind is Kind.QUOTED and any(ord(c) < 32 or ord(c) == 127 for c in content):
        return "a name must not contain control characters"
    if len(content) > _MAX_TOKEN_LENGTH:
        return f"longer than {_MAX_TOKEN_LENGTH} characters"
    return ""


_OPENING, _CLOSING = "([", ")]"
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_MAX_INITIAL = 65_536


class SyntaxFault(ShmioError):  # noqa: N818  (the parser reports and goes on; it never leaves the compiler)
    """The source violates the grammar."""

    def __init__(self, diagnostic: Diagnostic) -> None:
        super().__init__(diagnostic.message)
        self.diagnostic = diagnostic


class Cursor:
    """Reads the tokens of one file in order, and stays at the last one, ``Kind.END``.

    The cursor reports a ``FAULT`` token when it reaches the token, and goes on to the next one.
    """

    def __init__(self, file: str, text: str, tokens: list[Token], report: Report) -> None:
        self.file = file
        self.report = report
        self.attributes_first = False
        """True if attributes precede what they are about, as in SIMATIC SD; False if they follow its name."""
        self._text = text
        self._tokens = tokens
        self._absent: set[str] = set()  # keywords that do not occur again; do not search them twice
        self.index = 0
        self.token = tokens[0]
        self._pass_faults()

    @property
    def position(self) -> Position:
        """Position of the current token."""
        return self.at(self.token)

    def at(self, token: Token) -> Position:
        """Return the position of a token."""
        return Position(self.file, token.line, token.column)

    def at_end(self) -> bool:
        """Return whether the current token is the last one."""
        return self.token.kind is Kind.END

    def fault(self, token: Token, message: str) -> SyntaxFault:
        """Create an error about a token, for the caller to raise."""
        return SyntaxFault(self.at(token).error(message))

    def expected(self, what: str) -> SyntaxFault:
        """Create the error "expected ``what``, found the current token", for the caller to raise."""
        return self.fault(self.token, f"expected {what}, found {self.token}")

    def advance(self) -> Token:
        """Step over the current token and return it."""
        token = self.token
        if token.kind is not Kind.END:
            self.index += 1
            self._pass_faults()
        return token

    def rewind(self, index: int) -> None:
        """Go to the token with this index."""
        self.index = index
        self.token = self._tokens[index]

    def skip_to(self, word: str) -> bool:
        """Go to the next keyword ``word`` without reporting faults before it; return whether there is one.

        If the keyword does not occur again, stay and return False.
        """
        if word not in self._absent:
            for index in range(self.index, len(self._tokens)):
                if self._tokens[index].is_word(word):
                    self.rewind(index)
                    return True
            self._absent.add(word)
        return False

    def skip_to_any(self, *words: str) -> None:
        """Go to the next of these keywords, or to the end, without reporting faults before it."""
        while self._tokens[self.index].kind is not Kind.END and not self._tokens[self.index].is_word(*words):
            self.index += 1
        self.rewind(self.index)

    def _pass_faults(self) -> None:
        while (token := self._tokens[self.index]).kind is Kind.FAULT:
            self.report.add(self.at(token).error(token.text))
            self.index += 1
        self.token = token

    def accept(self, punct: str) -> bool:
        """Step over this punctuation if it is the current token; return whether it was."""
        found = self.token.is_punct(punct)
        if found:
            self.advance()
        return found

    def accept_word(self, *words: str) -> bool:
        """Step over the current token if it is one of these keywords; return whether it was."""
        found = self.token.is_word(*words)
        if found:
            self.advance()
        return found

    def expect(self, punct: str, what: str) -> None:
        """Step over this punctuation, or raise SyntaxFault."""
        if not self.accept(punct):
            raise self.expected(what)

    def expect_word(self, word: str) -> None:
        """Step over this keyword, or raise SyntaxFault."""
        if not self.accept_word(word):
            raise self.expected(word)

    def names_member(self) -> bool:
        """Return whether the current word is a member's name and not a keyword; the next token shows this."""
        following = self._tokens[min(self.index + 1, len(self._tokens) - 1)]
        valid = (":", ",") if self.attributes_first else (":", "{", ",")
        return self.token.kind is Kind.WORD and following.kind is Kind.PUNCT and following.text in valid

    def words(self) -> str:
        """Step over the words and numbers on this line, and return them as one name with spaces.

        Tabs and comments between the words become spaces.
        """
        first = last = self.advance()
        name = first.text
        while self.token.kind in (Kind.WORD, Kind.NUMBER) and self.token.line == first.line:
            gap = self._text[last.stop : self.token.start]
            last = self.advance()
            name += (" " if gap.strip() else _CONTROL.sub(" ", gap)) + last.text
        return name

    def last_comment(self, start: int) -> str:
        """Return the last comment that the tokens from ``start`` up to the current one store."""
        comments = [token.comment for token in self._tokens[start : self.index] if token.comment]
        return comments[-1] if comments else ""

    def value(self) -> str:
        """Step over a value, up to the ``;`` that ends it, and return it as written.

        Within brackets, a value may span lines. Outside brackets, a line may end within the value
        only after a comma; otherwise the ``;`` is missing.
        """
        first = last = self.token
        start, depth = self.index, 0
        while not (depth == 0 and self.token.is_punct(";")):
            token = self.token
            moved_on = token.line != last.line and last.text != ","
            if token.kind is Kind.END or (depth == 0 and (moved_on or token.text in (":=", "}"))):
                raise self.expected("';' after the value" if token is not first else "a value")
            if depth and (token.is_punct(";") or token.is_word("END_STRUCT", "END_VAR", "BEGIN", "END_DATA_BLOCK")):
                raise self.expected("the bracket that closes the value")
            if token.kind is Kind.PUNCT:
                depth += (token.text in _OPENING) - (token.text in _CLOSING)
            last = self.advance()
        if last is self.token:
            raise self.expected("a value")
        text = self._between(start, self.index)
        if len(text) > _MAX_INITIAL:
            raise self.fault(first, f"the value is longer than {_MAX_INITIAL} characters")
        return text

    def _between(self, start: int, stop: int) -> str:
        """Return the text of these tokens as written, without the comments between them."""
        tokens = self._tokens[start:stop]
        if not any(token.comment for token in tokens[:-1]):
            return self._text[tokens[0].start : tokens[-1].stop]
        pieces: list[str] = []
        position = tokens[0].start
        for token in tokens:
            gap = self._text[position : token.start]
            pieces += [" " if gap.strip() else gap, self._text[token.start : token.stop]]
            position = token.stop
        return "".join(pieces)
