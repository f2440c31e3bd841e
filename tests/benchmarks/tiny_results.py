"""How often may a step differ between x86-64 and 64-bit Arm?

    python -m tests.benchmarks.tiny_results        # two minutes, one core

They differ where the exact result of a product, quotient or fused product lies between 2^-126 - 2^-151 and 2^-126:
x86-64 rounds it to 2^-126, Arm makes it a zero. The code of whole training episodes is compiled for this processor with
two counters behind each such operation: of results of exactly 2^-126 (no episode without one can differ), and of those
from 2^-126 to 2^-125, which are spread over 2^25 times as wide a range as the one that matters. So a step of an
environment meets that range about `near_per_step` / 2^25 times.
"""

from __future__ import annotations

import argparse
import ctypes
import dataclasses
import json
import re
from itertools import count
from unittest import mock

import llvmlite.binding as llvm
import numpy as np

from tests.workers.simd.rollouts import arguments, task_spec
from workers.environments import make_environment
from workers.simd.backend import native
from workers.simd.backend.target import Target, host_target
from workers.simd.episodes.compiled import compile_episodes

OPERATION = re.compile(r"  (%v\d+) = (?:fmul|fdiv|call) <(\d+) x float>")
PARTS = {"near": (0x7F800000, 0x00800000), "exact": (0x7FFFFFFF, 0x00800000)}
"""Counter -> (bits of a result that count, value that they must have)."""


def counted(text: str) -> str:
    """LLVM IR with counters, and a function `counts` that gives their address."""
    lines, numbers = [], count()
    vector = ""
    for line in text.splitlines():
        lines.append(line)
        match = OPERATION.match(line)
        if not match or ("= call" in line and "@llvm.fma." not in line):
            continue
        value, width = match.groups()
        vector, n = f"<{width} x i32>", next(numbers)
        lines.append(f"  %bits{n} = bitcast <{width} x float> {value} to {vector}")
        for place, (mask, wanted) in enumerate(PARTS.values()):
            at = f"getelementptr ({vector}, ptr @counters, i64 {place})"
            lines += [
                f"  %m{n}_{place} = and {vector} %bits{n}, splat (i32 {mask})",
                f"  %e{n}_{place} = icmp eq {vector} %m{n}_{place}, splat (i32 {wanted})",
                f"  %c{n}_{place} = zext <{width} x i1> %e{n}_{place} to {vector}",
                f"  %o{n}_{place} = load {vector}, ptr {at}",
                f"  %s{n}_{place} = add {vector} %o{n}_{place}, %c{n}_{place}",
                f"  store {vector} %s{n}_{place}, ptr {at}",
            ]
    lines += [f"@counters = internal global [{len(PARTS)} x {vector}] zeroinitializer"] * bool(vector)
    return "\n".join([*lines, f"define ptr @counts() {{\n  ret ptr {'@counters' if vector else 'null'}\n}}\n"])


def measure(task: str, pairs: int, sigma: float) -> dict[str, float]:
    """Counts of whole training episodes with random policies."""
    worker_spec = dataclasses.replace(task_spec(task, chunk_pairs=pairs), common_random_numbers=False)
    environment, target, places = make_environment(task, {}), host_target(), []

    def load(code: bytes, target: Target) -> tuple[int, object]:
        jit = llvm.create_lljit_compiler(native.code_generator(target), use_jit_link=True, suppress_errors=True)
        library = llvm.JITLibraryBuilder().add_object_img(code).export_symbol("kernel").export_symbol("counts")
        linked = library.link(jit, "kernels")
        places.append(ctypes.CFUNCTYPE(ctypes.c_void_p)(linked["counts"])())
        return linked["kernel"], (jit, linked)

    centre_D, unit, mean_O, std_O, keys, resets, actions = arguments(worker_spec, sigma=sigma)
    with (
        mock.patch.object(native, "load_object", load),
        mock.patch.object(native, "compile_object", lambda text, target: native.compile_object(counted(text), target)),
        mock.patch.object(native.cache, "cache_folder", return_value=None),
    ):
        kernel = compile_episodes(environment, worker_spec, np.arange(len(mean_O)), training=True, target=target)
    lanes = (given.reshape(-1, 4) for given in (resets, actions))
    episodes = kernel.run(kernel.network.pack(centre_D), float(unit), mean_O, std_O, keys, *lanes)
    steps = episodes.steps.reshape(-1, target.width).max(axis=1).sum() * target.width  # a block ends with its last lane
    counters = np.ctypeslib.as_array((ctypes.c_uint32 * (len(PARTS) * target.width)).from_address(places[-1]))
    sums = dict(zip(PARTS, counters.reshape(len(PARTS), -1).sum(axis=1, dtype=np.int64).tolist(), strict=True))
    return {
        "steps": int(steps),
        **sums,
        "near_per_step": sums["near"] / steps,
        "per_step": sums["near"] / steps / 2**25,
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--tasks", nargs="+", default=["point_maze", "ant_trap", "ant_maze"])
    parser.add_argument("--pairs", type=int, default=64)
    parser.add_argument("--sigma", type=float, default=0.05)
    given = parser.parse_args()
    for task in given.tasks:
        print(json.dumps({"task": task, **measure(task, given.pairs, given.sigma)}), flush=True)


if __name__ == "__main__":
    main()
