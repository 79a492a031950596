"""Verbs of ``shmio-dump``, one module each, with ``execute(arguments) -> exit status``."""
