"""Sending work items to workers and receiving their results: the scheduler, a state machine without I/O and clock, and the engines."""
