"""The asyncio client of ``shmio.v1``.

``scripts/generate-sync-client`` generates :mod:`shmio.client.sync` from these modules, except for
:mod:`~shmio.client.aio.transport`, of which each client has its own.
"""
