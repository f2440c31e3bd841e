"""What the driver knows of a rollout, which is a way to compute episodes: the declarations that config asks.

`workers/rollouts` has all rollouts by name, and what else they do where they run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from es_service.protocol.messages import PolicySpec, TaskKind, TaskSpec

CHUNK_PAIRS = (16, 64)
"""Fewest pairs of a chunk, so that the cost of messages does not exceed the gain from distributing a small population,
and most: enough to fill vector units and to outweigh the cost of a message; a lost chunk costs little."""


IN_WORDS: Mapping[TaskKind, str] = {
    "jax": "tasks in JAX",
    "python": "tasks of Python objects",
    "function": "functions of parameters",
    "caller": "episodes of the caller's own",
}
"""Kind of a task -> what the tasks of this kind are called."""


class Rollout(Protocol):
    """A way to compute episodes, as the driver sees it. Nothing here imports JAX."""

    name: str
    """The value of `compute.rollout`."""
    task_kinds: tuple[TaskKind, ...] = ("jax",)
    runs_in_threads: bool = False
    """Whether threads of one process compute side by side, without the interpreter's lock. If not, each core has a
    process."""
    runs_on_gpus: bool = False
    gpus_only_train: bool = False
    """Whether only training episodes run on a GPU, and all else on a core of its worker."""
    takes_chunks_together: bool = False
    """Whether an episode's bits do not depend on the others of its call, so that neighbouring chunks may share one."""
    copies_late_items: bool = True
    """Whether a work item may be sent to a second worker while a first one, which is late with it, still lives."""
    shares_processes: bool = True
    """Whether a process of workers may serve runs with other constants, one after another; see `staying.py`."""
    compile_s: tuple[int, int]
    """About how many seconds a worker takes to start and to compile for a kind of chunk, the first time and with the
    code on disk, for tasks with physics (tests/benchmarks/speed.md). Other tasks have compiled before it is said.
    (0, 0) if it compiles nothing."""
    chunk_pairs: tuple[int, int] = CHUNK_PAIRS
    """Limits within which `compute.chunk_pairs: auto` chooses the largest divisor of the pairs."""

    def why_not(self, task: TaskSpec, policy: PolicySpec) -> str:
        """Reason why it cannot compute episodes of a task with a policy; empty if it can.

        Unless a rollout says otherwise, the reason is the kind of the task, or what the description of the task has
        found.
        """
        if task.kind not in self.task_kinds:
            able = " and ".join(IN_WORDS[kind] for kind in self.task_kinds)
            return f"it computes {able}, and not {IN_WORDS[task.kind]}"
        return task.unsupported.get(self.name, "")

    def pair_limits(self, task: TaskSpec) -> tuple[int, int]:
        """Limits as `chunk_pairs`, for a task."""
        return self.chunk_pairs

    def episodes_together(self, task: TaskSpec) -> int | None:
        """Most episodes of an evaluation, or of policies, that are sent to a worker as one piece; None: whole chunks.

        Only where an episode's bits do not depend on the others of its chunk.
        """
        return None

    def why_not_here(self) -> str:
        """Reason why it cannot run on this machine; empty if it can."""
        return ""


Rollouts = Mapping[str, Rollout]
"""Rollouts by name, from the slowest to the fastest."""


def choose(rollouts: Rollouts, task: TaskSpec, policy: PolicySpec, *, gpu: bool, here: bool) -> str:
    """Name of the rollout that `compute.rollout: auto` means: the fastest that can run; the slowest for tasks of this
    kind if none can, whose reason is then reported.

    Args:
        gpu: whether the workers use GPUs.
        here: whether the workers run on this machine; what other machines can run is not known.
    """
    fits = {name: rollout for name, rollout in rollouts.items() if rollout.runs_on_gpus or not gpu}
    able = [name for name, rollout in fits.items() if not why_not(rollout, task, policy, here=here)]
    return able[-1] if able else next(name for name, rollout in rollouts.items() if task.kind in rollout.task_kinds)


def why_not(rollout: Rollout, task: TaskSpec, policy: PolicySpec, *, here: bool) -> str:
    """Reason why a rollout cannot compute episodes of a new run; empty if it can. Arguments are as for `choose`."""
    return rollout.why_not(task, policy) or (rollout.why_not_here() if here else "")
