"""A question about the controller itself, which the session asks between reads of data. No I/O.

Only one question is open at a time, and its request is sent after those of a read. A controller may
refuse a question, or close the connection without an answer. No session asks a question again after
``PATIENCE`` malformed answers in a row, or if the controller has never answered the question and
``PATIENCE`` connections were lost while it was open.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, Final

from shmio.connectors.s7.explain import RefusedError
from shmio.connectors.s7.userdata import Service, next_request, parse_answer, request
from shmio.errors import ConnectorError

PATIENCE: Final = 2
"""Number of lost connections, or of malformed answers in a row, after which a question is not asked again."""
MAX_PARTS: Final = 64
MAX_ANSWER_BYTES: Final = 16_384


class Query(ABC):
    """A question that the session asks periodically, or once in each session."""

    optional: ClassVar[bool] = False
    """True if the session skips this question once the controller has failed to answer the query for its mode."""

    def __init__(self, service: Service, interval_ns: int | None) -> None:
        """Create a question to ask every ``interval_ns``; if that is None, to ask once in each session."""
        self.service = service
        self._interval_ns = interval_ns
        self._due_ns: int | None = 0
        self.deadline_ns = 0
        """Time by which an open question must be answered, in ns of CLOCK_MONOTONIC."""
        self._known = False  # the controller has answered at least once
        self._failures = self._malformed = 0
        self.supported = True
        """False if no session asks the question again."""
        self.silent = False
        """True if ``supported`` is False because the controller never answered the question."""
        self.count = 1
        self.sent = 0
        self.complete = True
        self.begun_after = 0
        """Number of answers received in the session before the question was asked."""
        self._answer = bytearray()
        self._sequence = 0
        self.again: Callable[[Query], None] = lambda _: None
        """Called to send the request for the next part of an answer."""

    def due(self, now_ns: int) -> bool:
        """Return whether it is time to ask the question."""
        return self.supported and self.complete and self._due_ns is not None and now_ns >= self._due_ns

    def overdue(self, now_ns: int) -> bool:
        """Return whether the question is open and its deadline has passed."""
        return not self.complete and now_ns >= self.deadline_ns

    def begin(self, now_ns: int, deadline_ns: int) -> None:
        """Open the question, which the controller must answer by ``deadline_ns``."""
        self._due_ns = None if self._interval_ns is None else now_ns + self._interval_ns
        self.deadline_ns = deadline_ns
        self.count, self.sent = 1, 0
        self.complete = False
        self._answer.clear()

    def take(self, count: int, first: int) -> bytes:
        """Return the request of the question or, after a first part of the answer, the request for the next part."""
        begin, self.sent = self.sent, self.sent + count
        if begin:
            return next_request(first & 0xFFFF, self.service, self._sequence)
        return request(first & 0xFFFF, self.service, self.data())

    def accept(self, index: int, frame: memoryview) -> None:
        """Process the answer, or a part of it.

        Raises:
            ConnectorError: The answer does not match the request.

        """
        try:
            try:
                part = parse_answer(frame, self.service)
                self._answer += part.data
                if part.more:
                    if index + 1 == MAX_PARTS or len(self._answer) > MAX_ANSWER_BYTES:
                        raise RefusedError(f"the answer to '{self.service.name}' is too long")
                    self._sequence = part.sequence
                    self.count += 1
                    self.again(self)
                    return
                self.complete = True
                self._known = True
                self.answered(bytes(self._answer))
                self._malformed = 0
            except RefusedError as refusal:
                self.complete = True
                self.refused(refusal)
        except ConnectorError:
            self.complete = True
            self._malformed += 1
            if self._malformed == PATIENCE:
                self._give_up("does not answer as expected")
            raise

    def lost(self, *, alive: bool = True) -> None:
        """Close an open question, because the connection was lost.

        If this happens on ``PATIENCE`` connections, and the controller has never answered the
        question, the question is never asked again. A connection counts only if the controller was
        ``alive``, which means that it answered other requests in the meantime.
        """
        self._due_ns = 0
        if self.complete:
            return
        self.complete = True
        self._failures += alive
        if not self._known and self._failures == PATIENCE:
            self.silent = True
            self._give_up("does not answer the query")

    def skip(self) -> None:
        """Do not ask the question again in this session."""
        self._due_ns = None

    def ask_now(self) -> None:
        """Make the question due at once."""
        self._due_ns = 0

    def _give_up(self, why: str) -> None:
        self.supported = False
        self.given_up(why)

    @abstractmethod
    def data(self) -> bytes:
        """Return the data of the request."""

    @abstractmethod
    def answered(self, data: bytes) -> None:
        """Process the data of a whole answer.

        Raises:
            ConnectorError: The data do not match the request.

        """

    @abstractmethod
    def refused(self, refusal: RefusedError) -> None:
        """Handle the controller's refusal to answer this query."""

    @abstractmethod
    def given_up(self, why: str) -> None:
        """Handle the decision never to ask the question again.

        ``why`` is the reason; it continues the words "the controller …".
        """
