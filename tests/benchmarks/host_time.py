"""What the rollout `host` costs beside the simulator, and how well many cores that wait are used.

    python -m tests.benchmarks.host_time ant [--rounds 5] [--steps 200]
    python -m tests.benchmarks.host_time sleep [--generations 5]      # as root, with iproute2

`ant`: steps a second of gymnasium:Ant-v5 with policies of 64x64, 16 environments in one process, of the function by
which a worker computes a chunk; of the same loop written by hand around `gymnasium.make_vec` (sync), with the same
policies; and of `mujoco.rollout`, which has the same physics and neither observations nor rewards nor policies. By
turns; rates are those of the process's own time, since other programs may run beside it.

`sleep`: a function that sleeps for a tenth of a second, on four Ray nodes of 16 declared cores each on this machine.
Generations of 640 calls take one second if all 64 cores always have a call.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml

from es_service import open_run
from es_service.protocol.messages import Centre, EvaluationChunk, PolicySpec, WorkerSpec
from workers.environments import describe_environment
from workers.worker import make_worker

NAME, LANES = "gymnasium:Ant-v5", 16
OPTIONS = {"terminate_when_unhealthy": False}
SLEEP_S = 0.1


def sleeper(parameters):
    """it sleeps for a tenth of a second"""
    time.sleep(SLEEP_S)
    return -float(np.square(parameters).sum())


sleeper.parameters = {"x": (-1.0, 1.0), "y": (-1.0, 1.0)}
sleeper.deterministic = True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["ant", "sleep"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--generations", type=int, default=5)
    parser.add_argument("--nodes", type=int, default=4)
    parser.add_argument("--cores", type=int, default=16, help="declared cores of each node")
    parser.add_argument("--calls", type=int, default=640, help="calls of a generation")
    given = parser.parse_args()
    if given.what == "ant":
        ant(given.rounds, given.steps)
    else:
        sleep(given.generations, given.nodes, given.cores, given.calls)


def ant(rounds: int, steps: int) -> None:
    """Print the table of `ant`."""
    task = describe_environment(NAME, {"options": OPTIONS})
    shape = PolicySpec((task.observation_size, 64, 64, task.action_size))
    parameters_D = (np.random.default_rng(0).normal(size=shape.parameters) * 0.05).astype(np.float32)
    ways: dict[str, Callable[[], object]] = {
        "host, one chunk of 16 episodes": _ours(shape, parameters_D, steps),
        "loop by hand around make_vec (sync)": _by_hand(shape, parameters_D, steps),
        "mujoco.rollout, without policies": _mujoco(steps),
    }
    rates: dict[str, list[float]] = {name: [] for name in ways}
    for number in range(rounds + 1):
        for name, run in ways.items():
            before = time.process_time()
            run()
            if number:  # the first round makes the environments
                rates[name].append(LANES * steps / (time.process_time() - before))
    first = rates["host, one chunk of 16 episodes"]
    print("| what | steps a second of a core, median | host beside it |\n| --- | --- | --- |")
    for name, values in rates.items():
        ratios = [ours / theirs for ours, theirs in zip(first, values, strict=True)]
        spread = f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        print(f"| {name} | {statistics.median(values):,.0f} | {spread} |")


def _ours(shape: PolicySpec, parameters_D: np.ndarray, steps: int) -> Callable[[], object]:
    spec = WorkerSpec(
        seed=0, environment=NAME, environment_options=dict(OPTIONS), policy=shape, episode_steps=steps, fitness="sum",
        episodes_per_member=1, observation_clip=5.0, action_noise=0.0, common_random_numbers=True, chunk_pairs=8,
        rollout_block_pairs=8, gradient_block_pairs=8, rollout="host",
    )  # fmt: skip
    size = shape.widths[0]
    centre = Centre(0, parameters_D, 0.0, np.zeros(size, np.float32), np.ones(size, np.float32))
    run = make_worker(spec)
    return lambda: run([(centre, EvaluationChunk(1, 0))])


def _by_hand(shape: PolicySpec, parameters_D: np.ndarray, steps: int) -> Callable[[], object]:
    import gymnasium

    envs = gymnasium.make_vec("Ant-v5", num_envs=LANES, vectorization_mode="sync", **OPTIONS)
    layers, start = [], 0
    for inputs, outputs in zip(shape.widths, shape.widths[1:], strict=False):
        end = start + inputs * outputs
        weights = np.broadcast_to(parameters_D[start:end].reshape(inputs, outputs), (LANES, inputs, outputs)).copy()
        start = end + outputs
        layers.append((weights, parameters_D[end:start]))

    def run() -> None:
        seen, _ = envs.reset(seed=0)
        for _ in range(steps):
            x = np.clip(seen.astype(np.float32), -5.0, 5.0)[:, None]
            for weights, biases in layers:
                x = np.tanh(x @ weights + biases)
            seen, _, _, _, _ = envs.step(x[:, 0])

    return run


def _mujoco(steps: int) -> Callable[[], object]:
    import gymnasium
    from mujoco import MjData, mj_stateSize, mjtState, rollout

    model = gymnasium.make("Ant-v5").unwrapped.model
    data = MjData(model)
    state = np.zeros((LANES, mj_stateSize(model, mjtState.mjSTATE_FULLPHYSICS)))
    state[:, 1 : 1 + model.nq] = data.qpos
    control = np.random.default_rng(0).uniform(-1.0, 1.0, (LANES, steps, model.nu)).repeat(5, axis=1)  # frame_skip
    return lambda: rollout.rollout(model, data, state, control)


def sleep(generations: int, nodes: int, cores: int, calls: int) -> None:
    """Print the table of `sleep`."""
    from tests.system.cluster import ROOT, Cluster

    with tempfile.TemporaryDirectory() as place:
        file, run = Path(place, "config.yaml"), Path(place, "run")
        config = {
            "task": {"environment": "function:tests.benchmarks.host_time:sleeper"},
            "search": {"algorithm": "map_elites", "batch": calls, "iso_sigma": 0.1},
            "budget": {"generations": generations},
            "compute": {"engine": "ray", "no_worker_timeout_s": 600.0, "first_chunk_timeout_s": 600.0},
        }
        file.write_text(yaml.safe_dump(config))
        with Cluster(Path(place)) as hosts:
            for number in range(nodes):
                hosts.start(f"node{number}", cores)
            program = [
                Path(sys.executable).parent / "es-service",
                "run",
                file,
                "--out",
                run,
                "--address",
                hosts.address,
            ]
            code, printed = hosts.run("head", *program, timeout=1800.0, PYTHONPATH=str(ROOT))
            if code:
                raise SystemExit(printed)
        history = open_run(run).history
        seconds = history.seconds_rollout.iloc[1:]
        print(f"| generation | seconds of {calls} calls | share of {nodes * cores} times one |\n| --- | --- | --- |")
        for generation, duration in seconds.items():
            print(f"| {generation} | {duration:.2f} | {calls * SLEEP_S / (nodes * cores) / duration:.0%} |")
        print(f"workers: {history.workers.iloc[-1]}")


if __name__ == "__main__":
    main()
