"""How many workers a run starts, by what this machine has, and how the runs of a sweep share its cores."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from es_service.config.changes import again_with
from es_service.config.model import ENGINE_IMPLIES, RunConfig, implied_by
from es_service.config.parts import RESOURCES
from es_service.config.tasks import CALLER
from es_service.config.workload import chunks_at_once
from es_service.dispatch.ray_cluster import nodes_of_cluster
from es_service.dispatch.ray_nodes import actor_cores, with_work
from es_service.errors import ConfigError, WayOut, counted
from es_service.protocol.machine import cores, places

GPU = f"{RESOURCES}gpu"


def worker_count(config: RunConfig, most: int | None = None) -> int:
    """Number of workers, as configured or one per core that this process may use, or one for each place at its GPUs:
    for the engine inline as far as there is work for them, which the engine ray sees to itself, since it depends on the
    cores of each actor.

    Args:
        most: number of workers for which there is work; None: as in a generation of a run.

    Raises ConfigError as `require_cores`.
    """
    require_cores(config)
    compute = config.compute
    at_gpus = compute.worker_resources.gpu > 0 and compute.engine == "inline"
    auto = _gpu_places(config) if at_gpus else cores()
    workers = auto if compute.workers == "auto" else compute.workers
    if compute.engine == "ray":
        return workers
    return min(workers, max(1, work_at_once(config) if most is None else most))


def work_at_once(config: RunConfig) -> int:
    """Number of workers for which a generation of a run has work. A search of the user's own may ask for any number of
    policies, so as many as are configured have work."""
    workers = config.compute.workers
    return workers if ":" in config.search.algorithm and workers != "auto" else chunks_at_once(config)


def require_cores(config: RunConfig, again: WayOut | None = None) -> None:
    """Raise ConfigError if all workers are on this machine and are more than its cores can be meant to run, or than its
    GPUs have room for. Nothing is refused if no worker starts, because the caller computes the episodes.

    Args:
        again: the call that asks for the workers, which ways out repeat with other settings.
    """
    compute, count = config.compute, cores()
    if config.task.environment == CALLER:
        return
    if compute.engine == "inline" and compute.worker_resources.gpu:
        _require_gpus(config)
    if compute.workers == "auto" or compute.address is not None:
        return
    allowed = compute.max_workers_per_core * count
    if compute.workers <= allowed:
        return
    here = f"this machine, which has {counted(count, 'core')} for them"
    cluster = implied_by(None, "HOST:PORT") | {"compute.address": "HOST:PORT", "compute.workers": compute.workers}
    ways_out = (
        []
        if again is None
        else [
            again_with(again, "start one worker for each core", {"compute.workers": "auto"}),
            again_with(again, "use the cores of a Ray cluster", cluster),
        ]
    )
    raise ConfigError(
        f"compute.workers: {compute.workers} workers are too many for {here}; must be at most {allowed}, "
        f"{compute.max_workers_per_core} for each core (compute.max_workers_per_core). auto starts one for each core",
        field="compute.workers",
        value=compute.workers,
        allowed=f"at most {allowed}",
        suggestion="auto",
        ways_out=ways_out,
    )


def _gpu_places(config: RunConfig) -> int:
    """Number of workers for which this machine's GPUs have room."""
    return len(places(os.environ, config.compute.worker_resources.gpu))


def _require_gpus(config: RunConfig) -> None:
    room, asked = _gpu_places(config), config.compute.workers
    if not room:
        raise ConfigError(
            f"{GPU}: each worker is to have {config.compute.worker_resources.gpu:g}, but this machine has too few "
            "NVIDIA GPUs, or CUDA_VISIBLE_DEVICES hides them; 0 computes episodes on the CPU",
            field=GPU,
            value=config.compute.worker_resources.gpu,
            suggestion=0,
        )
    if asked != "auto" and asked > room:
        raise ConfigError(
            f"compute.workers: {asked} workers are too many for this machine, whose GPUs have room for {room}",
            field="compute.workers",
            value=asked,
            allowed=f"at most {room}",
            suggestion="auto",
        )


def on_this_machine(config: Mapping[str, Any], workers: int | None = None) -> dict[str, Any]:
    """Settings with which a run's episodes are computed on this machine, where others have perhaps computed them: on
    GPUs as the run's own if there is room for a worker, else on the CPU.

    Args:
        config: that of the run.
        workers: number of workers; None: as many as there are cores, or places at the GPUs.
    """
    gpus = config["compute"].get("worker_resources", {}).get("gpu", 0)
    here = gpus if gpus and places(os.environ, gpus) else 0
    return {"compute.engine": "inline", **ENGINE_IMPLIES["inline"], GPU: here, "compute.workers": workers or "auto"}


# How the runs of a sweep share the cores of a machine or a cluster: how many run at a time, with how many workers.


@dataclass(frozen=True)
class Shares:
    at_once: int
    """Number of runs at a time."""
    workers: tuple[int | Literal["auto"], ...]
    """`compute.workers` of each run."""


def shared(configs: Sequence[RunConfig], parallel: int | None = None) -> Shares:
    """Divide the cores of this machine, or of the cluster that the configs name, among runs.

    Args:
        parallel: number of runs at a time; None: as many as there are cores for, or one if they use GPUs.

    Raises:
        ConfigError: `parallel` is below 1, the cluster has no cores yet, or a run has too many workers for here.
        StartError: the cluster cannot be reached.
    """
    for config in configs:
        require_cores(config)
    if parallel is not None and parallel < 1:
        raise ConfigError(
            f"parallel: {parallel} is not allowed; must be a whole number, at least 1", field="parallel", value=parallel
        )
    nodes = [cores()]
    divided = len(configs) > 1 and parallel != 1 and any(config.compute.workers == "auto" for config in configs)
    if divided and (address := configs[0].compute.address) is not None:
        nodes = nodes_of_cluster(address)
        if not nodes:
            raise ConfigError(
                f"the cluster at {address} has no cores yet that runs could share; start its nodes first, or give the "
                "number of workers of each run",
                field="compute.workers",
                value="auto",
            )
    return divide(configs, parallel, nodes, drivers=cores())


def divide(configs: Sequence[RunConfig], parallel: int | None, nodes: Sequence[int], drivers: int) -> Shares:
    """Divide the cores of nodes among runs.

    Args:
        parallel: as for `shared`.
        nodes: cores of each node.
        drivers: cores of this machine, on which the driver of each run needs one.
    """
    if parallel is None:
        fixed = [config.compute.workers for config in configs if config.compute.workers != "auto"]
        on_gpus = any(config.compute.worker_resources.gpu for config in configs)
        parallel = 1 if on_gpus else max(1, min(drivers, sum(nodes) // max(fixed, default=1)))
    at_once = min(parallel, len(configs))
    return Shares(at_once, tuple(_workers(config, at_once, nodes) for config in configs))


def _workers(config: RunConfig, at_once: int, nodes: Sequence[int]) -> int | Literal["auto"]:
    compute = config.compute
    if compute.workers != "auto" or at_once == 1 or compute.worker_resources.gpu:
        return compute.workers
    each, cpus = share(nodes, at_once), compute.worker_resources.cpu
    if cpus == "auto":
        cpus = 1 if compute.address is None else actor_cores(nodes, each, None)
    return max(1, with_work(each, cpus, chunks_at_once(config))) * cpus


def share(nodes: Sequence[int], at_once: int) -> int:
    """Cores of each of several runs. On several equal nodes it is whole nodes, or such a part of a node that no run is
    left without room because each node has a few free cores: `actor_cores` makes actors of this size."""
    cores_each = max(1, sum(nodes) // at_once)
    if len(nodes) == 1 or len(set(nodes)) > 1:
        return cores_each
    if cores_each >= nodes[0]:
        return cores_each // nodes[0] * nodes[0]
    return max(part for part in range(1, cores_each + 1) if nodes[0] % part == 0)
