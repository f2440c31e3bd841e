"""Make what `on_device.py` needs, on a machine without a GPU: code for it, inputs, and the bits that it must give.

    python -m tests.benchmarks.gpu.artefacts .gpu/ptx

writes to a folder the PTX, code of each limit of registers (by `ptxas`, which must be installed), arguments and results
of the kernels of this processor, which tests compare with the reference implementation, and a copy of `on_device.py`.
The registers, stack and spills that ptxas reports are printed and kept in `ptxas.json`.
"""

from __future__ import annotations

import argparse
import json
import lzma
import re
import shutil
import subprocess
from pathlib import Path

import jax
import numpy as np

from es_service.protocol.noise import NORMAL_STD, normal_integers
from tests.benchmarks.gpu import on_device
from tests.benchmarks.gpu.kernels import (
    FIVE,
    KEY,
    division_functions,
    episode_functions,
    inputs_of,
    operation_arguments,
    operation_functions,
    operations,
    physics_functions,
    physics_of,
    policy_layout,
    worker_spec,
)
from workers.environments import make_environment
from workers.episode import episode_steps
from workers.policy import initial_parameters
from workers.simd.backend.native import pack
from workers.simd.backend.ptx import ptx
from workers.simd.backend.target import target_of
from workers.simd.episodes import check
from workers.simd.episodes.compiled import compile_episodes
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.frontend.trace import trace_jaxpr
from workers.simd.graph.elementary import TANH
from workers.simd.graph.schedule import evaluate

ARCHITECTURE = "sm_90a"
LANES, STEPS = 256, 200
PAIRS = 32
"""Pairs whose training episodes are compared."""
ROLLOUT_STEPS = (1, 2, 10, 100, 250, 1000)
"""Steps after which their words are kept."""
FULL_STEPS = (1, 2, 10, 100, 200)
"""Steps after which all words are kept; of the others a digest of each lane's."""


def assembled(folder: Path, name: str, text: str, registers: int | None = None) -> dict:
    """Assemble PTX to NAME.cubin in a folder; returns what ptxas says of each kernel.

    Args:
        registers: most registers of a thread; as many as ptxas likes if None.
    """
    source = folder / f"{name}.ptx"
    source.write_text(text)
    limit = [f"-maxrregcount={registers}"] if registers else []
    command = ["ptxas", "-v", f"-arch={ARCHITECTURE}", *limit, str(source), "-o", str(folder / f"{name}.cubin")]
    report = reported(command, f"ptxas refuses {source}")
    source.unlink()
    return report


def reported(command: list[str], refused: str) -> dict:
    """Run a compiler and pack its result, whose name comes last; returns what ptxas says of each kernel."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{refused}: {done.stderr}")
    code = Path(command[-1])
    Path(f"{code}.xz").write_bytes(lzma.compress(code.read_bytes()))
    code.unlink()
    pattern = r"Function properties for (\w+)\s+(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads\s.*?Used (\d+) registers"  # noqa: E501
    return {
        kernel: {"stack": int(stack), "spill_stores": int(stores), "spill_loads": int(loads), "registers": int(used)}
        for kernel, stack, stores, loads, used in re.findall(pattern, done.stderr, re.DOTALL)
    }


def rows(tree) -> np.ndarray:
    """Words [word, lane] of arrays [lane, ...]."""
    leaves = jax.tree.leaves(tree)
    return np.ascontiguousarray(pack(leaves, len(leaves[0]))[0])


def physics_files(folder: Path, task: str) -> None:
    """Write the arguments and the expected results of a task's physics."""
    physics = physics_of(task)
    begin, step = compile_kernel(physics.begin, KEY), compile_kernel(physics.step, physics.carry, physics.action)
    keys = np.random.default_rng(0).integers(0, 2**32, (LANES, 4), dtype=np.uint32)
    actions = on_device.physics_actions(STEPS, on_device.ACTIONS, LANES).transpose(0, 2, 1)
    carry = begin(keys)
    kept, digests, first = {0: rows(carry)}, [on_device.digest(rows(carry))], carry
    for number in range(1, STEPS + 1):
        carry = step(carry, actions[number - 1])
        digests.append(on_device.digest(rows(carry)))
        if number in FULL_STEPS:
            kept[number] = rows(carry)
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(physics.step)(physics.carry, physics.action))
    given = np.concatenate([rows(first), rows([actions[0]])])[:, :8]
    wanted = np.stack(
        [np.asarray(result).view(np.uint32) for result in evaluate(graph, outputs, np.ascontiguousarray(given))]
    )
    assert on_device.differing(kept[1][:, :8], wanted) == 0, "the kernel of this processor differs from its definition"
    np.savez_compressed(
        folder / f"{task}.npz",
        keys=np.ascontiguousarray(keys.T),
        digests=np.stack(digests),
        numbers=np.array(list(kept)),
        states=np.stack(list(kept.values())),
    )


def policy_code(folder: Path, task: str) -> dict:
    """Compile `policy.cu` for a task to `TASK_policy.cubin` in a folder; returns what ptxas says of each kernel."""
    source = Path(__file__).with_name("policy.cu")
    flags = ["-O3", "-ftz=true", "-fmad=false", "-prec-div=true", "-prec-sqrt=true", "-Xptxas", "-v", *defined(task)]
    command = [
        "nvcc",
        "-cubin",
        f"-arch={ARCHITECTURE}",
        *flags,
        str(source),
        "-o",
        str(folder / f"{task}_policy.cubin"),
    ]
    return reported(command, f"nvcc refuses {source}")


def defined(task: str) -> list[str]:
    """Definitions with which `policy.cu` is compiled for a task."""
    sizes = {"INPUTS": len(inputs_of(task)), "OUTPUTS": worker_spec(task).policy.outputs}
    parts = zip(("ABOVE", "BELOW"), TANH, strict=True)
    tanh = {f"TANH_{name}_{k}": f"{x!r}f" for name, part in parts for k, x in enumerate(part)}
    return [f"-D{name}={value}" for name, value in (sizes | tanh).items()]


def rollout_files(folder: Path, task: str) -> None:
    """Write the arguments of a task's training episodes, and what the first PAIRS pairs must give."""
    spec, inputs_O = worker_spec(task), inputs_of(task)
    layout = policy_layout(spec.policy, inputs_O)
    rng = np.random.default_rng(2)
    centre_D = initial_parameters(spec.policy, "unit_columns", 5)
    unit = np.float32(0.05 / NORMAL_STD)
    mean_O, std_O = np.zeros((2, spec.policy.widths[0]), np.float32)
    mean_O[inputs_O] = rng.normal(0, 0.1, len(inputs_O))
    std_O += rng.uniform(0.5, 2.0, len(std_O)).astype(np.float32)
    noise_keys, reset_keys, action_keys = (
        rng.integers(0, 2**32, (count, 4), dtype=np.uint32) for count in (PAIRS, 2 * PAIRS, 2 * PAIRS)
    )
    kernel = compile_episodes(make_environment(task, {}), spec, inputs_O, training=True)
    packed = kernel.network.pack(centre_D)
    carries, go = kernel.started(packed, float(unit), mean_O, std_O, noise_keys, reset_keys, action_keys)
    # What is not masked after an episode's end differs between kernels: the CPU's has no policy for a dead block.
    kept, last = {0: by_lane(carries)}, 0
    for number in ROLLOUT_STEPS:
        go(number - last)
        kept[number], last = by_lane(carries), number
    # One step of the policy by its definition: what it sees after a reset, and its outputs.
    steps = episode_steps(make_environment(task, {}), spec, training=True, inputs_O=inputs_O)
    inputs = jax.ShapeDtypeStruct((len(inputs_O),), np.float32)
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(steps.normalised_observation)(kernel.carry, inputs, inputs))
    constants = np.stack([mean_O[inputs_O], std_O[inputs_O]])
    lanes = np.broadcast_to(constants.reshape(-1, 1), (constants.size, 2 * PAIRS)).view(np.uint32)
    seen = np.stack(evaluate(graph, outputs, np.concatenate([kept[0], lanes])))
    actions = check.policy(spec.policy, inputs_O, seen, check.perturbed(centre_D, unit, noise_keys))
    noise = np.stack([normal_integers(np, key, layout.noise) for key in noise_keys[:2]])
    np.savez_compressed(
        folder / f"{task}_rollout.npz",
        unit=unit,
        centre=centre_D[layout.centre],
        coordinates=layout.noise,
        constants=constants.reshape(-1),
        noise_keys=noise_keys,
        reset_keys=np.ascontiguousarray(reset_keys.T),
        action_keys=np.ascontiguousarray(action_keys.T),
        noise=(((noise - 1) >> 1) + 128).astype(np.uint8),
        seen=seen.view(np.uint32),
        actions=actions.view(np.uint32),
        numbers=np.array(list(kept)),
        carries=np.stack(list(kept.values())),
        alive_word=kernel.alive_word,
        episode_words=kernel.episode_words,
    )


def by_lane(carries: np.ndarray) -> np.ndarray:
    """Words [word, lane] of [block, word, lane]."""
    return np.concatenate(list(carries), axis=1)[:, : 2 * PAIRS].copy()


def operation_files(folder: Path) -> None:
    """Write the arguments and the expected results of all operations."""
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(operations)(*FIVE))
    given = operation_arguments()
    with np.errstate(invalid="ignore"):
        results = [np.asarray(result) for result in evaluate(graph, outputs, given)]
    np.savez_compressed(
        folder / "operations.npz",
        given=given,
        floats=np.array([result.dtype == np.float32 for result in results]),
        wanted=np.stack(
            [result.astype(np.uint32) if result.dtype == bool else result.view(np.uint32) for result in results]
        ),
    )


def straight_code(kib: int) -> str:
    """PTX of the kernel `code(found [thread], threads, trips)`, whose loop is of fused products, KIB in all."""
    registers = [f"%f{number}" for number in range(8)]
    body = "\n".join(f"fma.rn.f32 {registers[k % 8]}, {registers[k % 8]}, %f8, %f9;" for k in range(64 * kib))
    return f"""
.version 7.8
.target sm_90
.address_size 64
.visible .entry code(.param .u64 found, .param .u64 threads, .param .u64 trips) {{
.reg .f32 %f<10>; .reg .b64 %d<4>; .reg .b32 %r<4>; .reg .pred %p;
ld.param.u64 %d0, [found]; ld.param.u64 %d1, [trips];
mov.u32 %r0, %tid.x; mov.u32 %r1, %ctaid.x; mov.u32 %r2, %ntid.x; mad.lo.s32 %r3, %r1, %r2, %r0;
mul.wide.u32 %d2, %r3, 4; add.s64 %d0, %d0, %d2;
mov.f32 %f8, 0f3F7FFFFE; cvt.rn.f32.s32 %f9, %r3;
{" ".join(f"mov.f32 {register}, %f9;" for register in registers)}
again:
{body}
add.s64 %d1, %d1, -1; setp.gt.s64 %p, %d1, 0; @%p bra again;
{" ".join(f"add.f32 %f0, %f0, {register};" for register in registers[1:])}
st.global.f32 [%d0], %f0; ret;
}}
"""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    target, said = target_of("ptx"), {}
    said["operations"] = assembled(folder, "operations", ptx(operation_functions(target)))
    operation_files(folder)
    said["division"] = assembled(folder, "division", ptx(division_functions(target)))
    for kib in on_device.CODE_KIB:
        assembled(folder, f"code_{kib}", straight_code(kib))
    for task in on_device.PHYSICS:
        text = {quick: ptx(physics_functions(physics_of(task), target, quick=quick)) for quick in (False, True)}
        for name, (registers, quick) in on_device.VARIANTS.items():
            said[f"{task}_{name}"] = assembled(folder, f"{task}_{name}", text[quick], registers)
        physics_files(folder, task)
    for task in on_device.ROLLOUTS:
        text = {quick: ptx(episode_functions(task, target, quick=quick)) for quick in (False, True)}
        for name, (registers, quick) in on_device.VARIANTS.items():
            whole = f"{task}_episodes_{name}"
            said[whole] = assembled(folder, whole, text[quick], registers)
        said[f"{task}_policy"] = policy_code(folder, task)
        rollout_files(folder, task)
    (folder / "ptxas.json").write_text(json.dumps(said, indent=1))
    for name, kernels in said.items():
        print(name, json.dumps(kernels))
    shutil.copy(on_device.__file__, folder)


if __name__ == "__main__":
    main()
