"""`python -m tests.benchmarks.gpu.compare FOLDER`: whether returns of a GPU have the distribution of those of a CPU.

FOLDER has the arrays that `python -m tests.benchmarks.gpu` kept of some cases. The same episodes, with the same starts
and noise, are computed here by simd; since physics is chaotic, members differ, and distributions must not.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import ks_2samp

from tests.benchmarks.gpu.case import arguments_of, spec_of
from workers.rollouts import BACKENDS


def main(folder: Path) -> None:
    for line in (folder / "cases.jsonl").read_text().splitlines():
        case = json.loads(line)
        if not case.get("keep_returns") or "error" in case:
            continue
        with np.load(folder / f"returns_{case['task'].replace(':', '_')}_{case['way']}.npz") as kept:
            theirs = dict(kept)
        spec = replace(spec_of(case), rollout="simd")
        ours = BACKENDS["simd"].chunk_functions(spec).training(*arguments_of(spec))
        columns = {"return": (theirs["returns"], ours.returns), "steps": (theirs["steps"], ours.steps)}
        descriptors = (theirs["descriptor"], ours.descriptor)
        columns |= {f"descriptor {d}": tuple(x[..., d] for x in descriptors) for d in range(2)}
        for name, (gpu, cpu) in columns.items():
            gpu, cpu = np.ravel(gpu), np.ravel(cpu)
            test: Any = ks_2samp(gpu, cpu)
            print(
                f"{case['task']:10s} {name:13s} GPU {gpu.mean():10.3f} +- {gpu.std():8.3f}   CPU {cpu.mean():10.3f} +- "
                f"{cpu.std():8.3f}   Kolmogorov-Smirnov {test.statistic:.4f}, p {test.pvalue:.3f}, "
                f"not finite {np.count_nonzero(~np.isfinite(gpu))}"
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
