"""The asyncio client of ``shmio.v1``: one module for each kind of call that stays open."""
