"""How fast is MuJoCo's physics (MJX) by simd, beside C MuJoCo and beside xla, and how near is it to C MuJoCo?

    python -m tests.benchmarks.mujoco                                  # all rows, one core: hours with xla
    python -m tests.benchmarks.mujoco --rows brax: --cores 1 2 --without xla
    python -m tests.benchmarks.mujoco --table                          # what has been measured, for the guide's tables

A row is a model with its settings. In each of five rounds the sides take turns in one process, whose processor time is
measured: the compiled control step, C MuJoCo by `mujoco.rollout` with the same settings and with its own (100
iterations, 50 of the line search, tolerance 1e-8), and `jit(vmap(step))` at the fastest of three batches. All begin
with the same states of robots that fall, are pushed and are driven at random. With two cores, two processes do the same
at a time, and their rates are added. The errors are those of one control step from 1,000 states, relative to the
greatest velocity, against C MuJoCo with its own settings in float64.

The models are Brax's, Gymnasium's and Playground's. For the last, `pip download playground==0.2.0 --no-deps`, unpack
the file and name the folder with --playground, or install it; without it, its rows are left out.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from es_service.protocol.machine import cpu_kind, platform_info
from es_service.protocol.noise import Domain, stream_keys
from es_service.protocol.process_environment import worker_environment

RESULTS = Path(__file__).parent / "results" / "mujoco.csv"
ROUNDS, SECONDS = 5, 0.4
SIMD_BATCHES, XLA_BATCHES = (64, 128, 512), (8, 32, 128)
MOST = 512
"""States that are made; a smaller batch takes the first of them."""
WORLDS, HORIZON = 32, 10
"""Rollouts of C MuJoCo side by side, and control steps of each."""
STATES = 1000
Call = Callable[[], object]
SIDES = ("simd", "c", "c_own", "xla", "spring")
"""Columns of rates: ours, `mujoco.rollout` with the same settings and with its own, xla, and by simd the same task with
Brax's springs."""


BESIDE = {"c": "/ C, same settings", "c_own": "/ C, its own", "xla": "/ xla", "spring": "/ springs"}
"""Side -> head of the column of how many times as fast simd is."""
ERRORS = ("contact_median", "contact_p99", "contact_max", "free_p99", "ulp_p99")


def rows() -> dict[str, Callable[[Path | None], Any]]:
    """Row -> its `Example`, or None if its files are not there, given the folder of Playground."""
    from tests import mujoco_ants as ants
    from tests import mujoco_models as models

    def as_c(example: Any) -> Any:
        return example._replace(model=models.as_c(example.model))

    made: dict[str, Callable[[Path | None], Any]] = {
        f"brax:ant {iterations} x {search}": lambda _, a=iterations, b=search: models.brax_ant(a, b)
        for iterations, search in ((1, 4), (4, 8), (6, 10))
    }
    made["brax:ant as C's own"] = lambda _: as_c(models.brax_ant())
    made |= {
        f"playground:{name}": lambda near, of=name: models.of_playground(of, near) for name in models.OF_PLAYGROUND
    }
    made |= {f"gymnasium:{name}": lambda _, of=name: models.of_gymnasium(of) for name in models.OF_GYMNASIUM}
    for task in ants.ENVIRONMENTS:
        for integrator in ("RK4", "Euler"):
            made[f"{task} {integrator}"] = lambda _, a=task, b=integrator: ants.example(a, b)
    return made


def measure(row: str, near: Path | None, sides: Sequence[str], folder: Path, all_pairs: bool, meet: bool) -> dict:
    """All of a row, in this process.

    Args:
        folder: cache of compiled code; empty, so that compiling is cold.
        meet: whether to say "ready" and wait for a line before the rounds, for processes that compute side by side.
    """
    import jax

    from tests import mujoco_models as models
    from workers.environments import make_environment, mujoco_parts
    from workers.simd.backend.native import aligned, pack
    from workers.simd.episodes.kernel import compile_kernel

    example = rows()[row](near)
    model, substeps = example.model, example.substeps
    own = models.as_c(model)
    mjx_model = mujoco_parts.put_model(example.of_mjx or model, all_pairs=all_pairs)
    data: Any = mujoco_parts.mjx.make_data(mjx_model)

    def step(state: Any, ctrl: Any) -> Any:
        look, contacts = (lambda data: ()), example.contacts
        return mujoco_parts.step_and_look(mjx_model, state, ctrl, substeps, look, contacts=contacts)[0]

    started, cpu_started = time.perf_counter(), time.process_time()
    kernel = compile_kernel(step, mujoco_parts.start(mjx_model), np.zeros(model.nu, np.float32), folder=folder)
    result: dict[str, Any] = {
        "cold_s": time.perf_counter() - started,
        "cold_cpu_s": time.process_time() - cpu_started,
        "jaxpr_s": kernel.facts.jaxpr_s,
        "operations": kernel.facts.computed,
        "code_kb": kernel.facts.code_bytes / 1000,
        "lanes": kernel.target.width,
        "nv": model.nv,
        "constraints": int(data._impl.nefc),
        "note": example.note,
    }
    if not meet:
        result |= _errors(models, kernel, example, own)
    states = _states(models, example, MOST, 1)
    given = states, models.random_ctrl(model, MOST, np.random.default_rng(1))

    def call_of_simd(batch: int) -> Call:
        words = pack([leaf[:batch] for leaf in jax.tree.leaves(given)], kernel.target.width)
        out = aligned((len(words), kernel.words_out, kernel.target.width))
        return lambda: kernel.run(words, out)

    def call_of_spring(batch: int) -> Call:
        environment = make_environment(example.spring, {})
        keys = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(batch))
        begun = compile_kernel(environment.reset, keys[0], folder=folder)(keys)
        action = np.random.default_rng(1).uniform(-1.0, 1.0, (batch, model.nu)).astype(np.float32)
        first = jax.tree.map(lambda leaf: leaf[0], (begun, action))
        stepped = compile_kernel(lambda *of: environment.step(*of)[0], *first, folder=folder)
        words = pack(jax.tree.leaves((begun, action)), stepped.target.width)
        out = aligned((len(words), stepped.words_out, stepped.target.width))
        return lambda: stepped.run(words, out)

    compiled = jax.jit(jax.vmap(step))

    def call_of_xla(batch: int) -> Call:
        placed = jax.tree.map(lambda leaf: jax.device_put(leaf[:batch]), given)
        return lambda: jax.block_until_ready(compiled(*placed))

    runs = {
        side: (WORLDS * HORIZON, _c_rollout(models, of, substeps, states))
        for side, of in (("c", model), ("c_own", own))
    }
    for side, call_of, batches in (("simd", call_of_simd, SIMD_BATCHES), ("xla", call_of_xla, XLA_BATCHES)):
        if side in sides:
            runs[side] = max(((batch, call_of(batch)) for batch in batches), key=lambda run: _rate(*run))
            result[f"{side}_batch"] = runs[side][0]
    if "spring" in sides and example.spring:
        runs["spring"] = MOST, call_of_spring(MOST)
    if meet:
        print("ready", flush=True)
        sys.stdin.readline()
    rates: dict[str, list[float]] = {side: [] for side in SIDES if side in sides and side in runs}
    for number in range(ROUNDS):
        for side in list(rates)[:: 1 if number % 2 else -1]:
            rates[side].append(_rate(*runs[side]))
    return result | {"rates": rates}


def _states(models: Any, example: Any, count: int, seed: int) -> Any:
    if example.states is not None:
        return example.states(count, seed)
    return models.c_states(example.model, example.substeps, count, seed)


def _errors(models: Any, kernel: Any, example: Any, own: Any) -> dict[str, float]:
    """How far one control step of the kernel is from C MuJoCo's own, with contacts and without."""
    model, substeps = example.model, example.substeps
    states = _states(models, example, STATES, 0)
    ctrl = models.random_ctrl(model, STATES, np.random.default_rng(0))
    ours, theirs = kernel(states, ctrl), models.c_step(own, substeps, states, ctrl)
    moved = models.c_step(own, substeps, models.one_ulp(states), ctrl)
    errors, use = models.relative_error(ours.qvel, theirs.qvel), theirs.comparable()
    result = {"ulp_p99": models.quantiles(models.relative_error(moved.qvel, theirs.qvel)[use])["p99"]}
    for name, chosen in (("contact", theirs.contacts > 0), ("free", theirs.contacts == 0)):
        result |= {f"{name}_{key}": value for key, value in models.quantiles(errors[chosen & use]).items()}
    return result


def _c_rollout(models: Any, model: Any, substeps: int, states: Any) -> Call:
    """A call that does HORIZON control steps from each of WORLDS states on the calling thread."""
    from mujoco import rollout

    from workers.environments.mujoco_parts import mujoco

    data, spec = mujoco.MjData(model), mujoco.mjtState.mjSTATE_FULLPHYSICS
    first = np.zeros((WORLDS, mujoco.mj_stateSize(model, spec)))
    for row, at in zip(first, range(0, MOST, MOST // WORLDS), strict=True):
        data.qpos[:], data.qvel[:], data.act[:] = states.qpos[at], states.qvel[at], states.act[at]
        mujoco.mj_getState(model, data, row, spec)
    ctrl = models.random_ctrl(model, WORLDS * HORIZON, np.random.default_rng(2)).reshape(WORLDS, HORIZON, model.nu)
    ctrl = np.repeat(ctrl, substeps, axis=1).astype(float)
    warmstart = np.ascontiguousarray(states.warmstart[:: MOST // WORLDS].astype(float))
    here = rollout.Rollout(nthread=0)
    return lambda: here.rollout(model, [data], first, ctrl, initial_warmstart=warmstart)


def _rate(units: int, call: Call) -> float:
    """Units per second of processor time of a call that does so many; the first call does not count."""
    call()
    calls, started = 0, time.process_time()
    while (taken := time.process_time() - started) < SECONDS:
        call()
        calls += 1
    return units * calls / taken


def _children(requests: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Answers of processes like a worker's, which measure at the same time if they are several."""
    environment = worker_environment(os.environ) | {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}
    children = [
        subprocess.Popen(
            [sys.executable, "-m", "tests.benchmarks.mujoco", "--measure", json.dumps(request)],
            env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for request in requests
    ]  # fmt: skip
    if len(children) > 1:
        for child in children:
            assert child.stdout is not None
            child.stdout.readline()
        for child in children:
            assert child.stdin is not None
            child.stdin.write("\n")
            child.stdin.flush()
    answers = []
    for child in children:
        out, problem = child.communicate()
        if child.returncode:
            return [{"note": problem.strip().splitlines()[-1][:300]}]
        answers.append(json.loads(out.splitlines()[-1]))
    return answers


def measured(row: str, cores: int, near: Path | None, sides: Sequence[str], all_pairs: bool) -> dict[str, Any]:
    """A row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        request = {"row": row, "near": near and str(near), "sides": [*sides], "folder": folder, "all_pairs": all_pairs}
        answers = _children([request | {"meet": cores > 1}] * cores)
    rates = [answer.pop("rates") for answer in answers if "rates" in answer]
    result = {"row": row, "cores": cores, "all_pairs": all_pairs, **answers[0]}
    together = {side: np.sum([of[side] for of in rates], axis=0) for side in rates[0]} if rates else {}
    for side, rate in together.items():
        result[side] = np.median(rate)
        if side != "simd" and "simd" in together:
            ratio = together["simd"] / rate
            result |= {f"times_{side}": np.median(ratio), f"least_{side}": ratio.min(), f"most_{side}": ratio.max()}
    return result | {"cpu": cpu_kind(), **{name: platform_info()[name] for name in ("es-service", "jax")}}


def add(row: Mapping[str, Any], to: Path) -> None:
    """Append a row to a table, in place of that of the same measurement on the same kind of processor."""
    new = pd.DataFrame([row])
    if to.exists():
        same = ["row", "cores", "all_pairs", "cpu"]
        old = pd.read_csv(to)
        old = old[~(old[same] == new[same].iloc[0]).all(axis=1)]
        new = pd.concat([old, new]) if len(old) else new
    new.to_csv(to, index=False, float_format="%.4g", lineterminator="\n")


def table(of: Path) -> str:
    """The table of the guide."""
    rows_of = pd.read_csv(of)
    sides = [side for side in SIDES[1:] if f"times_{side}" in rows_of]
    head = (
        "| model, cores | degrees, constraints | simd, control steps/s | "
        f"{' | '.join(BESIDE[side] for side in sides)} | "
        "from C's own: contact, median; 99 %; greatest | no contact, 99 %; C after one ulp, 99 % | "
        "operations, code | compiled in (of the processor) |"
    )
    lines = [head, "|" + " --- |" * (7 + len(sides))]

    def times(row: Any, side: str) -> str:
        if np.isnan(row.get(f"times_{side}", np.nan)):
            return "-"
        values = (row[f"{part}_{side}"] for part in ("times", "least", "most"))
        return "{} ({} to {})".format(*(f"{value:,.0f}" if value >= 1000 else f"{value:.3g}" for value in values))

    for row in rows_of.to_dict("records"):
        name = f"{row['row']}{', all pairs' if row['all_pairs'] else ''}, {row['cores']}"
        if np.isnan(row["simd"]):
            lines.append(f"| {name} | {row['note']} |" + " |" * (5 + len(sides)))
            continue
        error = {key: "-" if np.isnan(row.get(key, np.nan)) else f"{row[key]:.1e}" for key in ERRORS}
        cells = [
            name, f"{row['nv']:.0f}, {row['constraints']:.0f}", f"{row['simd']:,.0f}",
            *(times(row, side) for side in sides),
            "; ".join(error[key] for key in ERRORS[:3]), "; ".join(error[key] for key in ERRORS[3:]),
            f"{row['operations']:,.0f}, {row['code_kb']:.0f} kB", f"{row['cold_s']:.0f} s ({row['cold_cpu_s']:.0f})",
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def peers(of: Path) -> str:
    """The rows of the guide's table of peers: `mujoco.rollout` with its own settings on one core, and ours."""
    lines = []
    for row in pd.read_csv(of).query("cores == 1 and not all_pairs and simd == simd").to_dict("records"):
        times = "**{:.3g}** ({:.3g} to {:.3g})".format(*(row[f"{part}_c_own"] for part in ("times", "least", "most")))
        lines.append(f"| {row['row']} | {row['c_own']:,.0f} | {row['simd']:,.0f} | {times} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", default=[""], help="only rows that have one of these texts in their names")
    parser.add_argument("--cores", nargs="+", type=int, default=[1], help="numbers of processes side by side")
    parser.add_argument("--without", nargs="+", default=[], choices=SIDES[1:], help="sides that are left out")
    parser.add_argument("--all-pairs", action="store_true", help="all contacts, not only so many as the model allows")
    parser.add_argument(
        "--playground", type=Path, help="folder that contains mujoco_playground; else the installed one"
    )
    parser.add_argument("--results", type=Path, default=RESULTS, help="the table to which rows are added")
    parser.add_argument("--table", action="store_true", help="print the guide's tables, and measure nothing")
    parser.add_argument("--measure", type=json.loads, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(arguments.results), peers(arguments.results), sep="\n\n")
        return
    if arguments.measure:
        given = arguments.measure
        near = Path(given.pop("near")) if given["near"] else given.pop("near")
        print(json.dumps(measure(near=near, **given | {"folder": Path(given["folder"])})))
        return
    chosen = [row for row in rows() if any(text in row for text in arguments.rows)]
    if not chosen:
        parser.error(f"--rows {' '.join(arguments.rows)}: no row has this in its name; there are: {', '.join(rows())}")
    sides = [side for side in SIDES if side not in arguments.without]
    for row in chosen:
        if rows()[row](arguments.playground) is None:
            print(
                f"{row} is left out: its files are not there; pip install --no-deps playground==0.2.0, or --playground"
            )
            continue
        for cores in arguments.cores:
            result = measured(row, cores, arguments.playground, sides, arguments.all_pairs)
            add(result, arguments.results)
            print(json.dumps(result, default=float), flush=True)


if __name__ == "__main__":
    main()
