"""Injections in a source's process: the layers between the device and everybody else."""
