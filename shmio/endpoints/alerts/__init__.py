"""Alerts: a process that watches conditions, and notifies people and programs."""
