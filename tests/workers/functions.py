"""Functions of parameters as tasks for tests."""

from __future__ import annotations

import math
import os
import subprocess
import time
from pathlib import Path

import numpy as np

from es_service.protocol.options import Option


def hill(parameters):
    """A hill whose top is at width 3 and height 0.2; its descriptor are the two."""
    width, height, rest = parameters
    return 10.0 - (width - 3.0) ** 2 - 100.0 * (height - 0.2) ** 2 - rest**2, (width, height)


hill.parameters = {"width": (1.0, 5.0), "height": (0.0, 1.0), "rest": None}
hill.start = {"height": 0.9, "rest": 0.5}
hill.descriptor_names = ("wide", "high")
hill.descriptor_bounds = hill.parameters["width"], hill.parameters["height"]
hill.deterministic = True
hill.least_fitness = -100.0


class Noisy:
    """A parabola with noise of the seed, in as many dimensions as one likes."""

    parameters = 4
    options = {"noise": Option(0.5, low=0.0)}  # noqa: RUF012

    def __init__(self, noise):
        self.noise = noise

    def __call__(self, parameters, seed):
        return -float(np.square(parameters - 1.0).sum()) + self.noise * np.random.default_rng(seed).normal()


def fragile(parameters):
    """It fails in three of four quarters, in three ways."""
    x, y = parameters
    if x > 0.0 and y > 0.0:
        raise ValueError("this quarter is forbidden")
    if x > 0.0:
        return math.nan
    return "many" if y > 0.0 else x + y


fragile.parameters = ("x", "y")


def forgetful(parameters):
    """It returns nothing."""
    parameters.sum()


forgetful.parameters = {f"x{index}": (0.0, 1.0) for index in range(20)}


def tower(parameters):
    """Three quarters of its designs are infeasible; a design beyond 0.95 is a failure."""
    a, b = parameters
    if a + b < 1.2:
        return -math.inf, (a, b)
    return (math.nan if max(a, b) > 0.95 else -((a - 0.9) ** 2) - (b - 0.9) ** 2), (a, b)


tower.parameters = {"a": (0.0, 1.0), "b": (0.0, 1.0)}
tower.descriptor_names, tower.descriptor_bounds = ("a", "b"), ((0.0, 1.0), (0.0, 1.0))
tower.start = {"a": 0.9, "b": 0.9}


def nowhere(parameters):
    """All is infeasible, and has no place."""
    return -math.inf, (math.nan, math.nan)


nowhere.parameters, nowhere.descriptor_names, nowhere.descriptor_bounds = 2, ("a", "b"), ((0.0, 1.0), (0.0, 1.0))


class Uncalled:
    """Its objects are no functions."""

    parameters = 2


def starting(parameters):
    """It starts a process, and returns its number."""
    return subprocess.Popen(["sleep", "1000"]).pid


starting.parameters = 1


def restless(parameters):
    """Its noise has no seed."""
    return float(parameters.sum()) + np.random.default_rng().normal()


restless.parameters = ("left", "right")


def deadly(parameters):
    """It ends its process for one member of each pair."""
    if parameters[0] > 0.0:
        os._exit(3)
    return float(parameters.sum())


deadly.parameters = ("left", "right")


def doomed(parameters):
    """A function that always ends its process."""
    os.write(2, b"singular matrix\n")
    os._exit(3)


doomed.parameters = {"width": (0.0, 1.0)}


def slow(parameters):
    """It hangs, or ends its process, once: where a file says so, and the first parameter is positive."""
    fault = Path(os.environ["HOST_FAULT"])
    kind = fault.read_text() if fault.exists() else ""
    if kind and parameters[0] > 0.05:  # a member and no centre
        fault.unlink(missing_ok=True)
        if kind == "exit":
            os.write(2, b"no licence is left\n")
            os._exit(3)
        time.sleep(1000.0)
    return float(parameters.sum())


slow.parameters = 3


def patient(parameters):
    """A call with a positive parameter waits for one with a negative one, which is in another work item."""
    place = Path(os.environ["PATIENT_FOLDER"])
    if parameters[0] < 0.0:
        (place / "met").touch()
    elif parameters[0] > 0.0:
        (place / "begun").touch()
        until = time.monotonic() + 60.0
        while not (place / "met").exists():
            if time.monotonic() > until:
                raise TimeoutError("the other work item has not begun")
            time.sleep(0.01)
    return float(parameters.sum())


patient.parameters = 1
patient.deterministic = True
