"""The asyncio client of ``shmio.v1``.

``scripts/generate-sync-client`` makes :mod:`shmio.client.sync` of these modules, but for
:mod:`~shmio.client.aio.transport`, which each of the two has of its own.
"""
