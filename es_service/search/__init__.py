"""The methods: pure functions on a search's state. Algorithms, maps, novelty, shaping, optimiser, statistics."""
