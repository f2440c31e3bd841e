"""Translation of a JAX function to a graph: its jaxpr is evaluated on nodes instead of numbers. Needs JAX."""
