"""Describe a task such as `brax:ant` or `package.module:Class`, in a separate process because this imports JAX.

    python -m workers.describe NAME

Prints one line of JSON: {"task": fields of a TaskSpec} or {"problem": text}.
"""

from __future__ import annotations

import dataclasses
import json
import sys

from workers.environments import TaskError, describe_environment
from workers.simd.episodes.rollout import why_not


def main(name: str) -> None:
    """Print the description of a task, or the problem with it, as JSON."""
    try:
        task = describe_environment(name)
        answer = {"task": dataclasses.asdict(dataclasses.replace(task, no_simd=why_not(task)))}
    except TaskError as error:
        answer = {"problem": str(error)}
    print(json.dumps(answer))


if __name__ == "__main__":
    main(sys.argv[1])
