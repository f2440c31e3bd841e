"""The section of a config that says how the work is cut and where it runs."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from es_service.config.fields import Count, NotNegative, Positive, Section, Switch, Text


class WorkerResources(Section):
    """What one worker takes of a node, with engine ray."""

    cpu: Count = Field(1, description="CPU cores that Ray sets aside for a worker; it uses one.")
    gpu: NotNegative = Field(
        0.0, description="GPUs of a worker, 1 or a fraction that it shares; 0 runs episodes on the CPU."
    )


class ComputeConfig(Section):
    """How the work is cut and where it runs. Only `rollout` and the three `*_pairs` are constants of the run."""

    engine: Literal["ray", "inline"] = Field(
        "ray",
        description="What runs the workers. ray: actors, here or in a cluster. inline: this program's child processes.",
    )
    inline_workers: Literal["processes", "threads"] = Field(
        "processes",
        description="With engine inline, what workers are: processes; or threads of one, for rollout simd, which takes "
        "less memory, and loses all of them with one.",
    )
    address: Text | None = Field(
        None,
        description="With engine ray: a cluster to join, HOST:PORT, or auto for the one on this machine; null starts a "
        "Ray of its own.",
    )
    workers: Literal["auto"] | Count = Field(
        "auto",
        description="Worker processes. auto: one per core of the machine or cluster at hand. Never changes results.",
    )
    worker_resources: WorkerResources = Field(
        default_factory=lambda: WorkerResources(cpu=1, gpu=0.0),
        description="What one worker takes of a node, with engine ray.",
    )
    rollout: Literal["xla", "simd"] = Field(
        description="What computes episodes. simd: code compiled for this kind of processor, some twenty times faster; "
        "xla: JAX, for GPUs and for tasks that simd cannot compile. auto: simd where that can be."
    )
    chunk_pairs: Count = Field(
        description="Pairs in one unit of work; divides search.pairs. auto: the largest divisor of it not above "
        "an eighth of it, within 16 to 64, a multiple of 8 if there is one."
    )
    rollout_block_pairs: Count = Field(
        description="Pairs that step together, so that their weights stay in cache; divides chunk_pairs. auto: the "
        "largest divisor of it not above 32 whose weights take at most 5 MiB."
    )
    gradient_block_pairs: Count = Field(
        description="Pairs summed into one partial gradient; not above search.pairs. auto: as few whole chunks as "
        "make at most 32 blocks, and blocks that are worth a message."
    )
    chunk_timeout_s: Positive = Field(
        30.0, description="Least deadline of a chunk in seconds; slow chunks raise it for those that follow."
    )
    compile_timeout_s: Positive = Field(
        120.0,
        description="Deadline of a worker's first chunk of each kind, which compiles; or what later ones may take, if "
        "that is longer.",
    )
    max_attempts: Count = Field(4, description="Times a chunk is tried before the run stops with its error.")
    no_worker_timeout_s: Positive = Field(
        120.0,
        description="Seconds without any live worker after which the run stops, in a cluster that has no room yet as "
        "well; a worker that takes half as long to start is replaced.",
    )
    dispatch_log: Switch = Field(
        False, description="Whether the run folder gets a dispatch.jsonl: what each worker was sent, answered, died of."
    )


COMPUTE_CONSTANTS = ("rollout", "chunk_pairs", "rollout_block_pairs", "gradient_block_pairs")
"""Keys of `compute` that fix floating-point results, and therefore the run."""
ENGINE_IMPLIES: dict[str, dict[str, Any]] = {
    "inline": {"compute.address": None, "compute.worker_resources.cpu": 1, "compute.worker_resources.gpu": 0},
    "ray": {"compute.inline_workers": "processes"},
}
"""Engine -> settings that belong to the other one, as it needs them."""
