"""Starts, watches, restarts and stops the processes of an instance.

``states`` is the graph of states and ``policy`` makes the decisions, both without I/O. ``process``
spawns, ``fleet`` carries decisions out, ``main`` runs the loop, ``reload`` applies changes, and
``control`` takes requests.
"""
