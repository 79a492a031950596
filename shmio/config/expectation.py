"""Checks the expectations of a campaign, as far as possible without a layout."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from shmio.config.declaration import faults_of_tables
from shmio.config.model import Expectation

MAX_EXPECTATIONS: Final = 256
"""Maximum number of expectations in one file."""


class Form(NamedTuple):
    """The required and the optional keys of a form of expectation, besides the key that determines the form."""

    needed: tuple[str, ...] = ()
    free: tuple[str, ...] = ()


FORMS: Final[Mapping[str, Form]] = {
    "formula": Form(),
    "then": Form(("when", "within_s")),
    "never": Form(),
    "always": Form(),
    "stays": Form(("for_s",), ("when",)),
    "max_rate": Form(("signal",)),
    "like": Form(("signal",), ("tolerance", "tolerance_s")),
}
"""The forms that an expectation can have, by the key that determines the form."""
_KEYS: Final = tuple(dict.fromkeys(key for name, form in FORMS.items() for key in (name, *form.needed, *form.free)))


def form_of(expectation: Expectation) -> str:
    """Return the key that determines the form of an expectation, which must have no faults."""
    return next(name for name in FORMS if getattr(expectation, name) is not None)


def expectation_faults(expectations: Sequence[Expectation]) -> Iterator[str]:
    """Yield a message for each fault that can be found without a layout; each begins with the faulty key."""
    return faults_of_tables("expect", "expectations", expectations, MAX_EXPECTATIONS, _contradictions)


def _contradictions(expectation: Expectation) -> Iterator[str]:
    given = [key for key in _KEYS if getattr(expectation, key) is not None]
    forms = [key for key in given if key in FORMS]
    if len(forms) != 1:
        if forms:
            yield f"{forms[1]}: this expectation already has {forms[0]}; give only one of {', '.join(FORMS)}"
        else:
            yield f"formula: an expectation needs one of {', '.join(FORMS)}"
        return
    form = forms[0]
    needed, free = FORMS[form]
    for key in needed:
        if key not in given:
            yield f"{key}: this key is needed with {form}"
    for key in given:
        if key not in (form, *needed, *free):
            takers = ", ".join(name for name, other in FORMS.items() if key in (*other.needed, *other.free))
            yield f"{key}: {form} takes no such key; the key is for {takers}"
    if form == "max_rate" and isinstance(expectation.signal, list):
        yield "signal: max_rate is for one signal; write an expectation for each"
