"""How the runs of a sweep share the cores of a machine or a cluster: how many run at a time, with how many workers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from es_service.config.model import RunConfig
from es_service.config.workload import chunks_at_once
from es_service.dispatch.cores import cores
from es_service.dispatch.ray_cluster import nodes_of_cluster
from es_service.dispatch.ray_nodes import actor_cores, with_work
from es_service.errors import ConfigError
from es_service.runs.worker_count import require_cores


@dataclass(frozen=True)
class Shares:
    """The division of the cores."""

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
