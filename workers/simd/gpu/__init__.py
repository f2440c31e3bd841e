"""Training episodes on a GPU by our compiler, with the bits of those on processors: one environment a thread."""
