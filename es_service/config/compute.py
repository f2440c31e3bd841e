"""The config section `compute`: how the work is divided into chunks and where it runs."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from es_service.config.fields import Count, NotNegative, Patience, Positive, Section, Switch, Text


class WorkerResources(Section):
    """Resources of one worker."""

    cpu: Literal["auto"] | Count = Field(
        "auto",
        description="Cores of each Ray actor, all of which it uses. auto: those of a node if the nodes are equal, so "
        "that a node needs few messages, else 1; with a GPU 1. It never changes results.",
    )
    gpu: NotNegative = Field(
        0.0,
        description="GPUs of each worker. With a fraction below 1, workers share a GPU; with 0, episodes run on the "
        "CPU. With rollout xla, a GPU has bits of its own.",
    )


class ComputeConfig(Section):
    """How the work is divided and where it runs. Only `rollout` and the three `*_pairs` are constants of the run."""

    engine: Literal["ray", "inline"] = Field(
        description="How the workers run. inline: as child processes of this program. ray: as Ray actors, on this "
        "machine or in a cluster. auto: ray if an address is given or actors have several cores, else inline, which "
        "starts sooner and sends messages faster."
    )
    inline_workers: Literal["processes", "threads"] = Field(
        "processes",
        description="With engine inline: whether each worker is a process, or all workers are threads of one process. "
        "Threads need rollout simd and take less memory, but if one worker crashes, all are lost.",
    )
    address: Text | None = Field(
        None,
        description="With engine ray: address of the cluster to connect to, HOST:PORT, or auto for the cluster on this "
        "machine; null starts a Ray instance for this run.",
    )
    workers: Literal["auto"] | Count = Field(
        "auto",
        description="Number of workers, each of which is a core, or with GPUs its share of them. auto: every core of "
        "the machine or cluster that has work, or with the engine inline and GPUs as many as these have room for; with "
        "a number in worker_resources.cpu, it also asks the cluster for more. No more start than there is work for, in "
        "whole actors. It never changes results.",
    )
    platform: Literal["any", "x86_64", "aarch64"] = Field(
        "any",
        description="Architecture of the processors that work for the run; a worker on another one is refused. any: "
        "all. What computed the run is recorded, and its digest is marked mixed once there are several kinds.",
    )
    max_workers_per_core: Count = Field(
        4,
        description="Most workers for each core where all workers are on this machine; a larger number of workers is "
        "refused. Raise it only for a task whose steps wait for something outside, such as another program.",
    )
    worker_resources: WorkerResources = Field(
        default_factory=lambda: WorkerResources(cpu="auto", gpu=0.0),
        description="Resources of one worker, which Ray reserves for its actor if the engine is ray.",
    )
    rollout: Text = Field(
        description="How episodes are computed. simd: by code compiled for this kind of processor or GPU, about twenty "
        "times faster. xla: by JAX, for tasks that simd cannot compile. host: by the Python code of a task "
        "that is not in JAX. auto: the fastest that can."
    )
    chunk_pairs: Count = Field(
        description="Pairs in one chunk; must divide search.pairs. auto: the largest divisor of search.pairs up to an "
        "eighth of it (this limit is at least 16 and at most 64), and a multiple of 8 if there is one."
    )
    rollout_block_pairs: Count = Field(
        description="With rollout xla: pairs whose episodes step together, so that their weights stay in the cache; "
        "must divide chunk_pairs. auto: the largest divisor of chunk_pairs up to 32 whose weights take at most 5 MiB."
    )
    gradient_block_pairs: Count = Field(
        description="Pairs summed into one partial gradient; at most search.pairs. auto: the smallest number of whole "
        "chunks that gives at most 32 blocks and makes each block large enough to be worth a message."
    )
    chunk_timeout_s: Positive = Field(
        30.0,
        description="Shortest deadline of a chunk in seconds; slow chunks make the deadline of later chunks longer, "
        "and each attempt may take twice as long as the one before. It counts anew whenever a worker reports progress.",
    )
    first_chunk_timeout_s: Positive = Field(
        120.0,
        description="Deadline in seconds of a chunk while it is not known how long chunks of its kind take, which is "
        "until the first one is done; at least chunk_timeout_s. Compilation does not count.",
    )
    compile_timeout_s: Positive = Field(
        120.0,
        description="Deadline in seconds for the compilation that a worker does before its first chunk of each kind; "
        "for a task of Python objects, longest time in which one of them must be made or reset.",
    )
    max_attempts: Count = Field(4, description="Attempts to compute a chunk before the run stops with its error.")
    place_timeout_s: Positive | None = Field(
        None,
        description="With engine ray in a cluster: longest time in seconds for which the run waits for a first place, "
        "before it stops; null: as long as it takes.",
    )
    no_worker_timeout_s: Patience = Field(
        120.0,
        description="Seconds without a live worker, after the first had come up, after which the run stops. A worker "
        "that has not started after half of this time is replaced; on a busy machine a start takes up to ten seconds.",
    )
    parent_cache_mb: Count = Field(
        256,
        description="Most MiB of elites' parameters that each worker keeps, of which it makes the policies of "
        "map_elites; what it does not keep is sent again. It never changes results.",
    )
    worker_output_bytes: Count = Field(
        2**20,
        description="About how many bytes are kept of what each worker prints, its simulators included: the newest. "
        "The last lines are told if the worker is lost.",
    )
    dispatch_log: Switch = Field(
        False,
        description="Whether the run folder gets a dispatch.jsonl: what was sent to each worker, what it answered, and "
        "why it was lost.",
    )


COMPUTE_CONSTANTS = ("rollout", "chunk_pairs", "rollout_block_pairs", "gradient_block_pairs")
"""Keys of `compute` that affect floating-point results and are therefore constants of the run."""
ENGINE_IMPLIES: dict[str, dict[str, Any]] = {
    "inline": {"compute.address": None, "compute.worker_resources.cpu": "auto"},
    "ray": {"compute.inline_workers": "processes"},
}
"""Engine -> settings that only the other engine uses, with the values that they must have with this one."""


def implied_by(engine: str | None, address: str | None) -> dict[str, Any]:
    """Settings that a choice of the engine or of a cluster's address implies; None: no choice."""
    if address is None:
        return ENGINE_IMPLIES.get(engine or "", {})
    return ENGINE_IMPLIES["ray"] | ({} if engine else {"compute.engine": "ray"})  # only a Ray cluster can be joined
