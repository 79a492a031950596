"""Base class of all sections of ``supervisor.toml``."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

Text = Annotated[str, Meta(min_length=1)]
Texts = Annotated[list[Text], Meta(min_length=1)]


class Section(Struct, forbid_unknown_fields=True, kw_only=True):
    """A table of the file; unknown keys are refused."""
