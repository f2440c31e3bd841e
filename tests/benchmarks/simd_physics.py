"""How fast is compiled physics on one core, beside xla and beside what the core can do?

    python -m tests.benchmarks.simd_physics                # half an hour with --tasks all, five minutes without

For each task: control steps a second without policies by xla, at the batch it likes best, and by simd, one after the
other, three rounds, the median of each; scalar operations before and after folding; what compiling takes, cold and from
the cache, in processes of their own; GFLOP/s (a fused operation is two) beside the peak of this core: as many fused
operations as it does when nothing else is asked of it.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from unittest import mock

import numpy as np

from es_service.cli.bench_rollouts import ANT_HIDDEN
from es_service.protocol.process_environment import worker_environment

TASKS = ("ant_maze", "ant_trap", "point_maze", "brax:ant")
OTHERS = ("brax:halfcheetah", "brax:hopper", "brax:walker2d", "brax:humanoid", "brax:reacher", "brax:pusher")
BATCHES = (8, 16, 64, 256)
ROUNDS = 3


def child(arguments: list[str], cache: str) -> dict:
    """The JSON that a Python program prints, run as a worker would be, with a cache of its own."""
    environment = worker_environment(os.environ) | {"XDG_CACHE_HOME": cache}
    done = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def rate(task: str, rollout: str, batch: int, cache: str) -> int:
    arguments = {"task": task, "options": {}, "hidden": ANT_HIDDEN, "policy": False, "batch": batch, "seconds": 2.0}
    return child(["-m", "workers.measure", json.dumps(arguments | {"rollout": rollout})], cache)["steps_per_second"]


def facts_of(task: str) -> dict:
    """One control step compiled, with everything it gives; run in a process of its own."""
    import jax
    import jax.numpy as jnp

    from workers.environments import SHIPPED, describe_environment, make_environment
    from workers.simd.episodes.kernel import compile_kernel
    from workers.simd.frontend.trace import trace_jaxpr
    from workers.simd.graph.graph import Graph
    from workers.simd.graph.schedule import Region, schedule

    environment = make_environment(task, {})
    size = SHIPPED[task] if task in SHIPPED else describe_environment(task)

    def step(state, action):
        after, reward, done = environment.step(state, action)
        return after, reward, done, environment.observe(after), environment.descriptor(after)

    state = jax.eval_shape(environment.reset, jax.ShapeDtypeStruct((4,), jnp.uint32))
    action = jax.ShapeDtypeStruct((size.action_size,), jnp.float32)
    started = time.perf_counter()
    facts = compile_kernel(step, state, action).facts
    seconds = time.perf_counter() - started

    counts = {"asked": 0, "operations": 0, "flops": 0, "carried": 0}
    fold, depth = Graph.op, 0

    def asked(graph: Graph, name: str, *arguments: int) -> int:
        """An operation, counted, but for those that folding asks for itself."""
        nonlocal depth
        counts["asked"] += depth == 0
        depth += 1
        try:
            return fold(graph, name, *arguments)
        finally:
            depth -= 1

    with mock.patch.object(Graph, "op", asked):
        graph, _, outputs = trace_jaxpr(jax.make_jaxpr(step)(state, action))
    order = schedule(graph, outputs)
    flops = {"add", "sub", "mul", "div", "sqrt", "neg", "abs", "fma"}

    def count(region: Region, times: int) -> None:
        counts["carried"] = max(counts["carried"], len(region.carried))
        for region_step in region.steps:
            if isinstance(region_step, Region):
                assert region_step.loop is not None
                count(region_step, times * region_step.loop.trips)
            else:
                counts["operations"] += times
                name = graph.keys[region_step][0]
                counts["flops"] += times * (2 if region_step in order.fused or name == "fma" else name in flops)

    count(order.region, 1)
    return {"seconds": seconds, **facts._asdict(), **counts}


def peak() -> float:
    """GFLOP/s of independent fused operations, 24 in flight, on vectors of this machine's width."""
    from workers.simd.backend.emit import emit
    from workers.simd.backend.machine_code import compile_object, load_object
    from workers.simd.backend.target import host_target
    from workers.simd.backend.words import aligned
    from workers.simd.graph.graph import Graph

    graph, trips, lanes = Graph(), 100_000, host_target().width
    loop = graph.loop(trips, [graph.input("f", k) for k in range(24)])
    gain, drift = graph.input("f", 24), graph.input("f", 25)
    ends = loop.carries
    for _ in range(10):
        ends = [graph.op("fma", end, gain, drift) for end in ends]
    outputs = graph.close(loop, ends)
    code = compile_object(emit(graph, outputs, 26, host_target()), host_target())
    address, alive = load_object(code, host_target())
    words, out = aligned((1, 26, lanes)), aligned((1, 24, lanes))
    words[:] = np.float32(0.5).view(np.uint32)
    run = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(address)
    best = 0.0
    for _ in range(5):
        started = time.perf_counter()
        run(words.ctypes.data, out.ctypes.data, 1)
        best = max(best, 2 * 24 * 10 * trips * lanes / (time.perf_counter() - started) / 1e9)
    del alive
    return best


def measure(task: str) -> dict:
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = (child(["-m", "tests.benchmarks.simd_physics", "--facts", task], cache) for _ in range(2))
        xla_rates = {batch: rate(task, "xla", batch, cache) for batch in BATCHES}
        batch = max(xla_rates, key=xla_rates.__getitem__)
        rounds = [(rate(task, "xla", batch, cache), rate(task, "simd", batch, cache)) for _ in range(ROUNDS)]
    xla, simd = (statistics.median(side) for side in zip(*rounds, strict=True))
    return {
        "task": task,
        "xla_steps_per_s": round(xla),
        "xla_batch": batch,
        "simd_steps_per_s": round(simd),
        "ratio": round(simd / xla, 1),
        "ratios_of_rounds": [round(b / a, 1) for a, b in rounds],
        "asked": cold["asked"],
        "left": cold["computed"],
        "per_step": cold["operations"],
        "carried": cold["carried"],
        "gflops": round(simd * cold["flops"] / 1e9, 1),
        "jaxpr_s": round(cold["jaxpr_s"], 2),
        "cold_s": round(cold["seconds"] - cold["jaxpr_s"], 2),
        "cached_s": round(warm["seconds"] - warm["jaxpr_s"], 2),
        "code_kb": round(cold["code_bytes"] / 1000),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), help="names, or all")
    parser.add_argument("--facts", metavar="TASK", help="only what compiling it took, as JSON")
    arguments = parser.parse_args()
    if arguments.facts:
        print(json.dumps(facts_of(arguments.facts)))
        return
    print(f"peak of this core: {peak():.0f} GFLOP/s")
    for task in (*TASKS, *OTHERS) if arguments.tasks == ["all"] else arguments.tasks:
        print(json.dumps(measure(task)), flush=True)


if __name__ == "__main__":
    main()
