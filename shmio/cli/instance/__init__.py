"""Verbs of ``shmio-supervisor``, one module each, with ``execute(arguments) -> exit status``."""
