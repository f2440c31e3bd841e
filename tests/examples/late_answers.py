"""Ask and tell where answers come late and in any order: each call of a function is a job in a pool.

python tests/examples/late_answers.py FOLDER
"""

import sys
from concurrent.futures import ThreadPoolExecutor, as_completed

import numpy as np

from es_service import ask_tell
from tests.examples.beam import beam

LOW, HIGH = np.array([0.05, 0.05, 0.002]), np.array([0.4, 0.4, 0.05])
CONFIG = {
    "task": {"environment": "caller", "options": {"parameters": 3}},
    "search": {"algorithm": "map_elites", "batch": 32, "iso_sigma": 0.2, "evaluation_episodes": 1},
    "map": {"bounds": [[0.05, 0.4], [0.05, 0.4]], "cells": [8, 8]},
    "budget": {"generations": 10},
}


def search(folder):
    """The run, in `folder`; a call that was interrupted goes on."""
    with ask_tell(CONFIG, folder) as asking, ThreadPoolExecutor(4) as pool:
        while (asked := asking.ask()) is not None:
            designs = np.clip(LOW + (asked.parameters + 1.0) / 2.0 * (HIGH - LOW), LOW, HIGH)
            row_of = {pool.submit(beam, design): row for row, design in enumerate(designs)}
            fitness, descriptor = np.empty(len(asked)), np.empty((len(asked), 2))
            for job in as_completed(row_of):  # in the order in which they are done
                fitness[row_of[job]], descriptor[row_of[job]] = job.result()
            asking.tell(asked, fitness, descriptor)
        return asking.run


if __name__ == "__main__":
    print(search(sys.argv[1]).map.sort_values("fitness").tail())
