"""How many chunks a generation has at a time, and so how many workers it can keep busy."""

from __future__ import annotations

from es_service.config.model import RunConfig
from es_service.protocol.messages import EVALUATION_EPISODES_PER_CHUNK
from es_service.protocol.policies import chunks_of

WITH_EMITTERS = ("me_es", "memes")
"""Methods with a population for each of `search.emitters`."""
ANY_NUMBER = 2**20
"""Chunks of work at a time where it is not known how many there will be: enough for every core."""


def populations(config: RunConfig) -> int:
    """Number of populations that a generation asks for; for a search of your own, the most it can ask for.

    map_elites has none, because it asks for policies.
    """
    search = config.search
    if search.algorithm == "map_elites":
        return 0
    several = search.algorithm in WITH_EMITTERS or search.update == "all" or ":" in search.algorithm
    return search.centres if several else 1


def chunks_of_phases(config: RunConfig) -> dict[str, int]:
    """Number of chunks of each phase of a generation, all of which can be computed at the same time."""
    search, sizes, several = config.search, config.compute, populations(config)
    if not several:
        return {"rollout": chunks_of(search.batch, search.evaluation_episodes)}
    return {
        "rollout": several * (search.pairs // sizes.chunk_pairs),
        "gradient": several * -(-search.pairs // sizes.gradient_block_pairs),
        "evaluation": several * -(-search.evaluation_episodes // EVALUATION_EPISODES_PER_CHUNK),
    }


def chunks_at_once(config: RunConfig) -> int:
    """Number of chunks of the largest phase of a generation.

    More workers than that have nothing to do, except perhaps while the initial centres are evaluated.
    """
    return max(chunks_of_phases(config).values())


def parallel_sentence(config: RunConfig) -> str:
    """How much work there is at a time, and the keys that change it."""
    chunks, several, keys = chunks_at_once(config), populations(config), _keys(config)
    count, unit = config.search.pairs, "pairs"
    if keys[0] == "search.evaluation_episodes":
        count, unit = config.search.evaluation_episodes, "evaluation episodes"
    work = f"{count} {unit} around {'one centre' if several == 1 else f'{several} centres'}"
    if not several:
        work = f"{config.search.batch} policies"
    return (
        f"a generation has {chunks} chunks of work at a time ({work}), enough for {chunks} workers; "
        f"{' and '.join(keys)} change{'s' if len(keys) == 1 else ''} that"
    )


def _keys(config: RunConfig) -> tuple[str, ...]:
    """The keys on which the number of chunks of the largest phase depends, the most useful first."""
    algorithm = config.search.algorithm
    if algorithm == "map_elites":
        return "search.batch", "search.evaluation_episodes"
    phases = chunks_of_phases(config)
    largest = max(phases, key=phases.__getitem__)  # the first of equal ones
    size = {"rollout": "search.pairs", "gradient": "search.pairs", "evaluation": "search.evaluation_episodes"}[largest]
    if algorithm in WITH_EMITTERS:
        return size, "search.emitters"
    if largest == "gradient":
        return size, "compute.gradient_block_pairs"
    if algorithm in ("es", "ars") or ":" in algorithm:
        return (size, "compute.chunk_pairs") if largest == "rollout" else (size,)
    return size, "search.centres" if config.search.update == "all" else "search.update"
