"""Names of the outputs of episodes that are computed only where a run names them; `workers/episode.py` defines them.

Each is a named array of a result, beside those that every result has.
"""

from __future__ import annotations

AT_THE_END = ("first_observation", "last_observation", "last_reward", "success")
"""Outputs with one value for each episode: the observation of its reset, and what there is after its last valid
step."""
OF_STEPS = ("observation", "action", "reward", "done", "step_descriptor")
"""Outputs with a value for each valid step of an episode."""
TRANSITIONS = (*OF_STEPS, "last_observation")
"""What makes up the transitions of episodes: each step, and where the last one has led."""
