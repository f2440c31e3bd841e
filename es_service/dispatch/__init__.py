"""Sending work items to workers and receiving results: the scheduler, which has no I/O and no clock, and engines."""
