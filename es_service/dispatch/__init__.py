"""Sending work items to workers and receiving their results: the scheduler, a pure state machine, and the engines."""
