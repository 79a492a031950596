"""The asyncio client of ``shmio.v1``.

``scripts/generate-sync-client`` generates :mod:`shmio.client.sync` from these modules. Only
``transport.py`` is written separately for each client.
"""
