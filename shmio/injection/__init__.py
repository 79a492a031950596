"""What a declared injection means: its target, its condition, its operation, when it is active. Pure, no I/O."""

from shmio.injection.program import Program, compile_program

__all__ = ["Program", "compile_program"]
