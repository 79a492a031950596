"""The verbs of ``shmio-supervisor``: a module each, with ``execute(arguments) -> exit status``."""
