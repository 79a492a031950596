"""Runs trials on workers of other hosts, by a work queue of NATS JetStream.

``pool.py`` is the search's side, and ``worker.py`` the workers'. Both use the subjects and messages
of ``exchange.py``. ``bundle.py`` makes the bundle of files that a worker receives, and
``environment.py`` compares versions. See docs/how-to/find-a-failing-alteration.md.
"""
