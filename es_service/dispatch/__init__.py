"""Sending work items to workers and receiving their results: the scheduler, which has no I/O and no clock, and the engines."""
