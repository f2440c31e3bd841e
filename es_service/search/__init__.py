"""Search methods as pure functions of a search's state: algorithms, steps, maps, novelty, shaping, statistics."""
