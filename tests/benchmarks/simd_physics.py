"""How fast is compiled physics on one core, beside xla and beside what the core can do?

    python -m tests.benchmarks.simd_physics                # half an hour with --tasks all, five minutes without
    python -m tests.benchmarks.simd_physics --sizes brax:ant "brax:ant 4 x 8"       # what compiling takes, by stage

For each task: control steps a second without policies by xla, at the batch it likes best, and by simd, one after the
other, three rounds, the median of each; scalar operations before and after folding; what compiling takes, cold and from
the cache, in processes of their own; GFLOP/s (a fused operation is two) beside the peak of this core: as many fused
operations as it does when nothing else is asked of it.

With --sizes, for tasks and rows of `tests.benchmarks.mujoco`: processor time of JAX's trace, of ours, of writing LLVM's
IR and of LLVM; the code's bytes and instructions, and how many of those read or write the stack.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from es_service.protocol.child import Child
from es_service.protocol.process_environment import child_environment

TASKS = ("ant_maze", "ant_trap", "point_maze", "brax:ant")
OTHERS = ("brax:halfcheetah", "brax:hopper", "brax:walker2d", "brax:humanoid", "brax:reacher", "brax:pusher")
BATCHES = (8, 16, 64, 256)
ROUNDS = 3


def facts(task: str, cache: str) -> dict:
    """`facts_of` in a process like a worker's, with a cache of its own."""
    command = [sys.executable, "-m", "tests.benchmarks.simd_physics", "--facts", task]
    environment = child_environment() | {"XDG_CACHE_HOME": cache}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def rate(task: str, rollout: str, batch: int, cache: str, seconds: float = 2.0) -> int:
    """Control steps a second of a worker, measured as by `es-service bench rollouts`."""
    given = {"options": {}, "hidden": [], "policy": False, "batch": batch, "seconds": seconds, "rollout": rollout}
    with Child("workers.measure:measurer", child_environment() | {"XDG_CACHE_HOME": cache}) as process:
        process.call(task, given)
        return process.call()["steps_per_second"]


def step_of(task: str) -> tuple[Any, Any, Any]:
    """(one control step with everything it gives, shapes of its state, shape of its action)."""
    import jax
    import jax.numpy as jnp

    from workers.environments import SHIPPED, describe_environment, make_environment

    environment = make_environment(task, {})
    size = SHIPPED[task] if task in SHIPPED else describe_environment(task)

    def step(state, action):
        after, reward, done = environment.step(state, action)
        return after, reward, done, environment.observe(after), environment.descriptor(after)

    state = jax.eval_shape(environment.reset, jax.ShapeDtypeStruct((4,), jnp.uint32))
    return step, state, jax.ShapeDtypeStruct((size.action_size,), jnp.float32)


def step_of_row(row: str, playground: Path | None) -> tuple[Any, Any, Any]:
    """As `step_of`, of a row of `tests.benchmarks.mujoco`."""
    from tests.benchmarks.mujoco import rows
    from workers.environments import mujoco_parts

    example = rows()[row](playground)
    model = mujoco_parts.put_model(example.model)

    def step(state: Any, ctrl: Any) -> Any:
        return mujoco_parts.step(model, state, ctrl, example.substeps)

    return step, mujoco_parts.start(model), np.zeros(example.model.nu, np.float32)


def sizes_of(name: str, playground: Path | None) -> dict:
    """What compiling one control step takes by stage, and the machine code of this processor."""
    import jax

    from tests.benchmarks.mujoco import rows
    from workers.simd.backend.emit import emit
    from workers.simd.backend.native import compile_object
    from workers.simd.backend.target import host_target
    from workers.simd.frontend.trace import trace_jaxpr

    step, state, action = step_of_row(name, playground) if name in rows() else step_of(name)
    clock = [time.process_time()]

    def lap(result: Any) -> Any:
        clock.append(time.process_time())
        return result

    closed = lap(jax.make_jaxpr(step)(state, action))
    graph, inputs, outputs = lap(trace_jaxpr(closed))
    text = lap(emit(graph, outputs, inputs, host_target()))
    code = lap(compile_object(text, host_target()))
    with tempfile.NamedTemporaryFile(suffix=".o") as file:
        file.write(code)
        file.flush()
        listing = subprocess.run(
            ["objdump", "-d", "--no-show-raw-insn", file.name], capture_output=True, text=True, check=True
        ).stdout
    instructions = [line for line in listing.splitlines() if re.match(r" *[0-9a-f]+:\t", line)]
    stages = zip(("jax_s", "trace_s", "write_s", "llvm_s"), np.diff(clock), strict=True)
    return {
        "name": name,
        "target": host_target().describe(),
        **{stage: round(float(seconds), 2) for stage, seconds in stages},
        "code_kb": round(len(code) / 1000),
        "instructions": len(instructions),
        "of_the_stack": sum(bool(re.search(r"\(%r[sb]p|\[sp", line)) for line in instructions),
    }


def facts_of(task: str) -> dict:
    """One control step compiled, with everything it gives; run in a process of its own."""
    import jax

    from workers.simd.episodes.kernel import compile_kernel
    from workers.simd.frontend.trace import trace_jaxpr
    from workers.simd.graph.graph import Graph
    from workers.simd.graph.schedule import Region, schedule

    step, state, action = step_of(task)
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
                count(region_step, times * (region_step.loop.trips or 1))  # one trip if data ends the loop
            else:
                counts["operations"] += times
                name = graph.keys[region_step][0]
                counts["flops"] += times * (2 if region_step in order.fused or name == "fma" else name in flops)

    count(order.region, 1)
    return {"seconds": seconds, **facts._asdict(), **counts}


def peak() -> float:
    """GFLOP/s of independent fused operations, 24 in flight, on vectors of this machine's width."""
    from workers.simd.backend.emit import emit
    from workers.simd.backend.native import aligned, compile_object, load_object
    from workers.simd.backend.target import host_target
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
        cold, warm = facts(task, cache), facts(task, cache)
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
    parser.add_argument("--sizes", nargs="+", metavar="NAME", help="only what compiling these takes, by stage")
    parser.add_argument("--playground", type=Path, help="folder that contains mujoco_playground, for its rows")
    arguments = parser.parse_args()
    for name in arguments.sizes or ():
        print(json.dumps(sizes_of(name, arguments.playground)), flush=True)
    if arguments.sizes:
        return
    if arguments.facts:
        print(json.dumps(facts_of(arguments.facts)))
        return
    print(f"peak of this core: {peak():.0f} GFLOP/s")
    for task in (*TASKS, *OTHERS) if arguments.tasks == ["all"] else arguments.tasks:
        print(json.dumps(measure(task)), flush=True)


if __name__ == "__main__":
    main()
