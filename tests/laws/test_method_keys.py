"""The table of keys that only some methods use, against what runs do: each key is changed with each method."""

from __future__ import annotations

import hashlib
import importlib
import sys
from functools import cache, reduce
from pathlib import Path

import pytest

from es_service.config.keys import has_effect as is_declared
from es_service.config.tasks import TASKS
from es_service.config.workload import policy_spec, worker_spec
from es_service.loop import driver
from es_service.loop.history import history_columns
from es_service.loop.state import no_observations
from es_service.protocol.content import name_of
from es_service.search import algorithms
from es_service.search.algorithms import ALGORITHMS, OURS
from tests.es_service.config_examples import load_config
from tests.helpers import DirectEvaluator
from tests.laws.me_es_runs import Remembering
from workers.environments import SHIPPED
from workers.policy import initial_parameters
from workers.rollouts import BACKENDS

TASK = SHIPPED["point_maze"]
KNOWN = {"tasks": TASKS, "algorithms": ALGORITHMS, "rollouts": BACKENDS}
COMMON = {
    "task.environment": "point_maze",
    "task.episode_steps": 20,
    "policy.hidden": [8, 8],
    "search.evaluation_episodes": 3,
    "novelty.neighbours": 3,
    "map.cells": [9, 8],
    "map.correct_every": 3,
    "map.correct_episodes": 2,
    "budget.generations": 5,
}
WITH_POPULATIONS = {
    "search.pairs": 32,
    "search.sigma": 0.2,
    "search.sigma_decay": 0.9,
    "search.step.learning_rate": 0.2,
    "search.learning_rate_decay": 0.9,
    "policy.observation_normalization": True,
    "policy.action_noise": 0.01,
    "compute.chunk_pairs": 16,
    "compute.gradient_block_pairs": 16,
}
BASES = {
    "ns_es": [{}, {"search.update": "all"}],
    "nsra_es": [{"search.update": update, "search.fitness_weight_patience": 2} for update in ("one", "all")],
    "me_es": [{"search.block_generations": 2, "search.emitters": 2}],
    "memes": [{"search.emitters": 2, "search.stagnation_generations": 2, "budget.generations": 12}],
    "polish": [{"search.init_from": ".", "search.screened": 4, "search.candidates": 3, "search.round_generations": 2}],
    "jedi": [{"search.emitters": 2, "search.target_generations": 2}],
    "map_elites": [{"search.batch": 16, "search.centres": 8, "search.iso_sigma": 0.2}],
}
"""Method -> settings of runs, besides those of all; a key has an effect if it changes one of these runs."""
OTHER = {
    "task.episode_steps": 15,
    "task.fitness": "final",
    "task.episodes_per_member": 2,
    "task.options.start": "corner",
    "policy.hidden": [6],
    "policy.activation": "relu",
    "policy.output": "linear",
    "policy.bias": False,
    "policy.init": "small_columns",
    "policy.observation_normalization": False,
    "policy.observation_clip": 0.3,
    "policy.action_noise": 0.2,
    "search.pairs": 64,
    "search.sigma": 0.3,
    "search.sigma_decay": 0.8,
    "search.sigma_limit": 0.19,
    "search.noise.kind": "low_rank",
    "search.step.learning_rate": 0.3,
    "search.step.l2": 0.1,
    "search.step.kind": "plain",
    "search.step_gate": True,
    "search.learning_rate_decay": 0.8,
    "search.learning_rate_limit": 0.19,
    "search.shaping.kind": "signs",
    "search.centres": 4,
    "search.update": "all",
    "search.centre_choice": "round_robin",
    "search.shaping.count": 4,
    "search.emitters": 3,
    "search.fitness_weight_start": 0.25,
    "search.fitness_weight_step": 0.25,
    "search.fitness_weight_patience": 1,
    "search.fitness_weight_min_gain": 9.0,
    "search.mode": "exploit",
    "search.objectives": [{"kind": "mixture", "weight": 0.3}],
    "search.starts": "fitness",
    "search.exploit_generations": 1,
    "search.objective.kind": "novelty",
    "search.screened": 3,
    "search.candidates": 2,
    "search.round_generations": 1,
    "search.target_generations": 3,
    "search.target_weight_start": 0.5,
    "search.target_weight": 0.9,
    "search.model_noise": 5.0,
    "search.alternation": "coin",
    "search.first_block": "exploit",
    "search.block_generations": 3,
    "search.cell_sampling": "score",
    "search.stagnation_generations": 1,
    "search.parent_statistics": "elite",
    "search.batch": 32,
    "search.elites.kind": "archive_sampling",
    "search.iso_sigma": 0.3,
    "search.line_sigma": 0.3,
    "search.evaluation_episodes": 4,
    "search.common_random_numbers": False,
    "novelty.neighbours": 2,
    "novelty.distance": "squared_euclidean",
    "novelty.newest": 2,
    "map.enabled": False,
    "map.kind": "cvt",
    "map.bounds": [[-2, 1], [-1, 1]],
    "map.cells": [7, 7],
    "map.qd_offset": -3.0,
    "map.correct_every": 2,
    "map.correct_episodes": 3,
    "compute.chunk_pairs": 32,
    "compute.gradient_block_pairs": 32,
    "seed": 1,
}
"""Key -> a value that none of the runs has."""
NOT_MEASURED = {
    "task.environment": "the runs are in PointMaze",
    "search.algorithm": "the table is about it",
    "search.preset": "chooses values of other keys",
    "search.init_from": "names a folder, of which the functions of a search know nothing",
    "search.candidate_choice": "chooses among the elites of that folder, which `test_polish.py` checks",
    "map.centroids": "is for maps of the kind cvt; `test_geometry.py` has it",
    **dict.fromkeys(("map.slots", "map.neighbours"), "is for dominated maps; `test_dominated_maps.py` has them"),
    "search.allow_infeasible": "is about results of -inf, which `test_policies.py` has",
    "search.max_invalid_fraction": "stops a run, which `test_es.py` and `test_policies.py` check",
    "task.descriptor": "is for tasks of Python objects; `test_gymnasium.py` has it",
    "task.success": "is for tasks of Python objects; `test_gymnasium.py` has it",
    "task.metrics": "is for tasks of Python objects; `test_metrics.py` has it",
    "task.new_object_each_episode": "is for tasks of Python objects; `test_host.py` has it",
    "task.time_limit_s": "is for tasks of Python objects and functions; `test_host.py` and `test_functions.py` have it",
    "policy.memory": "needs XLA; `test_policy_kinds.py` has it",
    "compute.rollout": "the other one is XLA",
    "compute.rollout_block_pairs": "only XLA uses it",
}
ONE_VALUE = {
    "search.centres": ("es", "ars", "me_es", "memes", "polish", "jedi"),
    "policy.observation_normalization": ("map_elites",),
    "map.enabled": ("me_es", "memes", "map_elites", "jedi"),
    "search.shaping.count": tuple(
        name for name in OURS if name not in ("ars", "polish")
    ),  # others have another kind by default
    "search.step.kind": ("ars", "polish"),  # it is plain by default
}
"""Key -> methods that allow only one value of it, so that no other can be measured."""


def base_settings(method):
    populations = {} if method == "map_elites" else WITH_POPULATIONS
    return [COMMON | populations | {"search.algorithm": method} | more for more in BASES.get(method, [{}])]


def changed_settings(settings, key):
    """Settings with another value of a key, and of what must fit it."""
    fits = {"map.cells": [12]} if key == "map.kind" else {}
    return {**settings, **fits, key: OTHER[key]}


def load(settings):
    mapping: dict = {"task": {"options": {}}}
    for key, value in settings.items():
        *path, leaf = key.split(".")
        reduce(lambda group, name: group.setdefault(name, {}), path, mapping)[leaf] = value
    return load_config(mapping, **KNOWN)


EVALUATORS: dict[str, DirectEvaluator] = {}
"""Evaluators by what their workers know, so that equal workers are compiled once."""


def evaluator(config):
    spec = worker_spec(config, TASK)
    if repr(spec) not in EVALUATORS:
        EVALUATORS[repr(spec)] = DirectEvaluator(spec)
    EVALUATORS[repr(spec)].recorded.clear()
    return EVALUATORS[repr(spec)]


def digest(config):
    """SHA-256 of all that the digest of a run is made of, after each of its generations."""
    shape, store = policy_spec(config, TASK), Remembering()
    first = [initial_parameters(shape, config.policy.init, config.seed, i) for i in range(config.search.centres)]
    algorithm = ALGORITHMS[config.search.algorithm](config)
    search = driver.Search(config, algorithm, lambda: (first, no_observations(2)), TASK)
    driver.drive(driver.run(search, store, None, lambda row: None), evaluator(config))
    total = hashlib.sha256()
    for parts in store.after:
        for name in sorted(parts):
            total.update(f"{name} {name_of(parts[name]).hex()}\n".encode())
    columns = [one.name for one in history_columns(TASK, config.map.enabled, True) if one.deterministic]
    for row, evaluated in zip(store.rows, store.evaluated, strict=True):
        total.update(repr([row.get(column) for column in columns]).encode())
        total.update(repr([sorted(one.items()) for one in evaluated]).encode())
    return total.hexdigest()


@cache
def base_digest(method, which):
    return digest(load(base_settings(method)[which]))


def has_effect(method, key, make):
    """Whether another value of a key changes one of a method's runs."""
    settings = base_settings(method)
    return any(
        digest(make(one, changed_settings(one, key))) != base_digest(method, which)
        for which, one in enumerate(settings)
        if one.get(key) != OTHER[key]
    )


def as_given(settings, changed):
    """The config of a new run with a value that its user gave."""
    return load(changed)


def as_it_cannot_be(settings, changed):
    """A config with another value of a key without effect, which no user can give."""
    config = load(settings)
    for key in changed.keys() - settings.keys():
        section, leaf = key.split(".")
        config = config.model_copy(update={section: getattr(config, section).model_copy(update={leaf: changed[key]})})
    return config


def test_every_constant_is_measured_or_there_is_a_reason():
    known = {key for method in OURS for key in load(base_settings(method)[0]).constants()}
    assert known == OTHER.keys() | NOT_MEASURED.keys(), "give a key another value in OTHER, or a reason in NOT_MEASURED"


AT_ONCE = ("es", "me_es", "map_elites")
"""Methods whose keys are tried in `make test`, with and without populations, centres or a map; the others are long."""


@pytest.mark.parametrize(
    "method", [pytest.param(one, marks=pytest.mark.slow if one in AT_ONCE else pytest.mark.long) for one in OURS]
)
def test_the_table_says_which_keys_have_an_effect(method):
    settings = OURS[method].settings
    declared = {key: is_declared(key, settings) for key in OTHER if method not in ONE_VALUE.get(key, ())}
    measured = {key: is_used for key, is_used in declared.items() if is_used or not key.startswith("search.")}
    found = {key: has_effect(method, key, as_given if measured[key] else as_it_cannot_be) for key in measured}
    assert found == measured


def test_a_shipped_method_is_one_file_that_nothing_else_names(tmp_path, monkeypatch):
    text = Path(importlib.import_module("es_service.search.algorithms.es").__file__).read_text()
    (tmp_path / "hill.py").write_text(text.replace("EsSettings", "HillSettings").replace("def es(", "def hill("))
    monkeypatch.setattr(algorithms, "__path__", [*algorithms.__path__, str(tmp_path)])
    monkeypatch.delitem(sys.modules, "es_service.search.algorithms.hill", raising=False)
    found = {one.name: one for one in algorithms._shipped()}
    assert found.keys() == {*OURS, "hill"}
    mapping = {"task": {"environment": "point_maze"}, "search": {"algorithm": "hill"}, "budget": {"generations": 1}}
    assert load_config(mapping, **KNOWN | {"algorithms": found}).search.algorithm == "hill"
