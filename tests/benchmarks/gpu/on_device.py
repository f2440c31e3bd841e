"""Run and time the kernels of `artefacts.py` on a GPU, unattended. It needs NumPy and CuPy only, and no other file of
this repository but those in its folder.

    python3 .gpu/ptx/on_device.py [--seconds 150] [PART ...]

Each result is a line of JSON on stdout and in `ptx.jsonl` in the folder $OUT (here if it is not set). Bits are compared
before anything is timed; a part that fails says so and the next one goes on. After --seconds the process ends itself.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import json
import lzma
import os
import statistics
import sys
import tempfile
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
ACTIONS = 8
"""Numbers of an action of these tasks."""
VARIANTS = {
    "255": (255, False),
    "128": (128, False),
    "quick_255": (255, True),
    "quick_168": (168, True),
    "quick_128": (128, True),
    "quick_96": (96, True),
}
"""Code by name: (most registers of a thread, whether quotients are those of `ptx.QuickWriter`)."""
ROLLOUTS = ("ant_maze", "ant_trap")
"""Tasks whose training episodes are compared and timed."""
POLICIES = {"policy_1_2": 4, "policy_1_4": 4, "policy_2_2": 8, "policy_2_3": 8, "policy_4_1": 16}
"""Kernels of policies -> pairs of a block."""
STEPS_OF_LAUNCH = 50
STEPS_OF_GRAPH = 25
CODE_KIB = (32, 64, 96, 112, 128, 144, 160, 192, 256)
"""Sizes of loops of products and sums, which show what a loop costs that the caches of code do not hold."""
REPEATS = 3
PARTS = ("operations", "physics_bits", "rollout_bits", "rollout_speed", "physics_speed", "code_speed")
NAN = np.uint32(0x7FC00000)


def without_nans(words: np.ndarray) -> np.ndarray:
    """Words in which every NaN has the same bits."""
    return np.where(np.isnan(words.view(np.float32)), NAN, words)


def digest(words: np.ndarray) -> np.ndarray:
    """A word for each lane of words [word, lane], which one differing word always changes; all NaN are the same."""
    factors = np.random.default_rng(7).integers(0, 2**31, len(words), dtype=np.uint32) * np.uint32(2) + np.uint32(1)
    return np.add.reduce(without_nans(words) * factors[:, None], axis=0, dtype=np.uint32)


def differing(found: np.ndarray, wanted: np.ndarray) -> int:
    """Number of words that differ; all NaN count as the same."""
    return int(np.count_nonzero(without_nans(found) != without_nans(wanted)))


def physics_actions(steps: int, size: int, lanes: int) -> np.ndarray:
    """Random actions [step, action, lane]."""
    return np.random.default_rng(1).uniform(-1, 1, (steps, size, lanes)).astype(np.float32)


class Results:
    """Lines of JSON on stdout and in a file."""

    def __init__(self) -> None:
        self.file = (Path(os.environ.get("OUT", ".")) / "ptx.jsonl").open("a")
        self.started = time.monotonic()

    def __call__(self, part: str, **fields: Any) -> None:
        line = json.dumps({"part": part, **fields, "at_s": round(time.monotonic() - self.started, 2)})
        print(line, flush=True)
        self.file.write(line + "\n")
        self.file.flush()


@functools.cache
def unpacked(name: str) -> str:
    """Path of a file of code, unpacked."""
    folder = Path(tempfile.gettempdir()) / f"kernels_{os.getpid()}"
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.cubin"
    path.write_bytes(lzma.decompress((HERE / f"{name}.cubin.xz").read_bytes()))
    return str(path)


class Kernels:
    """The kernels of one file of code, called with arrays of the GPU and whole numbers."""

    def __init__(self, cupy: Any, name: str) -> None:
        self.function = functools.cache(cupy.RawModule(path=unpacked(name)).get_function)

    def __call__(self, name: str, arrays: Iterable[Any], lanes: int, steps: int = 1, block: int = 32) -> None:
        """Run a kernel with a thread for each lane."""
        numbers = (np.int64(lanes), np.int64(steps))
        self.function(name)((-(-lanes // block),), (block,), (*arrays, *numbers))


def seconds_of(cupy: Any, work: Callable[..., object], *given: Any, repeats: int = REPEATS) -> list[float]:
    """Seconds of each of some runs of `work(*given)` on the GPU, after one that does not count."""
    work(*given)
    durations = []
    for _ in range(repeats):
        start, end = cupy.cuda.Event(), cupy.cuda.Event()
        start.record()
        work(*given)
        end.record()
        end.synchronize()
        durations.append(cupy.cuda.get_elapsed_time(start, end) / 1000)
    return durations


def compare_operations(cupy: Any, say: Results) -> None:
    """Compare every operation with its definition."""
    file = np.load(HERE / "operations.npz")
    given, wanted, floats = file["given"], file["wanted"], file["floats"]
    results = cupy.asarray(np.full(wanted.shape, 0xAAAAAAAA, np.uint32))
    Kernels(cupy, "operations")("operations", [cupy.asarray(given), results], given.shape[1])
    results = cupy.asnumpy(results)
    wrong = {}
    for number, (result, other, is_float) in enumerate(zip(results, wanted, floats, strict=True)):
        bad = without_nans(result) != without_nans(other) if is_float else result != other
        if bad.any():
            lane = int(np.argmax(bad))
            words = [hex(word) for word in (*given[:, lane], result[lane], other[lane])]
            wrong[number] = {"count": int(bad.sum()), "first": words}
    say("operations", results=len(wanted), lanes=given.shape[1], words_wrong=sum(x["count"] for x in wrong.values()),
        wrong=wrong)  # fmt: skip


def compare_division(cupy: Any, say: Results, lanes: int = 1 << 22) -> None:
    """Compare quick quotients and roots with those of float64, rounded once, of ordinary numbers and of all."""
    rng = np.random.default_rng(5)
    kernels = Kernels(cupy, "division")
    for what, low, high in (("ordinary", 107, 147), ("all", 0, 256)):
        bits = rng.integers(0, 2**23, (3, lanes), dtype=np.uint32)
        bits |= rng.integers(low, high, (3, lanes), dtype=np.uint32) << np.uint32(23)
        bits[:2] |= rng.integers(0, 2, (2, lanes), dtype=np.uint32) << np.uint32(31)
        given = bits.view(np.float32)
        given[:, ::64] = rng.choice(np.array([0.0, -0.0, 1.0, 3.0], np.float32), (3, lanes // 64))
        given[2] = np.abs(given[2])
        with np.errstate(all="ignore"):
            a, b, c = (np.where(np.abs(x) < 2.0**-126, x * 0, x).astype(np.float64) for x in given)
            exact = np.stack([a / b, np.sqrt(c)])
            wanted = np.where(np.abs(exact) < 2.0**-126 - 2.0**-151, exact * 0, exact).astype(np.float32)
        results = cupy.empty((2, lanes), np.uint32)
        kernels("division", [cupy.asarray(bits), results], lanes, block=128)
        results = cupy.asnumpy(results)
        wrong = without_nans(results) != without_nans(wanted.view(np.uint32))
        first = [hex(word) for word in (*bits[:, lane], *results[:, lane])] if wrong.any() and (
            lane := int(np.argmax(wrong.any(axis=0)))) >= 0 else None  # fmt: skip
        say("division", what=what, lanes=lanes, quotients_wrong=int(wrong[0].sum()), roots_wrong=int(wrong[1].sum()),
            first=first)  # fmt: skip


def compare_physics(cupy: Any, say: Results, task: str, variant: str) -> None:
    """Compare a task's resets and control steps with those of the processor: all in single steps, and all in one."""
    file, kernels = np.load(HERE / f"{task}.npz"), Kernels(cupy, f"{task}_{variant}")
    digests = file["digests"]
    kept = dict(zip(file["numbers"].tolist(), file["states"], strict=True))
    steps, lanes = len(digests) - 1, digests.shape[1]
    actions = cupy.asarray(physics_actions(steps, ACTIONS, lanes))
    states = cupy.asarray(np.full(kept[0].shape, 0xAAAAAAAA, np.uint32))
    keys = cupy.asarray(file["keys"])
    kernels("begin", [keys, states], lanes)
    wrong_lanes, wrong_words = [], {}
    for number in range(steps + 1):
        if number:
            kernels("physics", [states, actions[number - 1]], lanes)
        words = cupy.asnumpy(states)
        wrong_lanes.append(int(np.count_nonzero(digest(words) != digests[number])))
        if number in kept:
            wrong_words[number] = differing(words, kept[number])
    first = next((number for number, count in enumerate(wrong_lanes) if count), None)
    kernels("begin", [keys, states], lanes)
    kernels("physics", [states, actions], lanes, steps, block=64)
    say("physics_bits", task=task, variant=variant, lanes=lanes, steps=steps, words=states.shape[0],
        words_wrong_after=wrong_words, first_wrong_step=first, lanes_wrong_at_end=wrong_lanes[-1],
        words_wrong_in_one_launch=differing(cupy.asnumpy(states), kept[steps]))  # fmt: skip


def time_physics(cupy: Any, say: Results, task: str, sizes: Iterable[int], variants: Iterable[tuple[str, int]]) -> None:
    """Time a task's control steps without policies; a variant is (name of the code, threads of a block)."""
    rng, file = np.random.default_rng(3), np.load(HERE / f"{task}.npz")
    few = physics_actions(STEPS_OF_LAUNCH, ACTIONS, 1024)
    variants = list(variants)
    for lanes in sizes:
        actions = cupy.asarray(np.tile(few, (1, 1, lanes // 1024)))
        keys = cupy.asarray(rng.integers(0, 2**32, (4, lanes), dtype=np.uint32))
        states = cupy.asarray(np.zeros((len(file["states"][0]), lanes), np.uint32))
        for variant, block in variants:
            kernels = Kernels(cupy, f"{task}_{variant}")
            kernels("begin", [keys, states], lanes)
            runs = seconds_of(cupy, kernels, "physics", [states, actions], lanes, STEPS_OF_LAUNCH, block)
            rates = [round(lanes * STEPS_OF_LAUNCH / run) for run in runs]
            say("physics_speed", task=task, lanes=lanes, variant=variant, block=block,
                steps_per_s=round(statistics.median(rates)), us_per_step=round(
                    statistics.median(runs) / STEPS_OF_LAUNCH * 1e6, 1), runs=rates)  # fmt: skip


class Rollout:
    """Training episodes of a task in a stream of the GPU's work: as many pairs as there are keys."""

    def __init__(self, cupy: Any, task: str, file: Any, keys: tuple[np.ndarray, ...], variant: str = "255") -> None:
        self.cupy, self.episodes = cupy, Kernels(cupy, f"{task}_episodes_{variant}")
        self.policies = Kernels(cupy, f"{task}_policy").function
        noise_keys, reset_keys, action_keys = keys
        self.pairs, self.members, self.unit = len(noise_keys), reset_keys.shape[1], np.float32(file["unit"])
        coordinates = file["coordinates"]
        self.stream = cupy.cuda.Stream(non_blocking=True)
        self.centre, self.constants, self.coordinates, self.noise_keys, self.reset_keys, self.action_keys = (
            cupy.asarray(np.ascontiguousarray(array))
            for array in (file["centre"], file["constants"], coordinates, noise_keys, reset_keys, action_keys)
        )
        self.noise = cupy.empty((self.pairs, len(coordinates)), np.uint8)
        words, inputs, outputs = len(file["carries"][0]), len(file["seen"]), len(file["actions"])
        self.carries, self.seen, self.actions = (
            cupy.empty((count, self.members), np.uint32) for count in (words, inputs, outputs)
        )
        self.policy, self.block = "policy_2_2", 32
        cupy.cuda.runtime.deviceSynchronize()  # copies are in another stream

    def start(self) -> None:
        """Make the noise, reset all episodes, and look."""
        with self.stream:
            grid = (-(-self.noise.shape[1] // 256), self.pairs)
            self.policies("fill")(grid, (256,), (self.noise_keys, self.coordinates, self.noise))
            self.episodes("begin", [self.reset_keys, self.carries], self.members)
            self.episodes("look", [self.carries, self.constants, self.seen], self.members)

    def decide(self, times: int = 1) -> None:
        """Compute the actions."""
        grid = (-(-self.pairs // POLICIES[self.policy]),)
        given = (self.seen, self.noise, self.centre, self.actions, self.unit, np.int32(self.pairs))
        for _ in range(times):
            self.policies(self.policy)(grid, (256,), given)

    def advance(self, times: int = 1) -> None:
        """Move and look."""
        given = [self.carries, self.constants, self.actions, self.action_keys, self.seen]
        for _ in range(times):
            self.episodes("advance", given, self.members, block=self.block)

    def run(self, steps: int) -> None:
        """Control steps, launched one by one."""
        with self.stream:
            for _ in range(steps):
                self.decide()
                self.advance()

    def graph(self, steps: int) -> Any:
        """Control steps as one graph, to be launched again and again."""
        with self.stream:
            self.stream.begin_capture()
            for _ in range(steps):
                self.decide()
                self.advance()
            return self.stream.end_capture()

    def words(self) -> np.ndarray:
        """Words [word, lane] of the carries."""
        self.stream.synchronize()
        return self.cupy.asnumpy(self.carries)


def rollout_keys(file: Any, members: int) -> tuple[np.ndarray, ...]:
    """Keys (noise, reset, action) of members, of which the first are those that are compared."""
    rng = np.random.default_rng(11)
    compared = file["noise_keys"], file["reset_keys"], file["action_keys"]
    noise, reset, action = (
        rng.integers(0, 2**32, shape, dtype=np.uint32) for shape in ((members // 2, 4), (4, members), (4, members))
    )
    few = min(members, compared[1].shape[1])
    noise[: few // 2], reset[:, :few], action[:, :few] = (
        compared[0][: few // 2], compared[1][:, :few], compared[2][:, :few])  # fmt: skip
    return noise, reset, action


def rollout_wrong(file: Any, words: np.ndarray, number: int) -> dict[str, int]:
    """Words of the compared members that differ after some steps. Of those whose episode is over, what is not of the
    episode's result goes on in each kernel in its own way, and is not compared."""
    wanted = file["carries"][file["numbers"].tolist().index(number)]
    alive = wanted[int(file["alive_word"])] != 0
    compared, wanted, alive = (array[..., : words.shape[1]][..., : wanted.shape[1]] for array in (words, wanted, alive))
    result = slice(len(wanted) - int(file["episode_words"]), None)
    return {
        "alive": int(alive.sum()),
        "words_wrong": differing(compared[:, alive], wanted[:, alive]),
        "result_words_wrong": differing(compared[result], wanted[result]),
    }


def compare_rollouts(cupy: Any, say: Results, task: str, variant: str) -> None:
    """Compare noise, observations, outputs of each kernel of policies, and whole episodes with the processor's."""
    file = np.load(HERE / f"{task}_rollout.npz")
    members = file["reset_keys"].shape[1]
    rollout = Rollout(cupy, task, file, rollout_keys(file, members), variant)
    rollout.start()
    rollout.stream.synchronize()
    used = file["coordinates"] != 0
    noise = cupy.asnumpy(rollout.noise)[: len(file["noise"])]
    say("rollout_bits", task=task, what="noise", bytes_wrong=int((noise != file["noise"])[:, used].sum()))
    say("rollout_bits", task=task, what="reset", **rollout_wrong(file, rollout.words(), 0))
    seen = differing(cupy.asnumpy(rollout.seen), file["seen"])
    say("rollout_bits", task=task, what="seen", words_wrong=seen, words=file["seen"].size)
    for policy in POLICIES:
        rollout.policy = policy
        with rollout.stream:
            rollout.decide()
        rollout.stream.synchronize()
        wrong = differing(cupy.asnumpy(rollout.actions), file["actions"])
        say("rollout_bits", task=task, what=policy, words_wrong=wrong, words=file["actions"].size)
    rollout.policy, done = "policy_2_2", 0
    for number in file["numbers"].tolist():
        rollout.run(number - done)
        done = number
        say(
            "rollout_bits",
            task=task,
            variant=variant,
            what="episodes",
            steps=number,
            **rollout_wrong(file, rollout.words(), number),
        )


def time_rollouts(cupy: Any, say: Results, task: str, members: int, steps: int) -> None:
    """Time whole control steps of members: each kernel alone, then the fastest together, in one stream or several."""
    file = np.load(HERE / f"{task}_rollout.npz")
    keys = rollout_keys(file, members)
    rollout = Rollout(cupy, task, file, keys)
    rollout.start()
    alone: dict[tuple, float] = {}
    with rollout.stream:
        for policy in POLICIES:
            rollout.policy = policy
            alone[policy,] = min(seconds_of(cupy, rollout.decide, 10)) / 10
        best_policy = rollout.policy = min(POLICIES, key=lambda policy: alone[policy,])
        for variant in VARIANTS:
            rollout.episodes = Kernels(cupy, f"{task}_episodes_{variant}")
            for block in (32, 64, 128):
                rollout.block = block
                alone[variant, block] = min(seconds_of(cupy, rollout.advance, 10)) / 10
    variant, block = min((key for key in alone if len(key) == 2), key=alone.__getitem__)
    say("rollout_parts", task=task, members=members, us={"/".join(map(str, key)): round(1e6 * x, 1)
        for key, x in alone.items()}, best=[best_policy, variant, block])  # fmt: skip
    del rollout
    for streams in (1, 2, 4):
        parts = [
            Rollout(cupy, task, file, part, variant)
            for part in zip(
                *(np.split(whole, streams, axis=axis) for whole, axis in zip(keys, (0, 1, 1), strict=True)), strict=True
            )
        ]
        for policy in dict.fromkeys((best_policy, "policy_1_2", "policy_2_3")):
            for part in parts:
                part.policy, part.block = policy, block
            rates = timed_rollouts(cupy, parts, steps)
            wrong = rollout_wrong(file, parts[0].words(), steps) if steps in file["numbers"] else None
            say("rollout_speed", task=task, members=members, streams=streams, policy=policy, variant=variant,
                block=block, steps=steps, **rates, compared=wrong)  # fmt: skip


def timed_rollouts(cupy: Any, parts: list[Rollout], steps: int) -> dict[str, Any]:
    """Control steps a second of all parts at a time: launched one by one, and as graphs; each from the reset."""
    members, chunk = sum(part.members for part in parts), min(steps, STEPS_OF_GRAPH)

    def rate(work: Callable[[int], object]) -> int:
        """Steps a second of `work(number of the part)`, which does `chunk` steps."""
        for part in parts:
            part.start()
        cupy.cuda.runtime.deviceSynchronize()
        started = time.perf_counter()
        for _ in range(steps // chunk):
            for number in range(len(parts)):
                work(number)
        cupy.cuda.runtime.deviceSynchronize()
        return round(members * (steps // chunk) * chunk / (time.perf_counter() - started))

    rates: dict[str, Any] = {"by_launches": rate(lambda number: parts[number].run(chunk))}
    try:
        graphs = [part.graph(chunk) for part in parts]
        rates["by_graphs"] = rate(lambda number: graphs[number].launch(parts[number].stream))
    except Exception as error:  # what was launched one by one counts as well
        rates["by_graphs"] = repr(error)
    return rates


def time_code(cupy: Any, say: Results) -> None:
    """Time straight loops of products and sums by the size of their code, with 1 to 16 warps on a multiprocessor."""
    count = cupy.cuda.runtime.getDeviceProperties(0)["multiProcessorCount"]
    results = cupy.empty((count * 512,), np.float32)
    for kib in CODE_KIB:
        kernels, trips = Kernels(cupy, f"code_{kib}"), 5120 // kib
        ns = {}
        for warps in (1, 2, 4, 8, 16):
            runs = seconds_of(cupy, kernels, "code", [results], count * 32 * warps, trips, 32 * warps)
            ns[warps] = round(min(runs) * 1e9 / (trips * kib * 64), 3)
        say("code_speed", kib=kib, ns_of_an_instruction_by_warps=ns)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=150.0, help="the process ends itself after these")
    parser.add_argument("parts", nargs="*", help="operations, physics_bits ..., in the order of the code; default: all")
    seconds, names = (arguments := parser.parse_args()).seconds, arguments.parts or PARTS
    say = Results()
    watch = threading.Timer(seconds, lambda: (say("stopped", why=f"{seconds} s are over"), os._exit(3)))
    watch.daemon = True
    watch.start()
    cupy = importlib.import_module("cupy")
    properties = cupy.cuda.runtime.getDeviceProperties(0)
    say("device", name=properties["name"].decode(), multiprocessors=properties["multiProcessorCount"],
        l2_bytes=properties["l2CacheSize"], driver=cupy.cuda.runtime.driverGetVersion())  # fmt: skip
    every = [(variant, block) for variant in VARIANTS for block in (32, 64, 128)]
    few = [("255", 32), ("quick_255", 32), ("quick_255", 64), ("quick_128", 64)]
    compared = "255", "quick_255", "quick_128"
    rollouts = ("ant_maze", 8192, 1000), ("ant_maze", 1024, 1000), ("ant_maze", 32768, 250), ("ant_trap", 8192, 250)
    parts: dict[str, list[Callable[[], None]]] = {
        "operations": [lambda: compare_operations(cupy, say), lambda: compare_division(cupy, say)],
        "physics_bits": [lambda t=t, v=v: compare_physics(cupy, say, t, v) for t in PHYSICS for v in compared],
        "rollout_bits": [lambda t=t, v=v: compare_rollouts(cupy, say, t, v) for t in ROLLOUTS for v in compared[:2]],
        "physics_speed": [
            lambda: time_physics(cupy, say, "ant_trap", (1024, 4096, 16384, 65536), every),
            lambda: time_physics(cupy, say, "ant_trap", (262144,), few),
            lambda: time_physics(cupy, say, "ant_maze", (1024, 8192, 65536), few),
        ],
        "rollout_speed": [lambda t=t, m=m, s=s: time_rollouts(cupy, say, t, m, s) for t, m, s in rollouts],
        "code_speed": [lambda: time_code(cupy, say)],
    }
    failed = 0
    for part in [part for name in names for part in parts[name]]:
        try:
            part()
        except Exception as error:  # the other parts may work
            failed += 1
            say("failed", error=repr(error), trace=traceback.format_exc()[-1500:])
    say("done", failed=failed)
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
