"""Names of the outputs of episodes that are computed only where a run names them; `workers/episode.py` defines them.

Each is a named array of a result, beside those that every result has.
"""

from __future__ import annotations

import re
from collections.abc import Collection

METRICS = "metrics"
"""Output with the metrics that a task records of an episode, [M]: those of `TaskSpec.metric_names`."""
AT_THE_END = ("first_observation", "last_observation", "last_reward", "success", METRICS)
"""Outputs with one value for each episode: the observation of its reset, and what there is after its last valid
step."""
OF_STEPS = ("observation", "action", "reward", "done", "step_descriptor")
"""Outputs with a value for each valid step of an episode."""
TRANSITIONS = (*OF_STEPS, "last_observation")
"""What makes up the transitions of episodes: each step, and where the last one has led."""
METRIC_FORM = "up to 40 letters, digits and _, a letter first"
"""What the name of a metric must be, in words: one of a search, of a task, or of a program that runs a session."""


TAKEN = ("last", "sum", "mean", "min", "max")
"""What a metric of a config may take of the values that a key of `info` has in an episode."""
NAME_OF_METRIC = "[A-Za-z][A-Za-z0-9_]{0,39}"
"""Regular expression of METRIC_FORM."""
CHOSEN_METRIC = f"^{NAME_OF_METRIC}(:({'|'.join(TAKEN)}))?$"
"""Regular expression of a metric that a config chooses: KEY, or KEY:TAKEN."""


def wrong_metric_names(names: Collection[object]) -> list[str]:
    """Names that no metrics can have, or that differ from another one only in upper and lower case, as columns must
    not."""
    wrong = [repr(name) for name in names if not isinstance(name, str) or not re.fullmatch(NAME_OF_METRIC, name)]
    folded = [str(name).casefold() for name in names]
    return wrong or [repr(name) for name in names if folded.count(str(name).casefold()) > 1]
