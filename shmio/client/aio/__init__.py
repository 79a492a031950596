"""The asyncio client of ``shmio.v1``.

``scripts/generate-sync-client`` generates :mod:`shmio.client.sync` from these modules, except for
``transport.py``, which each client has.
"""
