"""The alert process: it watches conditions, and notifies people and programs."""
