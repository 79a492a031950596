"""Replaces functions of a running program by those of a changed source file, without a new import."""

from __future__ import annotations

import ast
import builtins
import gc
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from inspect import CO_OPTIMIZED
from pathlib import Path
from types import CodeType, FunctionType


@dataclass(frozen=True)
class Change:
    """The one outermost function in which two versions of a source file differ."""

    old: CodeType
    new: CodeType

    @property
    def lines(self) -> range:
        """Lines of the function, including functions defined in it."""
        return range(self.old.co_firstlineno, max(_lines(self.old)) + 1)

    def apply(self, path: Path) -> bool:
        """Replace the function's code wherever it is used. Return False if the function is not found."""
        gc.unfreeze()
        done = False
        for function in gc.get_objects():
            if isinstance(function, FunctionType) and _same(function.__code__, self.old, path):
                function.__code__ = self.new
                done = True
        return done


def change(old: str, new: str, path: Path) -> Change | None:
    """Return the function in which two sources differ. Return None if they differ elsewhere or in several functions."""
    olds, news = _functions(compile(old, path, "exec")), _functions(compile(new, path, "exec"))
    pairs = [(before, after) for before, after in zip(olds, news, strict=False) if before != after]
    if len(pairs) != 1 or pairs[0][0].co_freevars != pairs[0][1].co_freevars:
        return None
    return Change(*pairs[0])


def watch(sources: Iterable[Path]) -> set[tuple[str, int]]:
    """Record calls: each outermost function that runs adds its file and first line to the returned set."""
    called: set[tuple[str, int]] = set()
    vars(builtins)["_mutants_called"] = called.add
    watched: dict[tuple[str, str, int], CodeType] = {}
    for path in sources:
        tree = ast.parse(path.read_text())
        for function in _outermost(tree):
            first = function.decorator_list[0].lineno if function.decorator_list else function.lineno
            told = ast.parse(f"_mutants_called(({str(path)!r}, {first}))").body[0]
            function.body.insert(0, told)  # this removes the docstring
        for code in _functions(compile(ast.fix_missing_locations(tree), path, "exec")):
            watched[str(path), code.co_qualname, code.co_firstlineno] = code
    gc.unfreeze()
    for found in gc.get_objects():
        if isinstance(found, FunctionType):
            old = found.__code__
            new = watched.get((old.co_filename, old.co_qualname, old.co_firstlineno))
            if new is not None and new.co_freevars == old.co_freevars:
                found.__code__ = new
    return called


def _outermost(tree: ast.Module | ast.ClassDef) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
        elif isinstance(node, ast.ClassDef):
            yield from _outermost(node)


def _functions(code: CodeType) -> Iterator[CodeType]:
    for part in code.co_consts:
        if isinstance(part, CodeType):
            if part.co_flags & CO_OPTIMIZED:
                yield part
            else:  # of a class
                yield from _functions(part)


def _lines(code: CodeType) -> Iterator[int]:
    yield from (line for _, _, line in code.co_lines() if line)
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield from _lines(part)


def _same(code: CodeType, old: CodeType, path: Path) -> bool:
    return (
        code.co_firstlineno == old.co_firstlineno
        and code.co_qualname == old.co_qualname
        and code.co_filename == str(path)
    )
