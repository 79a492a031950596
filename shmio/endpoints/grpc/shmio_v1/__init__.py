"""The service ``shmio.v1``: typed registers, packed by type, with their quality.

``columns`` packs a block's image into arrays; ``selection`` resolves patterns to a table of
registers, once for all clients with the same patterns. ``follow`` follows a block for one
subscriber. Its queue is the ring in shared memory, so a slow client costs the endpoint no
memory and learns exactly how many frames it missed. ``service`` has the calls.
"""
