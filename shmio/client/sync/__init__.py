"""The synchronous client of ``shmio.v1``: every call waits.

``scripts/generate-sync-client`` makes these modules of those in :mod:`shmio.client.aio`. By hand there is only
:mod:`~shmio.client.sync.transport`.
"""
