"""The synchronous client of ``shmio.v1``: every call waits.

``scripts/generate-sync-client`` generates these modules from :mod:`shmio.client.aio`, except for
:mod:`~shmio.client.sync.transport`, which is written by hand.
"""
