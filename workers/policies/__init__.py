"""Parts of a policy: network, memory and output, each once for NumPy and for JAX."""
