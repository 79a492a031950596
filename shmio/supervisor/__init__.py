"""Starts, watches, restarts and stops the processes of an instance.

``states`` is the graph and ``policy`` the decisions, both without I/O; ``process`` spawns, ``main`` runs the loop,
``control`` takes requests, ``status`` reads the segment for whoever asks.
"""
