"""A graph of scalar operations: what it is made of, how it folds, how its loops shrink, in which order it is computed.

Needs NumPy and nothing else. The front end builds graphs and the back end writes them as code; neither knows the other.
"""
