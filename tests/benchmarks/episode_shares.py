"""Where does the time of a compiled episode go, and how far from this core's ceilings is it?

    python -m tests.benchmarks.episode_shares        # two minutes, one core

Of a block of full vectors, each part called by itself on the same memory: what the policy sees (look), the policy,
physics and bookkeeping (move), and the noise of the block's pairs, once per episode. Beside them the policy without
noise, as evaluations have it. Ceilings: fused multiply-adds with all in registers, and reading as many bytes as the
block's weights are, again and again, from wherever they fit.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import time
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from es_service import api
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.protocol.messages import WorkerSpec
from es_service.protocol.noise import KEY_WORDS, NORMAL_STD, Domain, stream_keys
from tests.benchmarks.simd_physics import peak
from workers.environments import make_environment
from workers.episode import episode_steps
from workers.policy import initial_parameters
from workers.simd.backend.emit import graph_function
from workers.simd.backend.function_builder import FunctionBuilder, module
from workers.simd.backend.native import aligned, compile_object, load_object, words_of
from workers.simd.backend.target import host_target
from workers.simd.episodes.check import check_resets
from workers.simd.episodes.hidden import plan
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.episodes.network import policy_function
from workers.simd.episodes.noise_kernels import fill_function
from workers.simd.episodes.rollout import always_zero
from workers.simd.frontend.trace import trace_jaxpr

REPEATS = 2000


def run_of(functions: list[FunctionBuilder], call: str, parameters: list[str]) -> Callable[..., float]:
    """Seconds of one call of the last function, given its arguments; the least of five times REPEATS."""
    target = host_target()
    inside = FunctionBuilder("inside", [f"ptr %{name}" for name in parameters] + ["float %unit", "i64 %times"], target)
    inside.loop("%times", lambda *_: [inside.do(call)][:0])
    address, alive = load_object(compile_object(module([*functions, inside]), target), target)
    signature = [*[ctypes.c_void_p] * len(parameters), ctypes.c_float, ctypes.c_int64]
    function = ctypes.CFUNCTYPE(None, *signature)(address)

    def seconds(*arrays: np.ndarray, unit: float = 0.0, times: int = REPEATS) -> float:
        assert alive
        durations = []
        for _ in range(5):
            started = time.perf_counter()
            function(*(array.ctypes.data for array in arrays), unit, times)
            durations.append(time.perf_counter() - started)
        return min(durations) / times

    return seconds


def spec_of(task: str) -> WorkerSpec:
    hidden = [64, 64] if task == "point_maze" else [256, 256]
    config = api.load_config(
        {
            "task": {"environment": task},
            "policy": {"hidden": hidden},
            "search": {"algorithm": "es", "pairs": 64},
            "budget": {"generations": 1},
        }
    )
    return worker_spec(config, task_of(config))


def measure(task: str) -> dict[str, float]:
    """Microseconds of one environment step, by part, and rates."""
    spec, environment = spec_of(task), make_environment(task, {})
    target = host_target()
    width, pairs = target.width, target.width // 2
    inputs_O = np.flatnonzero(~always_zero(environment))
    steps = episode_steps(environment, spec, training=True, inputs_O=inputs_O)
    network = plan(spec.policy, inputs_O, target)
    key, inputs = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32), jax.ShapeDtypeStruct((len(inputs_O),), jnp.float32)
    action = jax.ShapeDtypeStruct((spec.policy.outputs,), jnp.float32)
    carry = jax.eval_shape(steps.begin, key)
    words, actions = sum(map(words_of, jax.tree.leaves(carry))), spec.policy.outputs

    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(steps.normalised_observation)(carry, inputs, inputs))
    sources = [("carry", words), ("constants", len(inputs_O)), ("constants", len(inputs_O))]
    look = graph_function("look", graph, outputs, sources, "seen", target)
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(steps.advance)(carry, inputs, inputs, action, key))
    sources = [
        *(("carry", words), ("constants", len(inputs_O)), ("seen", len(inputs_O))),
        *(("action", actions), ("keys", KEY_WORDS)),
    ]
    move = graph_function("move", graph, outputs, sources, "carry", target)

    rng = np.random.default_rng(0)
    lanes = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(width))
    keys = aligned((KEY_WORDS, width))
    keys[:] = lanes.T
    carries = aligned((1, words, width))
    check = partial(check_resets, environment=spec.environment)  # workers find the code in the cache, too
    compile_kernel(steps.begin, key, check=check).run(keys[None], carries)
    constants = aligned((2 * len(inputs_O), width)).view(np.float32)
    constants[: len(inputs_O)], constants[len(inputs_O) :] = 0.0, 1.0
    seen = aligned((len(inputs_O), width)).view(np.float32)
    seen[:] = rng.normal(size=seen.shape)
    acted = aligned((actions, width)).view(np.float32)
    acted[:] = rng.uniform(-1, 1, acted.shape)
    alive = np.ones(width, np.int32)
    centre = network.pack(initial_parameters(spec.policy, "unit_columns", 0))
    noise = aligned((network.block_bytes // 4,)).view(np.int8)
    unit = float(np.float32(0.02 / NORMAL_STD))

    parts = {}
    call = "call void @look(ptr %carry, ptr %constants, ptr %seen)"
    parts["look"] = run_of([look], call, ["carry", "constants", "seen"])(carries, constants, seen)
    names = ["seen", "alive", "centre", "noise", "hidden", "action"]
    arrays = (seen, alive, centre, noise, aligned((network.hidden_vectors, width)), acted)
    fill = fill_function(network.vectors, len(network.places) - network.vectors, target)
    call = "call void @fill(ptr %keys, ptr %places, ptr %noise)"
    pair_keys = stream_keys(0, Domain.PARAMETER_NOISE, 0, np.arange(pairs))
    filled = run_of([fill], call, ["keys", "places", "noise"])(pair_keys, network.places, noise, times=20)
    call = "call void @policy(ptr %seen, ptr %alive, ptr %centre, ptr %hidden, ptr %action)"
    without_noise = run_of([policy_function(network, "shared")], call, names)(*arrays)
    call = "call void @policy(ptr %seen, ptr %alive, ptr %centre, ptr %noise, float %unit, ptr %hidden, ptr %action)"
    parts["policy"] = run_of([policy_function(network, "perturbed")], call, names)(*arrays, unit=unit)
    call = "call void @move(ptr %carry, ptr %constants, ptr %seen, ptr %action, ptr %keys)"
    parts["move"] = run_of([move], call, ["carry", "constants", "seen", "action", "keys"])(
        carries, constants, seen, acted, keys, times=200
    )
    parts["noise"] = filled / spec.episode_steps
    weights = network.noise_bytes
    total = sum(parts.values())
    row = {f"{name}_us": round(1e6 * seconds / width, 3) for name, seconds in parts.items()}
    row |= {f"{name}_percent": round(100 * seconds / total, 1) for name, seconds in parts.items()}
    useful = len(network.places) - network.vectors + sum((layer.inputs + 1) * layer.outputs for layer in network.hidden)
    return row | {
        "total_us": round(1e6 * total / width, 3),
        "policy_without_noise_us": round(1e6 * without_noise / width, 3),
        "policy_gflops": round(2 * 2 * useful * width / parts["policy"] / 1e9, 1),
        "policy_gbytes_per_s": round((weights + centre.nbytes) / parts["policy"] / 1e9, 1),
        "weights_kib_of_block": round((weights + centre.nbytes) / 1024),
        "normals_per_s": round(weights / filled),
    }


def read_gbytes(kib: float) -> float:
    """GB/s of reading a buffer of this size again and again, vector by vector."""
    target = host_target()
    vectors = int(kib * 1024) // (4 * target.width) // 8 * 8
    sums = FunctionBuilder("read", ["ptr noalias %from", "ptr noalias %to"], target)
    floats = sums.llvm_types["f"]

    def body(number: str, carried: list[str]) -> list[str]:
        loaded = [sums.load(floats, "%from", sums.index((number, 8), (k, 1))) for k in range(8)]
        return [sums.value(f"fadd {floats} {total}, {new}") for total, new in zip(carried, loaded, strict=True)]

    for k, total in enumerate(sums.loop(vectors // 8, body, [(floats, "zeroinitializer")] * 8)):
        sums.store(floats, total, "%to", k)
    memory, out = aligned((vectors, target.width)), aligned((8, target.width))
    memory[:] = 0
    seconds = run_of([sums], "call void @read(ptr %from, ptr %to)", ["from", "to"])(memory, out)
    return round(vectors * 4 * target.width / seconds / 1e9, 1)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--tasks", nargs="+", default=["ant_maze", "ant_trap", "point_maze"])
    print(json.dumps({"peak_gflops": round(peak(), 1)}))
    for task in parser.parse_args().tasks:
        row = measure(task)
        print(
            json.dumps({"task": task, **row, "read_ceiling_gbytes": read_gbytes(row["weights_kib_of_block"])}),
            flush=True,
        )


if __name__ == "__main__":
    main()
