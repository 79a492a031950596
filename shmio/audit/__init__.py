"""The audit log: who did what to an instance, from where, and with what outcome.

Each process that receives commands writes its own lines (:mod:`shmio.audit.trail`), because it
knows who sent the commands. All processes of an instance write to one file
(:mod:`shmio.audit.file`).
"""
