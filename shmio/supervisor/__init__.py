"""Starts, watches, restarts and stops the processes of an instance.

``policy`` has the graph of states and makes the decisions, without I/O. ``process`` starts and
signals one process, ``fleet`` carries out the decisions for all processes, and ``main`` runs the
loop. ``health`` publishes the state of the instance. ``takeover`` and ``reload`` change an instance
to match its plan. ``local_commands`` writes to the audit log what local programs do.
``shmio.control`` receives requests.
"""
