"""Table of the keys on which the presets differ. The config loader reads it, and configs/README.md shows it.

A preset fills in what a config leaves out. A key written in the config wins, and the run's own `config.yaml` records
every value, so a later change of this table changes no existing run.

Sources named below: ES-starter is OpenAI's evolution-strategies-starter (Salimans et al. 2017, arXiv:1703.03864); DNE
is Uber's deep-neuroevolution (Conti et al. 2018, arXiv:1712.06560); ME-ES is Uber's Map-Elites-Evolutionary (Colas et
al. 2020, arXiv:2003.01825); MEMES is adaptive-intelligent-robotics/MEMES (Flageat et al. 2024, arXiv:2303.06137). All
values are from their code, not from the papers.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

PRESETS = MappingProxyType(
    {
        "literature": "values of independent implementations; our own choice where they specify none",
        "uber": "values of the authors' released ME-ES code",
    }
)
"""Preset name -> its meaning. Each name is also a column of the table."""


@dataclass(frozen=True)
class PresetRow:
    """One config key on which the presets differ."""

    key: str
    """Dotted name in the config, such as `search.pairs`."""
    literature: object
    uber: object
    source: str
    """Where both values come from, and what is our own choice."""
    method: str | None = None
    """The only `search.algorithm` that the row is for, before a row for all of them; None: the row is for all."""


_ROWS = (
    PresetRow(
        "search.pairs",
        512,
        5000,
        "uber: ME-ES, 10,000 episodes per generation in + and - pairs. literature: our choice, sized for one machine; "
        "the papers used 5,000 to 10,000 episodes per generation, so compare results at equal environment steps.",
    ),
    PresetRow(
        "policy.init",
        "unit_columns",
        "small_columns",
        "literature: ES-starter and DNE (column norm 1.0 in hidden layers, 0.01 in the output layer). uber: ME-ES "
        "(0.01 in every layer).",
    ),
    PresetRow(
        "policy.observation_clip",
        5.0,
        None,
        "literature: ES-starter and DNE clip normalised observations to [-5, 5]; where normalisation is off this is "
        "null. uber: ME-ES does not clip.",
    ),
    PresetRow(
        "search.common_random_numbers",
        True,
        False,
        "uber: ME-ES, where the two members of a pair start from different resets. literature: our choice; if a pair "
        "shares resets and action noise, the difference of its members contains less noise.",
    ),
    PresetRow(
        "search.fitness_weight_start",
        1.0,
        0.5,
        "NSRA-ES. uber: ME-ES. literature: independent implementations (estorch, MEMES), which follow the paper as far "
        "as we know.",
    ),
    PresetRow(
        "search.fitness_weight_patience",
        50,
        20,
        "NSRA-ES. uber: ME-ES. literature: the same implementations as for fitness_weight_start.",
    ),
    PresetRow(
        "search.fitness_weight_min_gain",
        0.0,
        0.1,
        "NSRA-ES. uber: ME-ES, where an improvement must beat the record by a tenth of its absolute value. literature: "
        "any gain counts.",
    ),
    PresetRow(
        "search.first_block",
        "explore",
        "exploit",
        "ME-ES. literature: QDax. uber: ME-ES, whose flag starts at explore and is flipped before its first use.",
    ),
    PresetRow(
        "search.cell_sampling",
        "top",
        "score",
        "ME-ES. literature: QDax, whose authors say they follow the paper. uber: ME-ES, by novelty and by the best "
        "single episode of a cell's population.",
    ),
    PresetRow(
        "novelty.distance",
        "euclidean",
        "squared_euclidean",
        "literature: DNE and QDax. uber: ME-ES, which averages squared distances.",
    ),
    PresetRow(
        "policy.observation_normalization",
        False,
        False,
        "literature: the code of MEMES, which does not normalise observations. uber: the same.",
        "memes",
    ),
    PresetRow(
        "policy.action_noise",
        0.0,
        0.0,
        "literature: the code of MEMES, whose settings have no noise of actions. uber: the same.",
        "memes",
    ),
    PresetRow(
        "search.emitters",
        16,
        16,
        "literature: an eighth of the 128 of the code of MEMES, sized for one machine. uber: the same.",
        "memes",
    ),
    PresetRow(
        "search.pairs",
        32,
        32,
        "literature: an eighth of the 512 members of the code of MEMES, sized for one machine. uber: the same.",
        "memes",
    ),
    PresetRow(
        "search.l2",
        0.0,
        0.0,
        "literature: the code of MEMES. uber: the same.",
        "memes",
    ),
    PresetRow(
        "search.evaluation_episodes",
        1,
        1,
        "literature: the code of MEMES, which evaluates a centre once. uber: the same.",
        "memes",
    ),
    PresetRow(
        "novelty.newest",
        50_000,
        50_000,
        "literature: the code of MEMES, whose novelty archive keeps no more. uber: the same.",
        "memes",
    ),
    PresetRow(
        "policy.observation_normalization",
        False,
        False,
        "literature: QDax, which gathers no statistics either. uber: the same, since nothing could gather them.",
        "map_elites",
    ),
    PresetRow(
        "search.evaluation_episodes",
        1,
        1,
        "literature: QDax, which evaluates a policy once. uber: the same.",
        "map_elites",
    ),
    PresetRow(
        "policy.action_noise",
        0.0,
        0.0,
        "literature: Mania et al. 2018, which adds no noise to actions. uber: the same.",
        "ars",
    ),
    PresetRow(
        "search.l2",
        0.0,
        0.0,
        "literature: Mania et al. 2018, which has no weight decay. uber: the same.",
        "ars",
    ),
)


def preset_table() -> list[PresetRow]:
    """Rows of all keys on which the presets differ, for documentation."""
    return list(_ROWS)


def preset_values(preset: str, method: object = None) -> dict[str, object]:
    """Values of one preset: dotted key -> value.

    Args:
        method: the algorithm, whose own rows replace those for all algorithms; None for the latter alone.

    Raises:
        KeyError: `preset` is not a key of PRESETS.
    """
    if preset not in PRESETS:
        raise KeyError(preset)
    for_all = {row.key: getattr(row, preset) for row in _ROWS if row.method is None}
    return for_all | {row.key: getattr(row, preset) for row in _ROWS if row.method == str(method)}
