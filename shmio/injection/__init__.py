"""Compiles and runs the injections that users declare. This package does no I/O."""

from shmio.injection.program import Program, compile_program

__all__ = ["Program", "compile_program"]
