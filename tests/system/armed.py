"""The A50 cell, configured so that injections may change what is written to its controller."""

from __future__ import annotations

from shmio.testing.cell import CONFIG

ARMED = CONFIG.replace('connector = "s7"\n', 'connector = "s7"\nwritable = ["Outputs"]\narmed = true\n')
UNARMED = """
[[source]]
name = "unarmed"
connector = "s7"
layout = "db201.db"
writable = ["Outputs"]
host = "127.0.0.1"
port = {plc.port}
"""
"""Configuration of another source of the same controller, without injections toward the controller."""
