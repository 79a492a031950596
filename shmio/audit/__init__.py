"""The audit log: who did what to an instance, from where, and with what outcome.

Every process that takes commands writes its lines itself (:mod:`shmio.audit.trail`), because it knows
who sent them. All processes of an instance write to one file (:mod:`shmio.audit.file`).
"""
