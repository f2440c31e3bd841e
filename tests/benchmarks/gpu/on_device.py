"""Run and time the kernels of `artefacts.py` on a GPU, unattended. It needs NumPy and CuPy only, and no other file of
this repository but those in its folder.

    python3 .gpu/ptx/on_device.py [--seconds 150]

Each result is a line of JSON on stdout and in `ptx.jsonl` in the folder $OUT (here if it is not set). Bits are compared
before anything is timed; a part that fails says so and the next one goes on. After --seconds the process ends itself.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import statistics
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
PHYSICS = ("ant_trap", "ant_maze")
"""Tasks whose physics is compared and timed."""
REGISTERS = (255, 168, 128, 96, 64)
"""Limits of registers of a thread for which there is code."""
STEPS_OF_LAUNCH = 50
REPEATS = 3
NAN = np.uint32(0x7FC00000)


def without_nans(words: np.ndarray) -> np.ndarray:
    """Words in which every NaN has the same bits."""
    return np.where(np.isnan(words.view(np.float32)), NAN, words)


def digest(words: np.ndarray) -> np.ndarray:
    """A word for each lane of words [word, lane], which one differing word always changes; all NaN count as the same."""
    factors = np.random.default_rng(7).integers(0, 2**31, len(words), dtype=np.uint32) * np.uint32(2) + np.uint32(1)
    return np.add.reduce(without_nans(words) * factors[:, None], axis=0, dtype=np.uint32)


def differing(found: np.ndarray, wanted: np.ndarray) -> int:
    """Number of words that differ; all NaN count as the same."""
    return int(np.count_nonzero(without_nans(found) != without_nans(wanted)))


class Results:
    """Lines of JSON on stdout and in a file."""

    def __init__(self) -> None:
        self.file = (Path(os.environ.get("OUT", ".")) / "ptx.jsonl").open("a")
        self.started = time.monotonic()

    def __call__(self, part: str, **found: Any) -> None:
        line = json.dumps({"part": part, **found, "at_s": round(time.monotonic() - self.started, 2)})
        print(line, flush=True)
        self.file.write(line + "\n")
        self.file.flush()


class Kernels:
    """The kernels of one file of code, called with arrays of the GPU and whole numbers."""

    def __init__(self, cupy: Any, name: str) -> None:
        self.cupy, self.module = cupy, cupy.RawModule(path=str(HERE / f"{name}.cubin"))

    def __call__(self, name: str, arrays: Iterable[Any], lanes: int, steps: int = 1, block: int = 32) -> None:
        """Run a kernel with a thread for each lane."""
        numbers = (np.int64(lanes), np.int64(steps))
        self.module.get_function(name)((-(-lanes // block),), (block,), (*arrays, *numbers))


def seconds_of(cupy: Any, work: Callable[..., object], *given: Any, repeats: int = REPEATS) -> list[float]:
    """Seconds of each of some runs of `work(*given)` on the GPU, after one that does not count."""
    work(*given)
    found = []
    for _ in range(repeats):
        start, end = cupy.cuda.Event(), cupy.cuda.Event()
        start.record()
        work(*given)
        end.record()
        end.synchronize()
        found.append(cupy.cuda.get_elapsed_time(start, end) / 1000)
    return found


def compare_operations(cupy: Any, say: Results) -> None:
    """Compare every operation with its definition."""
    file = np.load(HERE / "operations.npz")
    given, wanted, floats = file["given"], file["wanted"], file["floats"]
    found = cupy.asarray(np.full(wanted.shape, 0xAAAAAAAA, np.uint32))
    Kernels(cupy, "operations")("operations", [cupy.asarray(given), found], given.shape[1])
    found = cupy.asnumpy(found)
    wrong = {}
    for number, (one, other, is_float) in enumerate(zip(found, wanted, floats, strict=True)):
        bad = without_nans(one) != without_nans(other) if is_float else one != other
        if bad.any():
            lane = int(np.argmax(bad))
            words = [hex(word) for word in (*given[:, lane], one[lane], other[lane])]
            wrong[number] = {"count": int(bad.sum()), "first": words}
    say("operations", results=len(wanted), lanes=given.shape[1], words_wrong=sum(x["count"] for x in wrong.values()),
        wrong=wrong)  # fmt: skip


def compare_physics(cupy: Any, say: Results, task: str, registers: int) -> None:
    """Compare a task's resets and control steps with those of the processor: all in single steps, and all in one."""
    file, kernels = np.load(HERE / f"{task}.npz"), Kernels(cupy, f"{task}_{registers}")
    digests, actions = file["digests"], cupy.asarray(file["actions"])
    kept = dict(zip(file["numbers"].tolist(), file["states"], strict=True))
    steps, lanes = len(digests) - 1, digests.shape[1]
    states = cupy.asarray(np.full(kept[0].shape, 0xAAAAAAAA, np.uint32))
    keys = cupy.asarray(file["keys"])
    kernels("begin", [keys, states], lanes)
    wrong_lanes, wrong_words = [], {}
    for number in range(steps + 1):
        if number:
            kernels("physics", [states, actions[number - 1]], lanes)
        found = cupy.asnumpy(states)
        wrong_lanes.append(int(np.count_nonzero(digest(found) != digests[number])))
        if number in kept:
            wrong_words[number] = differing(found, kept[number])
    first = next((number for number, count in enumerate(wrong_lanes) if count), None)
    kernels("begin", [keys, states], lanes)
    kernels("physics", [states, actions], lanes, steps, block=64)
    say("physics_bits", task=task, registers=registers, lanes=lanes, steps=steps, words=states.shape[0],
        words_wrong_after=wrong_words, first_wrong_step=first, lanes_wrong_at_end=wrong_lanes[-1],
        words_wrong_in_one_launch=differing(cupy.asnumpy(states), kept[steps]))  # fmt: skip


def time_physics(cupy: Any, say: Results, task: str, sizes: Iterable[int], variants: Iterable[tuple[int, int]]) -> None:
    """Time a task's control steps without policies; a variant is (limit of registers, threads of a block)."""
    rng, file = np.random.default_rng(3), np.load(HERE / f"{task}.npz")
    few = rng.uniform(-1, 1, (STEPS_OF_LAUNCH, file["actions"].shape[1], 1024)).astype(np.float32)
    variants = list(variants)
    for lanes in sizes:
        actions = cupy.asarray(np.tile(few, (1, 1, lanes // 1024)))
        keys = cupy.asarray(rng.integers(0, 2**32, (4, lanes), dtype=np.uint32))
        states = cupy.asarray(np.zeros((len(file["states"][0]), lanes), np.uint32))
        for registers, block in variants:
            kernels = Kernels(cupy, f"{task}_{registers}")
            kernels("begin", [keys, states], lanes)
            runs = seconds_of(cupy, kernels, "physics", [states, actions], lanes, STEPS_OF_LAUNCH, block)
            rates = [round(lanes * STEPS_OF_LAUNCH / run) for run in runs]
            say("physics_speed", task=task, lanes=lanes, registers=registers, block=block,
                steps_per_s=round(statistics.median(rates)), us_per_step=round(
                    statistics.median(runs) / STEPS_OF_LAUNCH * 1e6, 1), runs=rates)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=150.0, help="the process ends itself after these")
    seconds = parser.parse_args().seconds
    say = Results()
    watch = threading.Timer(seconds, lambda: (say("stopped", why=f"{seconds} s are over"), os._exit(3)))
    watch.daemon = True
    watch.start()
    cupy = importlib.import_module("cupy")
    properties = cupy.cuda.runtime.getDeviceProperties(0)
    say("device", name=properties["name"].decode(), multiprocessors=properties["multiProcessorCount"],
        l2_bytes=properties["l2CacheSize"], driver=cupy.cuda.runtime.driverGetVersion())  # fmt: skip
    every = [(registers, block) for registers in REGISTERS for block in (32, 64, 128)]
    parts: list[Callable[[], None]] = [
        lambda: compare_operations(cupy, say),
        *(lambda t=t, r=r: compare_physics(cupy, say, t, r) for t in PHYSICS for r in (255, 128)),
        lambda: time_physics(cupy, say, "ant_trap", (1024, 4096, 16384, 65536, 262144), every),
        lambda: time_physics(cupy, say, "ant_maze", (1024, 8192, 16384, 65536), [(255, 32), (255, 64), (128, 64)]),
    ]
    failed = 0
    for part in parts:
        try:
            part()
        except Exception as error:  # the other parts may work
            failed += 1
            say("failed", error=repr(error), trace=traceback.format_exc()[-1500:])
    say("done", failed=failed)
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
