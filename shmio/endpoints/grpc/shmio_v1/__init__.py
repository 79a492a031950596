"""Our own service, ``shmio.v1``: registers typed, packed by type, and with their quality.

``columns`` turns images of a block into packed arrays, ``selection`` is what some patterns name on one block, made once
for all who name it. ``stream`` follows a block for a subscriber: the ring in shared memory is its queue, so a slow
client costs the endpoint no memory and is told exactly what it missed. ``service`` has the calls.
"""
