"""Collect a bounded number of diagnostics."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from shmio.errors import Diagnostic, LayoutError, ShmioError

MAX_ERRORS = 100
MAX_WARNINGS = 1000


class TooManyErrors(ShmioError):  # noqa: N818  (a signal to stop, never seen outside the compiler)
    """The compiler has found ``MAX_ERRORS`` errors, and does not read the rest of the sources."""


class Report:
    """Errors and warnings of one compilation."""

    def __init__(self, files: Sequence[str]) -> None:
        self._order = {file: position for position, file in enumerate(files)}
        self._seen: set[Diagnostic] = set()
        self.errors: list[Diagnostic] = []
        self.warnings: list[Diagnostic] = []

    def add(self, diagnostic: Diagnostic) -> None:
        """Keep a diagnostic, unless it is a duplicate or a consequence of the error before it.

        An error at the same place as the error before it counts as a consequence.

        Raises:
            TooManyErrors: The report has reached ``MAX_ERRORS``.

        """
        if diagnostic in self._seen:
            return
        self._seen.add(diagnostic)
        if diagnostic.severity == "error":
            if self.errors and _place(self.errors[-1]) == _place(diagnostic):
                return
            self.errors.append(diagnostic)
            if len(self.errors) >= MAX_ERRORS:
                raise TooManyErrors
        elif len(self.warnings) < MAX_WARNINGS:
            self.warnings.append(diagnostic)

    def extend(self, diagnostics: Iterable[Diagnostic]) -> None:
        """Add several diagnostics; see :meth:`add`."""
        for diagnostic in diagnostics:
            self.add(diagnostic)

    def raise_errors(self) -> None:
        """Raise LayoutError with all diagnostics, errors in source order, if there is any error."""
        if self.errors:
            self.errors.sort(key=lambda error: (self._order.get(error.file, 0), error.line, error.column))
            lines = [str(error) for error in self.errors]
            if len(self.errors) >= MAX_ERRORS:
                lines.append(f"stopped after {MAX_ERRORS} errors")
            raise LayoutError("\n".join(lines), (*self.errors, *self.warnings))


def _place(diagnostic: Diagnostic) -> tuple[str, int, int]:
    return diagnostic.file, diagnostic.line, diagnostic.column
