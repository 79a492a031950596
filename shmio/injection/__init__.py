"""Compiles and evaluates declared injections. No I/O."""

from shmio.injection.program import Program, compile_program

__all__ = ["Program", "compile_program"]
