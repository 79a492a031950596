"""The service ``shmio.v1``: typed registers, packed by type, with their quality.

``service`` has the table of the calls. ``selection`` resolves patterns to tables of registers,
once for all clients with the same patterns; ``tables`` makes updates of frames and writes.
``subscribe`` follows blocks for one subscriber. Its queue is the ring in shared memory, so a slow
client costs the endpoint no memory and learns exactly how many frames it missed.
"""
