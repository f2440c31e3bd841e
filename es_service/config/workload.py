"""What a resolved config asks of workers: their first message, how many chunks a generation has at a time, warnings."""

from __future__ import annotations

from es_service.config.model import RunConfig
from es_service.config.parts import RESOURCES
from es_service.config.resolution import WITHOUT_PAIRS, default_chunk_pairs, policy_spec_of
from es_service.config.rules import MOST_CHUNK_PAIRS
from es_service.config.search import PopulationConfig
from es_service.config.tasks import CALLER, ROLLOUTS
from es_service.errors import ConfigError, counted
from es_service.protocol.episodes import METRICS
from es_service.protocol.messages import EVALUATION_EPISODES_PER_CHUNK, PolicySpec, TaskSpec, WorkerSpec
from es_service.protocol.policies import chunks_of
from es_service.protocol.rollouts import Rollouts, why_not
from es_service.protocol.sources import worker_sources


def policy_spec(config: RunConfig, task: TaskSpec) -> PolicySpec:
    """The policy of a run, from the task's observation to its action."""
    values = {f"policy.{name}": value for name, value in config.policy}
    return policy_spec_of(values, task.observation_size, task.action_size, is_ranked=task.ranked_actions)


def require_episodes(task: TaskSpec, *, asks_caller: bool) -> None:
    """Raise ConfigError if a task has no episodes of its own, and the caller is not asked for them."""
    if task.kind == CALLER and not asks_caller:
        raise ConfigError(
            "the episodes of this run are those of the program that asks it, so the service can compute none; to "
            "continue it, that program calls es_service.ask_tell with the same config and folder",
            field="task.environment",
            value=CALLER,
        )


def worker_spec(
    config: RunConfig, task: TaskSpec, outputs: tuple[str, ...] = (), *, asks_caller: bool = False
) -> WorkerSpec:
    """The message that every worker of the run receives once, when it starts.

    Args:
        outputs: see `WorkerSpec.outputs`; those that the search reads are added, and the metrics of the task.
        asks_caller: whether the caller computes the episodes of a task that has none of its own.

    Raises ConfigError as `require_episodes`.
    """
    require_episodes(task, asks_caller=asks_caller)
    settings, policy, compute, search = config.task, config.policy, config.compute, config.search
    return WorkerSpec(
        seed=config.seed,
        environment=settings.environment,
        environment_options=dict(settings.options),
        choices=settings.choices,
        allow_infeasible=search.allow_infeasible,
        time_limit_s=settings.time_limit_s,
        descriptor_size=0 if settings.descriptor is None else len(task.descriptor_names),
        policy=policy_spec(config, task),
        episode_steps=settings.episode_steps,
        fitness=settings.fitness,
        episodes_per_member=settings.episodes_per_member,
        observation_clip=policy.observation_clip,
        action_noise=policy.action_noise,
        common_random_numbers=not isinstance(search, PopulationConfig) or search.common_random_numbers,
        chunk_pairs=compute.chunk_pairs,
        rollout_block_pairs=compute.rollout_block_pairs,
        gradient_block_pairs=compute.gradient_block_pairs,
        rollout=compute.rollout,
        noise_rank=search.noise.rank if isinstance(search, PopulationConfig) else 0,
        outputs=tuple(sorted({*outputs, *search.outputs(), *((METRICS,) if task.metric_names else ())})),
        parent_cache_bytes=compute.parent_cache_mb * 2**20,
        recycle_after_episodes=settings.recycle_after_episodes,
        memory_bytes=compute.worker_memory_mb and compute.worker_memory_mb * 2**20,
        output_bytes=compute.worker_output_bytes,
        sources=worker_sources(*settings.code),
        platform=compute.platform,
    )


FEW_CHUNK_PAIRS = 8
"""A chunk with fewer pairs is likely to cost more to send and start than to compute."""
ANY_NUMBER = 2**20
"""Chunks of work at a time where it is not known how many there will be: enough for every core."""


def chunks_of_phases(config: RunConfig) -> dict[str, int]:
    """Number of chunks of each phase of a generation, all of which can be computed at the same time."""
    search, sizes, several = config.search, config.compute, config.search.populations()
    rollout = ROLLOUTS.get(sizes.rollout)  # some send fewer episodes together than a chunk has
    together = None if rollout is None else rollout.episodes_together(config.made.task)
    if not isinstance(search, PopulationConfig):
        policies, episodes = search.policies(), search.evaluation_episodes
        return {"rollout": chunks_of(policies, episodes) if together is None else -(-policies * episodes // together)}
    return {
        "rollout": several * (search.pairs // sizes.chunk_pairs),
        "gradient": several * -(-search.pairs // sizes.gradient_block_pairs),
        "evaluation": several * -(-search.evaluation_episodes // (together or EVALUATION_EPISODES_PER_CHUNK)),
    }


def chunks_at_once(config: RunConfig) -> int:
    """Number of chunks of the largest phase of a generation.

    More workers than that have nothing to do, except perhaps while the initial centres are evaluated.
    """
    return max(chunks_of_phases(config).values())


def parallel_sentence(config: RunConfig) -> str:
    """How much work there is at a time, and the keys that change it."""
    search, chunks, several, keys = config.search, chunks_at_once(config), config.search.populations(), _keys(config)
    work = counted(search.policies(), "policy", "policies")
    if isinstance(search, PopulationConfig):
        size = counted(search.pairs, "pair")
        if keys[0] == "search.evaluation_episodes":
            size = counted(search.evaluation_episodes, "evaluation episode")
        work = f"{size} around {'one centre' if several == 1 else f'{several} centres'}"
    return (
        f"a generation has {counted(chunks, 'chunk')} of work at a time ({work}), enough for "
        f"{counted(chunks, 'worker')}; "
        f"{' and '.join(keys)} change{'s' if len(keys) == 1 else ''} that"
    )


def _keys(config: RunConfig) -> tuple[str, ...]:
    """The keys on which the number of chunks of the largest phase depends, the most useful first."""
    search, spread = config.search, config.search.spread_keys()
    if not isinstance(search, PopulationConfig):
        return *spread, "search.evaluation_episodes"
    phases = chunks_of_phases(config)
    largest = max(phases, key=phases.__getitem__)  # the first of equal ones
    size = "search.evaluation_episodes" if largest == "evaluation" else "search.pairs"
    if spread:
        return size, *spread
    return size, *{"rollout": ("compute.chunk_pairs",), "gradient": ("compute.gradient_block_pairs",)}.get(largest, ())


def config_warnings(config: RunConfig, task: TaskSpec, rollouts: Rollouts) -> list[str]:
    """Warnings about settings that are valid but probably not intended; the command line prints them before the run."""
    shape, here, names = policy_spec(config, task), config.compute.address is None, [*rollouts]
    faster = names[names.index(chosen := config.compute.rollout) + 1 :]
    warnings = [
        f"compute.rollout: {chosen} is used because {name} cannot run {task.name}: {why}"
        for name in faster
        if task.kind in rollouts[name].task_kinds and (why := why_not(rollouts[name], task, shape, here=here))
    ]
    search = config.search
    if config.compute.worker_resources.gpu and rollouts[chosen].gpus_only_train:
        only = f"{chosen} computes only training episodes there"
        if not isinstance(search, PopulationConfig):
            warnings.append(f"{RESOURCES}gpu: no GPU is used: {only}, and {search.algorithm} has none")
        elif search.noise.kind != "full":
            warnings.append(f"{RESOURCES}gpu: no GPU is used: {only}, and only those with search.noise.kind = full")
    pairs = search.pairs if isinstance(search, PopulationConfig) else WITHOUT_PAIRS
    chunk = config.compute.chunk_pairs
    if chunk < min(FEW_CHUNK_PAIRS, rollouts[chosen].pair_limits(task)[0]) and pairs > MOST_CHUNK_PAIRS:
        near = round(pairs / MOST_CHUNK_PAIRS) * MOST_CHUNK_PAIRS
        auto = default_chunk_pairs(pairs)
        hint = (
            f"auto would choose {auto}"
            if auto >= FEW_CHUNK_PAIRS
            else f"search.pairs = {near} would give chunks of {default_chunk_pairs(near)}"
        )
        what = f"{chunk} makes {pairs // chunk} small chunks per generation, which is slow"
        warnings.append(f"compute.chunk_pairs: {what}; {hint}")
    budget = config.budget
    ends = (budget.generations, budget.env_steps, budget.wall_clock_s, budget.rollout_s, budget.cpu_s)
    if all(limit is None for limit in ends):
        targets = {"target_fitness": budget.target_fitness, "target_certified": budget.target_certified}
        named = " or ".join(f"{key} ({target})" for key, target in targets.items() if target is not None)
        warnings.append(
            f"budget: this run ends only when it reaches {named}, which may never happen; consider setting "
            "budget.generations as well"
        )
    return warnings
