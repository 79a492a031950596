"""Addresses in tag tables, which say where a device has a register.

Each protocol has a module here, except S7: see ``shmio.layout.s7``.
"""
