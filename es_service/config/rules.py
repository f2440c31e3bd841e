"""Rules across keys and sections: one list, each of them a function `(config, task) -> problems`.

What one value must be by itself stands in the type of its field (`parts.py`). A rule reads whatever values it needs: if
one of them is invalid or not known, which is reported elsewhere, the rule ends there without a word. To add one, write
a generator that yields a `Problem` for each thing that is wrong, and put it into `RULES`.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from es_service.config.given import start_of
from es_service.config.keys import BUDGET, FIELDS
from es_service.config.map_rules import MAP_RULES, cells_fit
from es_service.config.parts import RESOURCES, TASK_OPTIONS
from es_service.config.resolution import Unknown, Values, only_centres
from es_service.config.search import SearchConfig
from es_service.config.tasks import CALLER, is_start
from es_service.config.text import not_allowed, one_of, problem_of, show, wrong_value
from es_service.errors import Problem
from es_service.protocol.episodes import AT_THE_END, METRICS
from es_service.protocol.messages import TaskSpec
from es_service.protocol.policy_spec import DISCRETE_OUTPUTS, NOISY_OUTPUTS
from es_service.protocol.rollouts import CHUNK_PAIRS

Rule = Callable[[Values, TaskSpec], Iterable[Problem]]
Problems = Iterator[Problem]

MOST_PARAMETERS = 80_000_000
"""The store keeps a centre and Adam's two moments, 12 bytes per parameter, in one value; SQLite allows 1e9 bytes."""
MOST_DESCRIPTOR_DIMENSIONS = 973
"""The history has two columns for each dimension and up to 51 others, and a table of SQLite 2,000 columns. Metrics of
the task leave room for fewer."""
MOST_CHUNK_PAIRS = CHUNK_PAIRS[1]
PLACED = ("target", "nearness")
"""Kinds of objectives with a place among the descriptors."""


def problems_of(config: Values, rules: Sequence[Rule]) -> list[Problem]:
    """The problems that rules find in a config, in their order."""
    problems: list[Problem] = []
    for rule in rules:
        try:
            for problem in rule(config, config.task):  # what is found before a value is unknown counts
                problems.append(problem)  # noqa: PERF402
        except Unknown:
            continue
    return problems


# The task and the policy


def fitness_fits(config: Values, task: TaskSpec) -> Problems:
    if config["task.fitness"] == "final" and not task.final_fitness:
        why = f" for {task.name}, whose last reward says little about the episode"
        yield not_allowed("task.fitness", "final", "sum", why=why)


def descriptor_fits(config: Values, task: TaskSpec) -> Problems:
    if (chosen := config["task.descriptor"]) is not None and task.kind == "jax":
        why = f" for {task.name}, whose descriptor is its own"
        yield not_allowed("task.descriptor", chosen, "null", why=why)
    room, dimensions = MOST_DESCRIPTOR_DIMENSIONS - -(-len(task.metric_names) // 2), len(task.descriptor_names)
    if dimensions > room:
        key = "task.environment" if chosen is None else "task.descriptor"
        what = (
            f"the descriptor of {task.name} has {dimensions:,} dimensions; a run can store at most "
            f"{room}, since its history has two columns for each"
        )
        yield problem_of(key, config[key], what, allowed=f"at most {room}")


def choices_are_for_objects(config: Values, task: TaskSpec) -> Problems:
    if task.kind != "python":
        why = f" for {task.name}, which is no task of Python objects"
        for key, none in (("success", "null"), ("metrics", "[]"), ("new_object_each_episode", "false")):
            if value := config[f"task.{key}"]:
                yield not_allowed(f"task.{key}", value, none, why=why)


def times_are_measured(config: Values, task: TaskSpec) -> Problems:
    for key in ("budget.rollout_s", "budget.cpu_s"):
        if (limit := config[key]) is not None and task.kind == CALLER:
            yield not_allowed(key, limit, "null", why=f" for {task.name}, whose episodes the caller computes")


def recycling_is_for_processes_of_users(config: Values, task: TaskSpec) -> Problems:
    if (count := config["task.recycle_after_episodes"]) is not None and task.kind not in ("python", "function"):
        why = f" for {task.name}, whose workers compute nothing with objects or functions of yours"
        yield not_allowed("task.recycle_after_episodes", count, "null", why=why)
    if (limit := config["compute.worker_memory_mb"]) is not None and config["compute.inline_workers"] == "threads":
        why = " with compute.inline_workers = threads, which share their memory"
        yield not_allowed("compute.worker_memory_mb", limit, "null", why=why)


def time_limit_is_for_steps_of_unequal_times(config: Values, task: TaskSpec) -> Problems:
    if (limit := config["task.time_limit_s"]) is not None and task.kind == "jax":
        why = f" for {task.name}, whose steps take equal times"
        yield not_allowed("task.time_limit_s", limit, "null", why=why)


def low_rank_noise_needs_matrices(config: Values, task: TaskSpec) -> Problems:
    if task.parameters is not None and (noise := config["search.noise.kind"]) != "full":
        why = f" for {task.name}, whose parameters are no matrices"
        yield not_allowed("search.noise.kind", noise, "full", why=why)


def callers_episodes(config: Values, task: TaskSpec) -> Problems:
    if task.kind != CALLER:
        return
    if (target := config["budget.target_certified"]) is not None:
        why = f" for {task.name}, of which no new episodes can be run"
        hint = "; budget.target_fitness ends the run at a value of the episodes that the caller computes"
        yield not_allowed("budget.target_certified", target, "null", why=why, hint=hint)
    start, parameters = config.given.get(f"{TASK_OPTIONS}start"), config[f"{TASK_OPTIONS}parameters"]
    if start is not None and not (parameters and is_start(start, parameters)):
        what = f"a list of {parameters} numbers, one for each of task.options.parameters"
        why = "" if parameters else ", which belongs to task.options.parameters"
        yield not_allowed(f"{TASK_OPTIONS}start", start, what if parameters else "left out", why=why)
    if task.parameters is None and 0 in (config[TASK_OPTIONS + name] for name in ("observation_size", "action_size")):
        what = "the caller's episodes have no size; set it, or task.options.observation_size and action_size"
        yield problem_of(f"{TASK_OPTIONS}parameters", 0, what, allowed="at least 1")


def output_fits(config: Values, task: TaskSpec) -> Problems:
    noise, output = config["policy.action_noise"], config["policy.output"]
    if noise and output not in NOISY_OUTPUTS:
        why = f" for policy.output = {output}, which has numbers only for {one_of(NOISY_OUTPUTS)}"
        yield not_allowed("policy.action_noise", noise, "0", why=why)
    if output in DISCRETE_OUTPUTS and task.action_size < 2:
        why = f" for {task.name}, whose action is one number: {output} chooses among several"
        yield not_allowed("policy.output", output, "tanh, linear or gaussian", why=why)
    if task.discrete_actions and output not in DISCRETE_OUTPUTS:
        why = f" for {task.name}, whose action is one of {task.action_size} to choose from"
        yield not_allowed("policy.output", output, one_of(DISCRETE_OUTPUTS), why=why)


def network_fits_the_store(config: Values, task: TaskSpec) -> Problems:
    if config.policy.parameters > MOST_PARAMETERS:
        hidden = list(config["policy.hidden"])
        what = f"{show(hidden)} makes more than {MOST_PARAMETERS:,} parameters for {task.name}"
        problem = f"{what}, which is the most that the run store can keep; the layers must be narrower"
        yield problem_of("policy.hidden", hidden, problem, allowed="narrower")


# The search


def objectives_fit(config: Values, task: TaskSpec) -> Problems:
    for key, objective in _objectives(config):
        names, kind = task.descriptor_names, objective.get("kind")
        middle = list(objective.get("descriptor") or ())
        if kind in PLACED and len(middle) != len(names):
            what = (
                f"{show(middle)} has {len(middle)} numbers, but the descriptor of {task.name} has {len(names)}, "
                f"{', '.join(names)}; give descriptor one number for each"
            )
            yield problem_of(key, middle, what)
        if kind == "final" and not task.final_fitness:
            what = f"final says little about an episode of {task.name}; choose return or another objective"
            yield problem_of(key, kind, what, suggestion="return")
        if kind == "goal_distance" and not task.has_goal:
            what = f"goal_distance is not known in {task.name}, which has no goal; choose another objective"
            yield problem_of(key, kind, what)


def _objectives(config: Values) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Key and content of each objective of a config."""
    if (kind := config.get("search.objective.kind")) is not None:
        place = {"descriptor": config["search.objective.descriptor"]} if kind in PLACED else {}
        yield f"search.objective.{'descriptor' if place else 'kind'}", {"kind": kind, **place}
    for objective in config.get("search.objectives") or ():
        yield "search.objectives", objective


def nearest_elites_need_a_place(config: Values, task: TaskSpec) -> Problems:
    if config["search.candidate_choice"] == "place" and config["search.objective.kind"] != "target":
        what = "place needs search.objective.kind = target, whose middle is the place; choose fitness or novelty"
        yield problem_of("search.candidate_choice", "place", what, suggestion="fitness")


def centres_fit_the_method(config: Values, task: TaskSpec) -> Problems:
    if (only := only_centres(config)) is not None and (centres := config["search.centres"]) != only:
        key = config.settings.only_centres
        each = "" if isinstance(key, int) else f" for each of {key}"
        why = f" for {config['search.algorithm']}, which has one centre{each}"
        yield not_allowed("search.centres", centres, f"{only} or auto", why=why)


def statistics_need_training(config: Values, task: TaskSpec) -> Problems:
    if not config.settings.gathers_statistics and config["policy.observation_normalization"] is True:
        why = f" for {config['search.algorithm']}, which has no training episodes to gather statistics from"
        yield not_allowed("policy.observation_normalization", True, "false", why=why)


def unknown_output(search: SearchConfig, task: TaskSpec) -> Problem | None:
    """The problem of a search, a user's perhaps, that reads an output of episodes that there is not."""
    has = {"success": bool(task.success), METRICS: bool(task.metric_names)}
    known = [name for name in sorted(AT_THE_END) if has.get(name, True)]
    unknown = sorted({*search.outputs()} - {*known})
    if not unknown:
        return None
    what = f"{search.algorithm} reads the output {unknown[0]!r}, which no episode of {task.name} has"
    return Problem(f"search.algorithm: {what}; choose {one_of(known)}", "search.algorithm", unknown[0], one_of(known))


def method_has_its_map(config: Values, task: TaskSpec) -> Problems:
    if config.settings.needs_map and config["map.enabled"] is False:
        why = f" for {config['search.algorithm']}, {config.settings.needs_map}"
        yield not_allowed("map.enabled", False, "true", why=why)


def method_can_fill_its_map(config: Values, task: TaskSpec) -> Problems:
    kinds = config.settings.map_kinds
    if config["map.enabled"] is not False and (kind := config["map.kind"]) not in kinds:
        why = f" for {config['search.algorithm']}, which does not fill such a map"
        yield not_allowed("map.kind", kind, one_of([*kinds, "auto"]), why=why)


def method_has_its_start(config: Values, task: TaskSpec) -> Problems:
    if config.settings.needs_start and not (start := config["search.init_from"]):
        why = f" for {config['search.algorithm']}, {config.settings.needs_start}"
        yield not_allowed("search.init_from", start, "the folder of a run", why=why)


def start_exists(config: Values, task: TaskSpec) -> Problems:
    """The problem of a `search.init_from` that does not name an existing folder."""
    if (start := config["search.init_from"]) is None:
        return
    folder, _ = start_of(start)
    try:
        what = "" if stat.S_ISDIR(os.stat(folder).st_mode) else "is a file"
    except (FileNotFoundError, NotADirectoryError):
        what = "does not exist"
    except (OSError, ValueError) as error:  # permission denied, too long, or a null character
        what = f"cannot be accessed ({getattr(error, 'strerror', error)})"
    if what:
        allowed = "the folder of another run, with :best or a cell as :3,17 after it if wanted, or null"
        yield problem_of("search.init_from", start, f"{folder} {what}; must be {allowed}", allowed=allowed)


# Shapes of the work, and where it runs


def rollout_can(config: Values, task: TaskSpec) -> Problems:
    name, rollouts = config["compute.rollout"], config.rollouts
    try:
        fit = [other for other, candidate in rollouts.items() if task.kind in candidate.task_kinds]
    except Unknown:  # of the task; whether there is such a rollout can be said without it
        fit = [*rollouts]
    if (rollout := rollouts.get(name)) is None:
        yield wrong_value("compute.rollout", name, f"auto or {one_of(fit)}", fit)
        return
    if config.on_gpu and not rollout.runs_on_gpus:
        why = f"{name} runs only on CPUs, but {RESOURCES}gpu is {show(config[f'{RESOURCES}gpu'])}"
    elif reason := rollout.why_not(task, config.policy):
        why = f"{name} cannot run {task.name}: {reason}"
    else:
        return
    allowed = f"auto or {one_of(others)}" if (others := [other for other in fit if other != name]) else "auto"
    yield problem_of("compute.rollout", name, f"{why}; must be {allowed}", allowed=allowed)


def rollout_hides_nothing(config: Values, task: TaskSpec) -> Problems:
    """The problem of a task of which the rollout computes numbers where the task itself is not finite."""
    name = config["compute.rollout"]
    if not (hidden := task.hidden.get(name)):
        return
    others = [other for other, it in config.rollouts.items() if task.kind in it.task_kinds and other not in task.hidden]
    what = (
        f"{hidden}. With {name} such a product is 0, and nobody would notice; choose the argument before it is "
        "computed, as in jnp.log(jnp.where(x > 0.0, x, 1.0))"
    )
    instead = f", or set compute.rollout to {one_of(others)}, which finds such episodes invalid" if others else ""
    yield problem_of("task.environment", task.name, f"{task.name}: {what}{instead}")


def chunks_divide_the_pairs(config: Values, task: TaskSpec) -> Problems:
    pairs, chunk = config["search.pairs"], config["compute.chunk_pairs"]
    if pairs % chunk:
        below = pairs // chunk * chunk
        fits = f"{below + chunk} (or {below})" if below else f"{chunk}"
        hint = f"try pairs = {fits}, or compute.chunk_pairs = auto"
        what = f"{pairs} is not a multiple of compute.chunk_pairs ({chunk}); {hint}"
        yield problem_of("search.pairs", pairs, what, suggestion=below + chunk)


def blocks_divide_the_chunks(config: Values, task: TaskSpec) -> Problems:
    chunk, rollout = config["compute.chunk_pairs"], config["compute.rollout_block_pairs"]
    if chunk % rollout:
        divisors = [size for size in range(1, MOST_CHUNK_PAIRS + 1) if chunk % size == 0]
        near = sorted(sorted(divisors, key=lambda size: abs(size - rollout))[:2])
        what = f"{rollout} does not divide compute.chunk_pairs ({chunk}); try {' or '.join(map(str, near))}, or auto"
        yield problem_of("compute.rollout_block_pairs", rollout, what, suggestion=near[0])


def no_more_than_all_pairs(config: Values, task: TaskSpec) -> Problems:
    pairs = config["search.pairs"]
    for key, otherwise in (("search.shaping.count", "null for all"), ("compute.gradient_block_pairs", "auto")):
        if (number := config.get(key)) is not None and number > pairs:
            what = f"{number} is more than search.pairs ({pairs}); try {pairs}, or {otherwise}"
            yield problem_of(key, number, what, suggestion=pairs)


def halves_need_two_pairs(config: Values, task: TaskSpec) -> Problems:
    for key in ("search.pairs", "search.shaping.count"):
        if config["search.step_gate"] and config[key] == 1:
            what = "1 pair has no halves, so that search.step_gate would allow no step; try 2"
            yield problem_of(key, 1, what, suggestion=2)
            return


def a_cluster_needs_ray(config: Values, task: TaskSpec) -> Problems:
    if (engine := config["compute.engine"]) == "ray":
        return
    cpu = f"{RESOURCES}cpu"
    for key, allowed in (("compute.address", [None]), (cpu, ["auto", 1])):
        if (value := config.get(key)) not in (None, *allowed):
            what = f"{show(value)} needs compute.engine = ray, but the engine is {engine}"
            yield problem_of(key, value, what, suggestion=FIELDS[key].default)


def threads_need_simd_inline(config: Values, task: TaskSpec) -> Problems:
    if config["compute.inline_workers"] != "threads":
        return
    rollout = config.rollouts.get(config["compute.rollout"])
    if config["compute.engine"] != "inline" or (rollout is not None and not rollout.runs_in_threads):
        able = one_of([name for name, candidate in config.rollouts.items() if candidate.runs_in_threads])
        what = (
            f"threads needs compute.engine = inline and compute.rollout = {able}, because only its code runs in "
            "several threads at once; must be processes"
        )
        yield problem_of("compute.inline_workers", "threads", what, allowed="processes")


def workers_are_whole_actors(config: Values, task: TaskSpec) -> Problems:
    workers, cpus = config["compute.workers"], config[f"{RESOURCES}cpu"]
    if "auto" not in (workers, cpus) and workers % cpus:
        what = f"{workers} is not a multiple of {RESOURCES}cpu ({cpus}), the cores of each actor"
        yield problem_of("compute.workers", workers, what, suggestion=-(-workers // cpus) * cpus)


def gpus_can_be_assigned(config: Values, task: TaskSpec) -> Problems:
    if (gpus := config[f"{RESOURCES}gpu"]) > 1 and gpus != int(gpus):
        yield not_allowed(f"{RESOURCES}gpu", gpus, "a whole number or a fraction below 1")


def run_ends(config: Values, task: TaskSpec) -> Problems:
    if all(config[key] is None for key in BUDGET):
        yield problem_of("budget", None, f"this run has no limit; set at least one of {one_of(BUDGET)}")


TASK_RULES: tuple[Rule, ...] = (
    fitness_fits,
    recycling_is_for_processes_of_users,
    time_limit_is_for_steps_of_unequal_times,
    times_are_measured,
    low_rank_noise_needs_matrices,
    output_fits,
    cells_fit,
)
"""Rules of what a task allows: if overrides replace the task of a file, values against them are left out."""
METHOD_RULES: tuple[Rule, ...] = (
    centres_fit_the_method,
    statistics_need_training,
    method_has_its_map,
    method_can_fill_its_map,
)
"""Rules of what a method allows: if overrides replace the method of a file, values against them are left out."""
RULES: tuple[Rule, ...] = (
    fitness_fits,
    descriptor_fits,
    choices_are_for_objects,
    recycling_is_for_processes_of_users,
    time_limit_is_for_steps_of_unequal_times,
    times_are_measured,
    low_rank_noise_needs_matrices,
    callers_episodes,
    output_fits,
    network_fits_the_store,
    *MAP_RULES,
    objectives_fit,
    nearest_elites_need_a_place,
    *METHOD_RULES,
    rollout_can,
    chunks_divide_the_pairs,
    blocks_divide_the_chunks,
    no_more_than_all_pairs,
    halves_need_two_pairs,
    a_cluster_needs_ray,
    threads_need_simd_inline,
    workers_are_whole_actors,
    gpus_can_be_assigned,
    run_ends,
)
"""Rules of every config, in the order in which problems are told."""
START_RULES: tuple[Rule, ...] = (method_has_its_start, start_exists, rollout_hides_nothing)
"""Rules of a config with which a new run is about to start."""
