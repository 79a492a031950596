"""The alerts: a process that watches conditions, and notifies people and programs."""
