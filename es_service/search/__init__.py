"""Search methods as pure functions of a search's state: algorithms, maps, novelty, shaping, optimiser, statistics."""
