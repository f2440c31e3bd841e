"""How many chunks a generation has at a time, and so how many workers it can keep busy."""

from __future__ import annotations

from es_service.config.model import RunConfig
from es_service.config.search import PopulationConfig
from es_service.config.tasks import ROLLOUTS
from es_service.errors import counted
from es_service.protocol.messages import EVALUATION_EPISODES_PER_CHUNK
from es_service.protocol.policies import chunks_of

ANY_NUMBER = 2**20
"""Chunks of work at a time where it is not known how many there will be: enough for every core."""


def chunks_of_phases(config: RunConfig) -> dict[str, int]:
    """Number of chunks of each phase of a generation, all of which can be computed at the same time."""
    search, sizes, several = config.search, config.compute, config.search.populations()
    together = _episodes_together(config)
    if not isinstance(search, PopulationConfig):
        policies, episodes = search.policies(), search.evaluation_episodes
        return {"rollout": chunks_of(policies, episodes) if together is None else -(-policies * episodes // together)}
    return {
        "rollout": several * (search.pairs // sizes.chunk_pairs),
        "gradient": several * -(-search.pairs // sizes.gradient_block_pairs),
        "evaluation": several * -(-search.evaluation_episodes // (together or EVALUATION_EPISODES_PER_CHUNK)),
    }


def _episodes_together(config: RunConfig) -> int | None:
    """Most episodes that are sent to a worker together; None: those of whole chunks."""
    task, rollout = config.resolved_with, ROLLOUTS.get(config.compute.rollout)
    return None if task is None or rollout is None else rollout.episodes_together(task)


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
