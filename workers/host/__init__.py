"""Episodes of tasks whose environments are Python objects, in NumPy; nothing here imports JAX."""
