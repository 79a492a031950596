"""The service ``shmio.v1``: typed registers with their quality, packed by type.

``service`` lists the calls. ``selection`` resolves patterns to tables of registers, once for all
clients with equal patterns. ``tables`` makes updates from frames and writes. ``subscribe`` follows
blocks for one subscriber, with the ring in shared memory as the subscriber's queue. So a slow
client needs no memory in the endpoint, and is told exactly how many frames it has missed.
"""
