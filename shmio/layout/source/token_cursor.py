"""Cursor with which the parser walks over a list of tokens."""

from __future__ import annotations

import re

from shmio.errors import Diagnostic, ShmioError
from shmio.layout.report import Report
from shmio.layout.source.lexer import Kind, Token
from shmio.layout.source.syntax import Position

_OPENING, _CLOSING = "([", ")]"
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
MAX_INITIAL = 65_536


class SyntaxFault(ShmioError):  # noqa: N818  (the parser reports and goes on; it never leaves the compiler)
    """The source violates the grammar at this place."""

    def __init__(self, diagnostic: Diagnostic) -> None:
        super().__init__(diagnostic.message)
        self.diagnostic = diagnostic


class Cursor:
    """Walks over the tokens of one file; it never passes the last one, ``Kind.END``.

    A ``FAULT`` token is reported when the cursor reaches it, and never becomes the current token.
    """

    def __init__(self, file: str, text: str, tokens: list[Token], report: Report) -> None:
        self.file = file
        self.report = report
        self._text = text
        self._tokens = tokens
        self._absent: set[str] = set()  # keywords that do not follow any more: no second search
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
        """Return whether all tokens have been passed."""
        return self.token.kind is Kind.END

    def fault(self, token: Token, message: str) -> SyntaxFault:
        """Return an error about a token, for the caller to raise."""
        return SyntaxFault(self.at(token).error(message))

    def expected(self, what: str) -> SyntaxFault:
        """Return an error for the caller to raise: the current token is not what was expected."""
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
        """Go to this keyword without reporting faults on the way.

        If the keyword does not follow, stay and return False.
        """
        if word not in self._absent:
            for index in range(self.index, len(self._tokens)):
                if self._tokens[index].is_word(word):
                    self.rewind(index)
                    return True
            self._absent.add(word)
        return False

    def skip_to_any(self, *words: str) -> None:
        """Go to the next of these keywords, or to the end, without reporting faults on the way."""
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
        """Return whether the token after the current word shows it to be a name, not a keyword."""
        following = self._tokens[min(self.index + 1, len(self._tokens) - 1)]
        return self.token.kind is Kind.WORD and following.kind is Kind.PUNCT and following.text in (":", "{", ",")

    def words(self) -> str:
        """Step over the words and numbers on this line and return them as written, with spaces.

        Tabs and comments between them become spaces, because they are not part of a name.
        """
        first = last = self.advance()
        name = first.text
        while self.token.kind in (Kind.WORD, Kind.NUMBER) and self.token.line == first.line:
            gap = self._text[last.stop : self.token.start]
            last = self.advance()
            name += (" " if gap.strip() else _CONTROL.sub(" ", gap)) + last.text
        return name

    def last_comment(self, start: int) -> str:
        """Return the last comment on the tokens from ``start`` up to the current one."""
        comments = [token.comment for token in self._tokens[start : self.index] if token.comment]
        return comments[-1] if comments else ""

    def value(self) -> str:
        """Step over a value, up to the ``;`` that ends it, and return it as written.

        Within brackets, a value may span lines. Outside brackets, a new line without a comma before
        it means that the ``;`` is missing.
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
        if len(text) > MAX_INITIAL:
            raise self.fault(first, f"the value is longer than {MAX_INITIAL} characters")
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
