"""Reinforcement learners of others on our tasks, certified as our searches are; see `__main__`."""
