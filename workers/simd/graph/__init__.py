"""Graphs of scalar operations: the operations, constant folding, reduction of loops, and the order of computation.

This package needs only NumPy. The front end builds graphs and the back end translates them to code; neither imports the
other.
"""
