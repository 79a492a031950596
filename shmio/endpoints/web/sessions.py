"""Sessions: who uses the page, and what each user may do.

A user who shows a token gets a session. Its cookie is HttpOnly, so that scripts cannot read it, and
SameSite, so that browsers do not send it with requests of other sites' pages. A session is valid
only on the host that opened it, so a stolen cookie is useless elsewhere.
"""

from __future__ import annotations

import hmac
import secrets
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from shmio.audit.trail import Actor
from shmio.config.credentials import Secret, digest
from shmio.config.model import ROLES

COOKIE: Final = "shmio_session_{}"
"""Name of the cookie. It includes the instance's name, because browsers share cookies among a host's ports."""
MAX_SESSIONS: Final = 256
"""Maximum number of sessions. If there are more, the oldest of the user who has most of them ends."""
MAX_AGE_S: Final = 12 * 3600
"""Time in s after which a session ends, so that the user must show the token again."""


@dataclass(frozen=True, slots=True)
class User:
    """A user of the page. ``name`` is the name of the user's token; empty if the user has shown none."""

    name: str
    roles: frozenset[str]
    host: str = ""

    @property
    def actor(self) -> Actor:
        """The user's identity for the audit log."""
        return Actor("token" if self.name else "anonymous", self.name, self.host)

    @property
    def client(self) -> str:
        """The name under which the user's pages and sessions count towards limits: of the token, or else the host."""
        return f"token {self.name}" if self.name else self.host

    @property
    def listed_roles(self) -> list[str]:
        """The user's roles, in the order in which roles are always listed."""
        return [role for role in ROLES if role in self.roles]


@dataclass(slots=True)
class _Session:
    user: User
    secret: Secret
    opened_s: float
    ends: set[Callable[[], None]] = field(default_factory=set)
    """Functions that are called when the session is closed."""


class Sessions:
    """The sessions of all users."""

    def __init__(
        self, tokens: Sequence[Secret], anonymous: Iterable[str], now: Callable[[], float] = time.monotonic
    ) -> None:
        """Create an empty set of sessions.

        Args:
            tokens: The tokens that users may show.
            anonymous: Roles of users who show no token.
            now: Returns the time in s.

        """
        self._tokens = tokens
        self._anonymous = frozenset(anonymous)
        self._now = now
        self._users: OrderedDict[bytes, _Session] = OrderedDict()

    @property
    def takes_tokens(self) -> bool:
        """True if there are tokens that users can show."""
        return bool(self._tokens)

    def take(self, tokens: Sequence[Secret]) -> int:
        """Replace the tokens. End the sessions whose tokens are gone or changed, and return their number."""
        self._tokens = tokens
        gone = [key for key, one in self._users.items() if one.secret not in tokens]
        for key in gone:
            self._ended(self._users.pop(key))
        return len(gone)

    def user(self, cookie: str | None, host: str) -> User:
        """Return the user of the session with this cookie on this host; an anonymous user if there is none."""
        found = self._found(cookie, host)
        return User("", self._anonymous, host) if found is None else found.user

    def left_s(self, cookie: str | None, host: str) -> float | None:
        """Return the time in s until a session ends; None if there is no such session."""
        found = self._found(cookie, host)
        return None if found is None else found.opened_s + MAX_AGE_S - self._now()

    def on_end(self, cookie: str | None, host: str, end: Callable[[], None]) -> Callable[[], None]:
        """Register a function to call when a session is closed. Return a function that cancels this."""
        found = self._found(cookie, host)
        if found is None:
            return lambda: None
        found.ends.add(end)
        return lambda: found.ends.discard(end)

    def _found(self, cookie: str | None, host: str) -> _Session | None:
        found = None if cookie is None else self._users.get(digest(cookie.encode()))
        if found is not None and found.user.host == host and self._now() - found.opened_s < MAX_AGE_S:
            return found
        return None

    def open(self, token: str, host: str) -> tuple[str, User] | None:
        """Open a session for the owner of a token.

        Returns:
            The session's cookie, and the user; None if there is no such token.

        """
        secret = self._secret(token)
        if secret is None:
            return None
        user = self._user(secret, host)
        cookie = secrets.token_urlsafe(32)
        self._users[digest(cookie.encode())] = _Session(user, secret, self._now())
        if len(self._users) > MAX_SESSIONS:
            most, _ = Counter(one.user.client for one in self._users.values()).most_common(1)[0]
            oldest = next(key for key, one in self._users.items() if one.user.client == most)
            self._ended(self._users.pop(oldest))
        return cookie, user

    def owner(self, token: str, host: str) -> User | None:
        """Return the owner of a token; None if there is no such token. The time that this takes depends on no token."""
        secret = self._secret(token)
        return None if secret is None else self._user(secret, host)

    def _secret(self, token: str) -> Secret | None:
        shown, found = digest(token.strip().encode()), None
        for secret in self._tokens:
            if hmac.compare_digest(secret.digest, shown):
                found = secret
        return found

    def _user(self, secret: Secret, host: str) -> User:
        return User(secret.name, secret.roles | self._anonymous, host)

    def close(self, cookie: str) -> None:
        """Close the session with this cookie, and its pages."""
        session = self._users.pop(digest(cookie.encode()), None)
        if session is not None:
            self._ended(session)

    def _ended(self, session: _Session) -> None:
        for end in tuple(session.ends):
            end()
