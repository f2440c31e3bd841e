"""The config section `search`: the method and its settings."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from es_service.config.fields import Count, Fraction, NotNegative, Options, Positive, Section, Switch, Text


class SearchConfig(Section):
    """The evolution strategy. Constants of the run."""

    algorithm: Text = Field(
        description="Name of the search algorithm: a shipped one, or module:function for one of your own."
    )
    preset: Literal["literature", "uber"] = Field(
        "literature", description="Which column of the preset table fills in the keys that the config leaves out."
    )
    pairs: Count = Field(
        description="Antithetic pairs of a population, which has twice as many members. A generation has one "
        "population, or one for each centre with search.emitters and search.update: all. Set by the preset."
    )
    sigma: Positive = Field(0.02, description="Standard deviation of the parameter noise, in parameter units.")
    learning_rate: Positive = Field(
        0.01, description="Step size of Adam, in parameter units. ars: factor of the plain step."
    )
    l2: NotNegative = Field(
        0.005, description="Weight decay, added to the gradient before Adam: lambda in -g + lambda x."
    )
    shaping: Literal["ranks", "signs", "returns"] = Field(
        "ranks",
        description="How fitness, and novelty, become utilities of members. ranks: evenly spaced by rank. signs: of "
        "each pair, only which member is better. returns: the values, less their mean, over their standard deviation.",
    )
    centres: Count = Field(
        description="Number of centres searched side by side, each with its own optimiser. auto: 1 for es "
        "and ars, search.emitters for me_es and memes (these allow no other number), 32 for map_elites, whose first "
        "random policies they are, 1 for a search of your own; else 5."
    )
    update: Literal["one", "all"] = Field(
        "one",
        description="ns_es, nsr_es, nsra_es: how many of the centres a generation updates. one: that of "
        "search.centre_choice. all: every centre, with search.pairs pairs each.",
    )
    centre_choice: Literal["novelty", "round_robin", "uniform"] = Field(
        "novelty",
        description="ns_es, nsr_es, nsra_es: how the centre to update is chosen. novelty: with probability "
        "proportional to its novelty. round_robin: in turn. uniform: all with the same probability.",
    )
    top_pairs: Count | None = Field(
        None,
        description="ars: number of pairs from which a step is computed, those with the highest fitness of their "
        "better member; null: all pairs.",
    )
    emitters: Count = Field(
        1,
        description="me_es: number of blocks that run side by side, with search.pairs pairs each in every generation. "
        "memes: number of evolution strategies, likewise; 16 if left out.",
    )
    fitness_weight_start: Fraction = Field(
        description="nsra_es: weight of fitness beside novelty at the start. Set by the preset."
    )
    fitness_weight_step: Fraction = Field(
        0.05, description="nsra_es: how much the weight of fitness rises after an improvement or falls in stagnation."
    )
    fitness_weight_patience: Count = Field(
        description="nsra_es: generations without improvement before the weight of fitness falls. Set by the preset."
    )
    fitness_weight_min_gain: NotNegative = Field(
        description="nsra_es: a centre is an improvement if its fitness exceeds the record by more than this fraction "
        "of the record's absolute value. Set by the preset."
    )
    mode: Literal["explore_exploit", "explore", "exploit"] = Field(
        "explore_exploit",
        description="me_es: what a block of generations maximises. explore: novelty. exploit: fitness. "
        "explore_exploit: one of the two, as search.alternation says. memes: what an emitter maximises; "
        "explore_exploit: novelty and fitness by turns, beginning with novelty for the first emitter.",
    )
    alternation: Literal["round_robin", "coin"] = Field(
        "round_robin",
        description="me_es: how exploring and exploiting blocks follow each other. round_robin: in turn. coin: each "
        "block is chosen at random, with probability 1/2.",
    )
    first_block: Literal["explore", "exploit"] = Field(
        description="me_es: what the first block does with alternation round_robin. Set by the preset."
    )
    block_generations: Count = Field(
        10,
        description="me_es: generations in a block; each block starts from an elite drawn from the map, with a fresh "
        "optimiser.",
    )
    cell_sampling: Literal["top", "score"] = Field(
        description="me_es: how the cell of that elite is drawn: as in QDax (top) or as in the released code (score); "
        "es_service/search/algorithms/me_es.py describes both. Set by the preset."
    )
    stagnation_generations: Count = Field(
        32,
        description="memes: generations after which an emitter none of whose centres has entered the map since then "
        "begins again from an elite, with a fresh optimiser.",
    )
    parent_statistics: Literal["global", "elite"] = Field(
        "global",
        description="me_es, memes: observation statistics that a block uses. global: those of the whole run. elite: "
        "those with which the elite at its start was evaluated. With elite, all elites descend from the first centre "
        "and keep its statistics, so observations are not normalised unless the run started from a policy of another "
        "run.",
    )
    batch: Count = Field(256, description="map_elites: number of policies that a generation makes and evaluates.")
    iso_sigma: NotNegative = Field(
        0.005, description="map_elites: standard deviation of the noise in each parameter, in parameter units."
    )
    line_sigma: NotNegative = Field(
        0.05,
        description="map_elites: standard deviation of the step along the line through both parents, as a share of the "
        "distance between them.",
    )
    evaluation_episodes: Count = Field(
        30,
        description="Noise-free episodes on which each new centre is evaluated; they count as environment steps. "
        "memes, and map_elites for each policy: 1 if left out.",
    )
    common_random_numbers: Switch = Field(
        description="Whether the two members of a pair share resets and action noise. Set by the preset."
    )
    max_invalid_fraction: Fraction = Field(
        0.5, description="Share of members with a non-finite fitness or descriptor above which the run stops."
    )
    init_from: Text | None = Field(
        None,
        description="Policy of another run from which this run starts: RUN (its folder) for the centre updated last, "
        "RUN:best for the best centre, or RUN:3,17 for a cell's elite; null for random weights.",
    )
    options: Options = Field(
        default_factory=dict,
        description="Settings of a search of your own, which declares them; the shipped methods have none.",
    )
