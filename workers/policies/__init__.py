"""What a policy computes: network, memory and output, each once for NumPy and for JAX."""
