"""Starts, watches, restarts and stops the processes of an instance.

``policy`` has the graph of states and makes the decisions, without I/O. ``process`` spawns, ``fleet`` carries
decisions out, ``main`` runs the loop, ``health`` publishes the state, ``takeover`` and ``reload`` change what runs, and
``control`` takes requests.
"""
