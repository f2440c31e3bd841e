"""Make what `on_device.py` needs, on a machine without a GPU: code for it, inputs, and the bits that it must give.

    python -m tests.benchmarks.gpu.artefacts .gpu/ptx

writes to a folder the PTX, code of each limit of registers (by `ptxas`, which must be installed), arguments and results
of the kernels of this processor, which tests compare with the reference implementation, and a copy of `on_device.py`.
The registers, stack and spills that ptxas reports are printed and kept in `ptxas.json`.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
from pathlib import Path

import jax
import numpy as np

from tests.benchmarks.gpu import on_device
from tests.benchmarks.gpu.kernels import (
    FIVE,
    KEY,
    operation_arguments,
    operation_functions,
    operations,
    physics_functions,
    physics_of,
)
from workers.simd.backend.ptx import ptx
from workers.simd.backend.target import target_of
from workers.simd.backend.words import pack
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.frontend.trace import trace_jaxpr
from workers.simd.graph.reference import evaluate

ARCHITECTURE = "sm_90a"
LANES, STEPS = 256, 200
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
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"ptxas refuses {source}: {done.stderr}")
    source.unlink()
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
    actions = np.random.default_rng(1).uniform(-1, 1, (STEPS, LANES, *physics.action.shape)).astype(np.float32)
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
        [np.asarray(one).view(np.uint32) for one in evaluate(graph, outputs, np.ascontiguousarray(given))]
    )
    assert on_device.differing(kept[1][:, :8], wanted) == 0, "the kernel of this processor differs from its definition"
    np.savez_compressed(
        folder / f"{task}.npz",
        keys=np.ascontiguousarray(keys.T),
        actions=np.ascontiguousarray(actions.transpose(0, 2, 1)),
        digests=np.stack(digests),
        numbers=np.array(list(kept)),
        states=np.stack(list(kept.values())),
    )


def operation_files(folder: Path) -> None:
    """Write the arguments and the expected results of all operations."""
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(operations)(*FIVE))
    given = operation_arguments()
    with np.errstate(invalid="ignore"):
        found = [np.asarray(one) for one in evaluate(graph, outputs, given)]
    np.savez_compressed(
        folder / "operations.npz",
        given=given,
        floats=np.array([one.dtype == np.float32 for one in found]),
        wanted=np.stack([one.astype(np.uint32) if one.dtype == bool else one.view(np.uint32) for one in found]),
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    target, said = target_of("ptx"), {}
    said["operations"] = assembled(folder, "operations", ptx(operation_functions(target)))
    operation_files(folder)
    for task in on_device.PHYSICS:
        text = ptx(physics_functions(physics_of(task), target))
        for registers in on_device.REGISTERS:
            said[f"{task}_{registers}"] = assembled(folder, f"{task}_{registers}", text, registers)
        physics_files(folder, task)
    (folder / "ptxas.json").write_text(json.dumps(said, indent=1))
    for name, kernels in said.items():
        print(name, json.dumps(kernels))
    shutil.copy(on_device.__file__, folder)


if __name__ == "__main__":
    main()
