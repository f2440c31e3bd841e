"""Resolves the values that a config leaves open, and checks its sections against each other.

Every rule here depends only on the config and the task and never on the machine, because the resolved shapes affect the
floating-point results of a run. (The one exception is `compute.rollout: auto`, which also asks what this machine can
run; the choice is stored with the run.) Values are passed as one flat mapping, "search.sigma" -> 0.02. A key that is
missing from it was invalid and has been reported already, so rules that need it report nothing.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from typing import Any

from es_service.config.caller import CALLER
from es_service.config.fields import RESOURCES, TASK_OPTIONS
from es_service.config.keys import FIELDS, policy_of
from es_service.config.map_rules import MOST_GRID_DIMENSIONS, default_bounds, default_cells, default_qd_offset
from es_service.config.methods import only_centres
from es_service.config.model import RunConfig, policy_spec
from es_service.config.options import options_of
from es_service.config.problems import not_allowed, one_of, problem_of, wrong_value
from es_service.config.search import PopulationConfig, SearchConfig
from es_service.config.yaml_text import show
from es_service.errors import Problem
from es_service.protocol.messages import TaskSpec, with_options
from es_service.protocol.policy_spec import DISCRETE_OUTPUTS, NOISY_OUTPUTS, PolicySpec
from es_service.protocol.rollouts import CHUNK_PAIRS, Rollouts, choose, why_not
from es_service.protocol.system import given_path

LEFT_OPEN: dict[str, str | None] = {
    "task.episode_steps": None,
    "search.centres": "auto",
    "map.kind": "auto",
    "map.bounds": "auto",
    "map.cells": "auto",
    "map.qd_offset": "auto",
    "compute.engine": "auto",
    "compute.rollout": "auto",
    "compute.chunk_pairs": "auto",
    "compute.rollout_block_pairs": "auto",
    "compute.gradient_block_pairs": "auto",
}
"""Keys that this module resolves -> the value that asks for it. Leaving the key out has the same effect."""
MOST_CHUNK_PAIRS = CHUNK_PAIRS[1]
CHUNKS = 8
"""Number of chunks for 128 to 512 pairs, so that several workers can share the population."""
MOST_PARAMETERS = 80_000_000
"""The store keeps a centre and Adam's two moments, 12 bytes per parameter, in one value; SQLite allows 1e9 bytes."""
MOST_ROLLOUT_BLOCK_PAIRS = 32
"""Enough pairs to fill vector units."""
MOST_ROLLOUT_BLOCK_BYTES = 5 * 2**20
"""If the weights of the pairs that step together are larger, they do not fit into a core's share of the cache."""
MOST_GPU_PAIRS = 4096
"""With GPUs: most pairs of a chunk, which all step together, since a GPU takes about as long for few as for many."""
MOST_GPU_BLOCK_BYTES = 2**33
"""With GPUs: most bytes of the weights of pairs that step together."""
MOST_GRADIENT_BLOCKS = 32
"""A partial gradient is as large as the policy, so a generation should send only a few."""
LEAST_GRADIENT_BLOCK_NUMBERS = 4_000_000
"""Fewest noise numbers in a block, about 2 ms of work; a smaller block would cost more to send than to sum."""
WITHOUT_PAIRS = 512
"""Pairs from which the shapes of a search without any are derived; they have no effect then."""
MOST_DESCRIPTOR_DIMENSIONS = 974
"""The history has two columns for each dimension and up to 51 others, and a table of SQLite 2,000 columns."""
FEW_CHUNK_PAIRS = 8
"""A chunk with fewer pairs is likely to cost more to send and start than to compute."""


WITHOUT_POLICY = {
    "policy.hidden": (),
    "policy.output": "linear",
    "policy.bias": False,
    "policy.observation_normalization": False,
    "policy.action_noise": 0.0,
}
"""The policy of a task that has none: its parameters are weights of one constant input, which are those of the task."""


def default_chunk_pairs(pairs: int, limits: tuple[int, int] = CHUNK_PAIRS) -> int:
    """The largest divisor of `pairs` up to pairs / 8, within the limits (16 to 64); a multiple of 8 if possible.

    512 -> 64, 5000 -> 40, 64 -> 16, 7 -> 7.
    """
    least, most = limits
    most = min(most, max(least, pairs // CHUNKS))
    divisors = [size for size in range(1, most + 1) if pairs % size == 0]
    return max([size for size in divisors if size % 8 == 0] or divisors)


def default_rollout_block_pairs(chunk_pairs: int, parameters: int, *, gpu: bool = False) -> int:
    """The largest divisor of `chunk_pairs` up to 32 whose weights (float32, both signs) take at most 5 MiB; on a GPU
    without the limit of 32, and up to 8 GiB.

    (64, 4482) -> 32; (40, 75528) -> 8.
    """
    pairs, size = (chunk_pairs, MOST_GPU_BLOCK_BYTES) if gpu else (MOST_ROLLOUT_BLOCK_PAIRS, MOST_ROLLOUT_BLOCK_BYTES)
    most = max(1, min(pairs, size // (2 * 4 * parameters)))
    return max(size for size in range(1, most + 1) if chunk_pairs % size == 0)


def default_gradient_block_pairs(pairs: int, chunk_pairs: int, parameters: int) -> int:
    """Pairs in the fewest whole chunks that give at most 32 blocks, each large enough to be worth a message.

    (512, 64, 4482) -> 512, all pairs; (4096, 64, 4482) -> 896; (5000, 40, 75528) -> 160.
    """
    chunks = -(-pairs // chunk_pairs)
    worth = -(-LEAST_GRADIENT_BLOCK_NUMBERS // (parameters * chunk_pairs))
    return min(pairs, chunk_pairs * max(worth, -(-chunks // MOST_GRADIENT_BLOCKS)))


def resolve(
    values: Mapping[str, Any],
    left_open: Collection[str],
    task: TaskSpec | None,
    settings: type[SearchConfig] | None,
    rollouts: Rollouts,
) -> dict[str, Any]:
    """Fill in the values that were left open, if the values from which they are derived are present.

    Args:
        values: valid values of the config.
        left_open: keys of LEFT_OPEN that are to be resolved.
        task: the task that `task.environment` names, or None where that is invalid.
        settings: those of the method that `search.algorithm` names, or None where that is invalid.
        rollouts: the rollouts that `compute.rollout` may name.
    """
    values = dict(values)
    if task is not None:
        if "task.episode_steps" in left_open:
            values["task.episode_steps"] = task.episode_steps
        chosen = with_options(task, options_of(values))
        if "map.kind" in left_open:
            values["map.kind"] = "grid" if len(chosen.descriptor_names) <= MOST_GRID_DIMENSIONS else "cvt"
        kind = values.get("map.kind")
        if "map.bounds" in left_open:
            values["map.bounds"] = default_bounds(values, chosen)
        if "map.cells" in left_open and kind is not None:
            values["map.cells"] = default_cells(kind, len(chosen.descriptor_names))
        if "map.qd_offset" in left_open:
            values["map.qd_offset"] = default_qd_offset(values, task)
    if "search.centres" in left_open and settings is not None:
        values["search.centres"] = only_centres(values, settings) or settings.first_centres
    if "compute.engine" in left_open:
        has_actor_cores = _value(values, f"{RESOURCES}cpu") not in ("auto", 1)
        for_ray = _value(values, "compute.address") is not None or has_actor_cores
        values["compute.engine"] = "ray" if for_ray else "inline"
    if "compute.rollout" in left_open and task is not None:
        # In a cluster it does not matter what this machine can run.
        shape, gpu, here = _policy_spec(values, task), _on_gpu(values), values.get("compute.address") is None
        values["compute.rollout"] = choose(rollouts, task, shape, gpu=gpu, here=here)
    has_pairs = settings is None or issubclass(settings, PopulationConfig)
    pairs = values.get("search.pairs") if has_pairs else WITHOUT_PAIRS
    if pairs is not None and "compute.chunk_pairs" in left_open:
        rollout = rollouts.get(values.get("compute.rollout", ""))
        limits = rollout.pair_limits(task) if rollout and task else CHUNK_PAIRS
        if _on_gpu(values):
            limits = (MOST_GPU_PAIRS, MOST_GPU_PAIRS)
        values["compute.chunk_pairs"] = default_chunk_pairs(pairs, limits)
    chunk_pairs = values.get("compute.chunk_pairs")
    if chunk_pairs is not None and task is not None:
        parameters = _policy_spec(values, task).parameters
        if "compute.rollout_block_pairs" in left_open:
            values["compute.rollout_block_pairs"] = default_rollout_block_pairs(
                chunk_pairs, parameters, gpu=_on_gpu(values)
            )
        if "compute.gradient_block_pairs" in left_open and pairs is not None:
            values["compute.gradient_block_pairs"] = default_gradient_block_pairs(pairs, chunk_pairs, parameters)
    if isinstance(values.get("search.init_from"), str):
        # An absolute path, so that the stored config names the same run from every working directory.
        values["search.init_from"] = os.path.abspath(given_path(values["search.init_from"]))
    return values


def values_of_task(task: TaskSpec) -> dict[str, Any]:
    """Values that a task fills in where the config leaves them out: an output that chooses one of several actions; of a
    function, which has no policy, a policy whose parameters are those of the function."""
    if task.parameters is not None:
        return WITHOUT_POLICY | ({"search.evaluation_episodes": 1} if task.deterministic else {})
    return {"policy.output": DISCRETE_OUTPUTS[0]} if task.discrete_actions else {}


def is_idle(key: str, task: TaskSpec) -> bool:
    """Whether a key has no effect with a task, which has no policy."""
    return task.parameters is not None and (
        key.startswith("policy.") or key in ("task.episode_steps", "task.descriptor")
    )


def task_problems(values: Mapping[str, Any], task: TaskSpec) -> list[Problem]:
    """Problems of a fitness or a choice of a descriptor that the task does not support, and of missing bounds."""
    problems = []
    if values.get("task.fitness") == "final" and not task.final_fitness:
        why = f" for {task.name}, whose last reward says little about the episode"
        problems.append(not_allowed("task.fitness", "final", "sum", why=why))
    if (chosen := values.get("task.descriptor")) is not None and task.kind == "jax":
        why = f" for {task.name}, whose descriptor is its own"
        problems.append(not_allowed("task.descriptor", chosen, "null", why=why))
    if (dimensions := len(with_options(task, options_of(values)).descriptor_names)) > MOST_DESCRIPTOR_DIMENSIONS:
        key = "task.environment" if chosen is None else "task.descriptor"
        what = (
            f"the descriptor of {task.name} has {dimensions:,} dimensions; a run can store at most "
            f"{MOST_DESCRIPTOR_DIMENSIONS}, since its history has two columns for each"
        )
        problems.append(problem_of(key, values.get(key), what, allowed=f"at most {MOST_DESCRIPTOR_DIMENSIONS}"))
    if (limit := values.get("task.time_limit_s")) is not None and task.kind == "jax":
        why = f" for {task.name}, whose steps take equal times"
        problems.append(not_allowed("task.time_limit_s", limit, "null", why=why))
    if (noise := values.get("search.noise.kind", "full")) != "full" and task.parameters is not None:
        why = f" for {task.name}, whose parameters are no matrices"
        problems.append(not_allowed("search.noise.kind", noise, "full", why=why))
    if task.kind == CALLER and (target := values.get("budget.target_certified")) is not None:
        why = f" for {task.name}, of which no new episodes can be run"
        hint = "; budget.target_fitness ends the run at a value of the episodes that the caller computes"
        problems.append(not_allowed("budget.target_certified", target, "null", why=why, hint=hint))
    if task.kind == CALLER and task.parameters is None:
        sizes = (values.get(f"{TASK_OPTIONS}{name}") for name in ("observation_size", "action_size"))
        if 0 in sizes:
            what = "the caller's episodes have no size; set it, or task.options.observation_size and action_size"
            problems.append(problem_of(f"{TASK_OPTIONS}parameters", 0, what, allowed="at least 1"))
    return problems


def policy_problems(values: Mapping[str, Any], task: TaskSpec) -> list[Problem]:
    """Problems of a network that is too large for the run store, and of an output that does not fit."""
    spec, problems = _policy_spec(values, task), []
    noise = values.get("policy.action_noise", 0.0)
    if noise and spec.output not in NOISY_OUTPUTS:
        why = f" for policy.output = {spec.output}, which has numbers only for {one_of(NOISY_OUTPUTS)}"
        problems.append(not_allowed("policy.action_noise", noise, "0", why=why))
    if spec.output in DISCRETE_OUTPUTS and task.action_size < 2:
        why = f" for {task.name}, whose action is one number: {spec.output} chooses among several"
        problems.append(not_allowed("policy.output", spec.output, "tanh, linear or gaussian", why=why))
    if task.discrete_actions and spec.output not in DISCRETE_OUTPUTS:
        why = f" for {task.name}, whose action is one of {task.action_size} to choose from"
        problems.append(not_allowed("policy.output", spec.output, one_of(DISCRETE_OUTPUTS), why=why))
    if spec.parameters <= MOST_PARAMETERS:
        return problems
    hidden = list(spec.widths[1:-1])
    what = f"{show(hidden)} makes more than {MOST_PARAMETERS:,} parameters for {task.name}"
    problem = f"{what}, which is the most that the run store can keep; the layers must be narrower"
    return [*problems, problem_of("policy.hidden", hidden, problem, allowed="narrower")]


def _policy_spec(values: Mapping[str, Any], task: TaskSpec) -> PolicySpec:
    return policy_of(values, task.observation_size, task.action_size)


def shape_problems(values: Mapping[str, Any]) -> list[Problem]:
    """Problems of numbers of pairs, chunks and blocks that do not fit each other."""
    problems = []
    pairs, chunk = values.get("search.pairs"), values.get("compute.chunk_pairs")
    rollout, gradient = values.get("compute.rollout_block_pairs"), values.get("compute.gradient_block_pairs")
    if pairs is not None and chunk is not None and pairs % chunk:
        below = pairs // chunk * chunk
        fits = f"{below + chunk} (or {below})" if below else f"{chunk}"
        hint = f"try pairs = {fits}, or compute.chunk_pairs = auto"
        what = f"{pairs} is not a multiple of compute.chunk_pairs ({chunk}); {hint}"
        problems.append(problem_of("search.pairs", pairs, what, suggestion=below + chunk))
    if chunk is not None and rollout is not None and chunk % rollout:
        divisors = [size for size in range(1, MOST_CHUNK_PAIRS + 1) if chunk % size == 0]
        near = sorted(sorted(divisors, key=lambda size: abs(size - rollout))[:2])
        what = f"{rollout} does not divide compute.chunk_pairs ({chunk}); try {' or '.join(map(str, near))}, or auto"
        problems.append(problem_of("compute.rollout_block_pairs", rollout, what, suggestion=near[0]))
    top = values.get("search.shaping.count")
    if pairs is not None and top is not None and top > pairs:
        what = f"{top} is more than search.pairs ({pairs}); try {pairs}, or null for all"
        problems.append(problem_of("search.shaping.count", top, what, suggestion=pairs))
    if values.get("search.step_gate") and 1 in (pairs, top):
        name = "search.pairs" if pairs == 1 else "search.shaping.count"
        what = "1 pair has no halves, so that search.step_gate would allow no step; try 2"
        problems.append(problem_of(name, 1, what, suggestion=2))
    if pairs is not None and gradient is not None and gradient > pairs:
        what = f"{gradient} is more than search.pairs ({pairs}); try {pairs}, or auto"
        problems.append(problem_of("compute.gradient_block_pairs", gradient, what, suggestion=pairs))
    return problems


def engine_problems(values: Mapping[str, Any], rollouts: Rollouts) -> list[Problem]:
    """Problems of a cluster without Ray, of threads with a rollout that has none, and of a share of GPUs that
    cannot be assigned."""
    problems = []
    if _value(values, "compute.engine") != "ray":
        problems = [
            problem_of(
                name,
                values[name],
                f"{show(values[name])} needs compute.engine = ray, but the engine is {values['compute.engine']}",
                suggestion=FIELDS[name].default,
            )
            for name in ("compute.address", f"{RESOURCES}cpu")
            if _value(values, name) not in (FIELDS[name].default, *([1] if name == f"{RESOURCES}cpu" else []))
        ]
    inline, threads = values.get("compute.engine") == "inline", values.get("compute.inline_workers") == "threads"
    rollout = rollouts.get(values.get("compute.rollout", ""))
    if threads and not (inline and (rollout is None or rollout.runs_in_threads)):
        able = one_of([name for name, candidate in rollouts.items() if candidate.runs_in_threads])
        what = (
            f"threads needs compute.engine = inline and compute.rollout = {able}, because only its code runs in "
            "several threads at once; must be processes"
        )
        problems.append(problem_of("compute.inline_workers", "threads", what, allowed="processes"))
    workers, cpus = values.get("compute.workers", "auto"), _value(values, f"{RESOURCES}cpu")
    if "auto" not in (workers, cpus) and workers % cpus:
        what = f"{workers} is not a multiple of {RESOURCES}cpu ({cpus}), the cores of each actor"
        problems.append(problem_of("compute.workers", workers, what, suggestion=-(-workers // cpus) * cpus))
    gpus = _value(values, f"{RESOURCES}gpu")
    if gpus > 1 and gpus != int(gpus):
        problems.append(not_allowed(f"{RESOURCES}gpu", gpus, "a whole number or a fraction below 1"))
    return problems


def _on_gpu(values: Mapping[str, Any]) -> bool:
    return _value(values, f"{RESOURCES}gpu") > 0


def _value(values: Mapping[str, Any], key: str) -> Any:
    """The value in the config, or the field's default."""
    return values.get(key, FIELDS[key].default)


def rollout_problems(values: Mapping[str, Any], task: TaskSpec | None, rollouts: Rollouts) -> list[Problem]:
    """The problem of a rollout that does not exist, or that cannot be used for this config."""
    if (name := values.get("compute.rollout")) is None:
        return []
    fit = [other for other, candidate in rollouts.items() if task is None or task.kind in candidate.task_kinds]
    if (rollout := rollouts.get(name)) is None:
        return [wrong_value("compute.rollout", name, f"auto or {one_of(fit)}", fit)]
    if _on_gpu(values) and not rollout.runs_on_gpus:
        why = f"{name} runs only on CPUs, but {RESOURCES}gpu is {show(_value(values, f'{RESOURCES}gpu'))}"
    elif task is not None and (reason := rollout.why_not(task, _policy_spec(values, task))):
        why = f"{name} cannot run {task.name}: {reason}"
    else:
        return []
    others = [other for other in fit if other != name]
    allowed = f"auto or {one_of(others)}" if others else "auto"
    return [problem_of("compute.rollout", name, f"{why}; must be {allowed}", allowed=allowed)]


def hidden_problems(values: Mapping[str, Any], task: TaskSpec | None, rollouts: Rollouts) -> list[Problem]:
    """The problem of a task of which the rollout computes numbers where the task itself is not finite."""
    name = values.get("compute.rollout", "")
    if task is None or not (hidden := task.hidden.get(name)):
        return []
    others = [other for other, it in rollouts.items() if task.kind in it.task_kinds and other not in task.hidden]
    what = (
        f"{hidden}. With {name} such a product is 0, and nobody would notice; choose the argument before it is "
        "computed, as in jnp.log(jnp.where(x > 0.0, x, 1.0))"
    )
    instead = f", or set compute.rollout to {one_of(others)}, which finds such episodes invalid" if others else ""
    return [problem_of("task.environment", task.name, f"{task.name}: {what}{instead}")]


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
    if budget.generations is None and budget.env_steps is None and budget.wall_clock_s is None:
        targets = {"target_fitness": budget.target_fitness, "target_certified": budget.target_certified}
        named = " or ".join(f"{key} ({target})" for key, target in targets.items() if target is not None)
        warnings.append(
            f"budget: this run ends only when it reaches {named}, which may never happen; consider setting "
            "budget.generations as well"
        )
    return warnings
