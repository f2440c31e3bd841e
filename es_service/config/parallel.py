"""How many chunks a generation has at a time, and so how many workers it can keep busy."""

from __future__ import annotations

from es_service.config.model import RunConfig
from es_service.protocol.messages import EVALUATION_EPISODES_PER_CHUNK
from es_service.protocol.policies import chunks_of

WITH_EMITTERS = ("me_es", "memes")
"""Methods with a population for each of `search.emitters`."""


def populations(config: RunConfig) -> int:
    """Number of populations that a generation asks for; for a search of your own, the most it can ask for.

    map_elites has none, because it asks for policies.
    """
    search = config.search
    if search.algorithm == "map_elites":
        return 0
    several = search.algorithm in WITH_EMITTERS or search.update == "all" or ":" in search.algorithm
    return search.centres if several else 1


def chunks_at_once(config: RunConfig) -> int:
    """Number of chunks that can be computed at the same time, in the larger of rollout and evaluation.

    More workers than that have nothing to do.
    """
    search = config.search
    if search.algorithm == "map_elites":
        return chunks_of(search.batch, search.evaluation_episodes)
    evaluation = -(-search.evaluation_episodes // EVALUATION_EPISODES_PER_CHUNK)
    return populations(config) * max(search.pairs // config.compute.chunk_pairs, evaluation)


def parallel_sentence(config: RunConfig) -> str:
    """How much work there is at a time, and the two keys that change it."""
    chunks, several = chunks_at_once(config), populations(config)
    work = f"{config.search.pairs} pairs around {'one centre' if several == 1 else f'{several} centres'}"
    if not several:
        work = f"{config.search.batch} policies"
    return (
        f"a generation has {chunks} chunks of work at a time ({work}), enough for {chunks} workers; "
        f"{' and '.join(_keys(config))} change that"
    )


def _keys(config: RunConfig) -> tuple[str, str]:
    algorithm = config.search.algorithm
    if algorithm == "map_elites":
        return "search.batch", "search.evaluation_episodes"
    if algorithm in WITH_EMITTERS:
        return "search.pairs", "search.emitters"
    if algorithm in ("es", "ars") or ":" in algorithm:
        return "search.pairs", "compute.chunk_pairs"
    return "search.pairs", "search.centres" if config.search.update == "all" else "search.update"
