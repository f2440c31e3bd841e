"""The values of a config: what is given, and what follows for the keys that are left out.

Every default here depends only on the config and the task and never on the machine, because the resolved shapes affect
the floating-point results of a run. (The one exception is `compute.rollout: auto`, which also asks what this machine
can run; the choice is stored with the run.)
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cached_property
from typing import Any, cast

from pydantic.fields import FieldInfo

from es_service.config.keys import FIELDS, KIND, kind_of, parts_of, search_fields
from es_service.config.parts import RESOURCES, TASK_OPTIONS
from es_service.config.search import PRESETS, PopulationConfig, PresetRow, SearchConfig, preset_rows
from es_service.protocol.messages import UNBOUNDED, Bounds, TaskSpec, with_options
from es_service.protocol.options import defaults_of
from es_service.protocol.policy_spec import DISCRETE_OUTPUTS, NOISY_OUTPUTS, OF_RANKED, PolicySpec
from es_service.protocol.rollouts import CHUNK_PAIRS, Rollouts, choose

CHUNKS = 8
"""Number of chunks for 128 to 512 pairs, so that several workers can share the population."""
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
MOST_AUTO_CELLS = 10_000
CVT_CELLS = 1024
MOST_GRID_DIMENSIONS = 6
"""Largest number of descriptor dimensions for which `map.kind: auto` is a grid, else cvt."""
WITHOUT_POLICY = {
    "policy.hidden": (),
    "policy.output": "linear",
    "policy.bias": False,
    "policy.observation_normalization": False,
    "policy.action_noise": 0.0,
}
"""The policy of a task that has none: its parameters are weights of one constant input, which are those of the task."""


class Unknown(KeyError):  # noqa: N818 (caught by what applies the rules)
    """A value, a task or a method that is invalid or missing, which is reported elsewhere."""


class _UnknownTask:
    """Stands for a task that is not known: what needs an attribute of it is not known either."""

    def __getattr__(self, name: str) -> Any:
        raise Unknown(name)


class Values(Mapping[str, Any]):
    """The value of every key of a config, each found when it is asked for.

    It is what is given; else what follows from another value, what the preset or the task says, or the default. A key
    raises Unknown if its value is invalid, or cannot be found because another one is.
    """

    def __init__(
        self,
        given: Mapping[str, Any],
        task: TaskSpec | None,
        settings: type[SearchConfig] | None,
        rollouts: Rollouts,
        invalid: Collection[str] = (),
    ) -> None:
        """Values of a config.

        Args:
            given: values that the config gives, by dotted key.
            task: the task that `task.environment` names; None if it is not known.
            settings: those of the method that `search.algorithm` names; None if it is not known.
            rollouts: the rollouts that `compute.rollout` may name.
            invalid: keys whose values are invalid.
        """
        self.given, self.rollouts = given, rollouts
        self._task, self._settings, self._invalid = task, settings, invalid
        self._found: dict[str, Any] = {}

    @cached_property
    def task(self) -> TaskSpec:
        """The task, with the descriptor that its options choose. Each attribute of a task that is not known raises
        Unknown."""
        return (
            cast(TaskSpec, _UnknownTask()) if self._task is None else with_options(self._task, options_of(self.given))
        )

    @property
    def settings(self) -> type[SearchConfig]:
        """Class of the method's settings. Raises Unknown."""
        if self._settings is None:
            raise Unknown("search.algorithm")
        return self._settings

    @property
    def policy(self) -> PolicySpec:
        """The policy. Raises Unknown."""
        return policy_spec_of(
            self, self.task.observation_size, self.task.action_size, is_ranked=self.task.ranked_actions
        )

    @property
    def on_gpu(self) -> bool:
        """Whether workers have GPUs."""
        return self[f"{RESOURCES}gpu"] > 0

    def of(self, given: Mapping[str, Any]) -> Values:
        """Values of a config with the same task and method that gives other ones."""
        return Values(given, self._task, self._settings, self.rollouts)

    @property
    def missing(self) -> dict[str, FieldInfo]:
        """Keys to which the config gives no value and the method neither a default nor a preset, with their fields."""
        fields = {} if self._settings is None else search_fields(self._settings)
        required = {key: its for key, its in fields.items() if its.is_required() and kind_of(key) not in fields}
        found = {*self._presets, *DEFAULTS, *self._invalid, *self.given}
        return {key: its for key, its in required.items() if key not in found}

    def known(self) -> dict[str, Any]:
        """All values that can be found, by key."""
        return {key: self[key] for key in self if key in self}

    def __iter__(self) -> Iterator[str]:
        yield from self._fields
        yield from (TASK_OPTIONS + name for name in ({} if self._task is None else self._task.options))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __getitem__(self, key: str) -> Any:
        if key not in self._found:
            self._found[key] = self._value(key)
        return self._found[key]

    def _value(self, key: str) -> Any:
        if key in self._invalid:
            raise Unknown(key)
        if key in self.given and not asks(key, self.given[key]):
            return self.given[key]
        if key == "policy.observation_clip" and self["policy.observation_normalization"] is False:
            return None  # the bound is in standard deviations, which are then unknown
        if key == "policy.action_noise" and self["policy.output"] not in NOISY_OUTPUTS:
            return 0.0
        if key in self._presets:
            if (preset := self.given.get("search.preset", "literature")) in [*PRESETS]:
                return getattr(self._presets[key], preset)
            if not key.endswith(f".{KIND}"):  # on which it depends what other keys there are
                raise Unknown(key)
        if key in self._of_task:
            return self._of_task[key]
        if key in DEFAULTS:
            return DEFAULTS[key](self, self.task)
        return self._default(key)

    @cached_property
    def _presets(self) -> Mapping[str, PresetRow]:
        return {} if self._settings is None else {row.key: row for row in preset_rows(self._settings)}

    @cached_property
    def _of_task(self) -> Mapping[str, Any]:
        """What the task says: an output that chooses one of several actions; of a function, which has no policy, a
        policy whose parameters are those of the function."""
        if self._task is None:
            return {}
        options = {TASK_OPTIONS + name: default for name, default in defaults_of(self._task.options).items()}
        if self._task.parameters is not None:
            return options | WITHOUT_POLICY | ({"search.evaluation_episodes": 1} if self._task.deterministic else {})
        return options | ({"policy.output": DISCRETE_OUTPUTS[0]} if self._task.discrete_actions else {})

    @cached_property
    def _fields(self) -> Mapping[str, Any]:
        return FIELDS if self._settings is None else FIELDS | search_fields(self._settings)

    def _default(self, key: str) -> Any:
        """The default of a key; of a part's, that of the chosen kind."""
        part, _, leaf = key.rpartition(".")
        fields = {leaf: self._fields.get(key)}
        if self._settings is not None and leaf != KIND and (kinds := parts_of(self._settings).get(part)):
            kind = self[kind_of(key)]
            fields = kinds[kind].model_fields if isinstance(kind, str) and kind in kinds else {}
        field = fields.get(leaf)
        if field is None or field.is_required():
            raise Unknown(key)
        return field.get_default(call_default_factory=True)


def asks(key: str, value: object) -> bool:
    """Whether a value asks for its key to be resolved. A plain `==` would fail for an array in a Python mapping."""
    if key not in LEFT_OPEN:
        return False
    return value is None if LEFT_OPEN[key] is None else isinstance(value, str) and value == LEFT_OPEN[key]


def options_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """The options of the task among flat values: name -> value."""
    return {key.removeprefix(TASK_OPTIONS): value for key, value in values.items() if key.startswith(TASK_OPTIONS)}


def policy_spec_of(
    values: Mapping[str, Any], observation_size: int, action_size: int, *, is_ranked: bool = False
) -> PolicySpec:
    """The policy that values of a config make, by dotted key; keys that are missing have their defaults.

    Args:
        is_ranked: `TaskSpec.ranked_actions`.
    """
    names = ("hidden", "activation", "output", "bias", "memory")
    hidden, activation, output, bias, memory = (
        values.get(f"policy.{name}", FIELDS[f"policy.{name}"].default) for name in names
    )
    output = OF_RANKED.get(output, output) if is_ranked else output
    return PolicySpec((observation_size, *hidden, action_size), activation, output, bias, memory or 0)


def only_centres(config: Values) -> int | None:
    """The only number of centres that the method supports; None if it supports any."""
    only = config.settings.only_centres
    return config[only] if isinstance(only, str) else only


def default_cells(kind: str, dimensions: int) -> tuple[int, ...]:
    """Default number of cells: 1,024 for a cvt; for a grid, the cells along each dimension.

    These are 100 for one dimension and 20 x 20 for two. For more, all dimensions have the same number: the largest that
    gives at most 10,000 cells in all, but at least 2. The grid of a dominated map has one cell along all dimensions but
    the first six.
    """
    if kind == "cvt":
        return (CVT_CELLS,)
    if kind == "dominated" and dimensions > MOST_GRID_DIMENSIONS:
        return (*default_cells("grid", MOST_GRID_DIMENSIONS), *(1,) * (dimensions - MOST_GRID_DIMENSIONS))
    each = {1: 100, 2: 20}.get(dimensions) or max(2, int(MOST_AUTO_CELLS ** (1.0 / dimensions) + 1e-9))
    return (each,) * dimensions


def _bounds(config: Values, task: TaskSpec) -> Bounds | None:
    """The bounds of the descriptor; None if a map needs them and the descriptor has none."""
    if UNBOUNDED in task.descriptor_bounds and config["map.enabled"]:
        return None
    return tuple((-1.0, 1.0) if pair == UNBOUNDED else pair for pair in task.descriptor_bounds)


def _qd_offset(config: Values, task: TaskSpec) -> float:
    """Lowest fitness of an episode, from the lowest reward that the task specifies; 0 if it specifies none."""
    if task.least_reward is None:
        return 0.0
    return task.least_reward * (1 if config["task.fitness"] == "final" else config["task.episode_steps"])


def _engine(config: Values, task: TaskSpec) -> str:
    has_actor_cores = config[f"{RESOURCES}cpu"] not in ("auto", 1)
    return "ray" if config["compute.address"] is not None or has_actor_cores else "inline"


def _rollout(config: Values, task: TaskSpec) -> str:
    here = config["compute.address"] is None  # in a cluster it does not matter what this machine can run
    return choose(config.rollouts, task, config.policy, gpu=config.on_gpu, here=here)


def _pairs(config: Values) -> int:
    return config["search.pairs"] if issubclass(config.settings, PopulationConfig) else WITHOUT_PAIRS


def _chunk_pairs(config: Values, task: TaskSpec) -> int:
    rollout = config.rollouts.get(config["compute.rollout"])
    limits = rollout.pair_limits(task) if rollout else CHUNK_PAIRS
    return default_chunk_pairs(_pairs(config), (MOST_GPU_PAIRS, MOST_GPU_PAIRS) if config.on_gpu else limits)


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


DEFAULTS: dict[str, Callable[[Values, TaskSpec], Any]] = {
    "task.episode_steps": lambda config, task: task.episode_steps,
    "search.centres": lambda config, task: only_centres(config) or config.settings.first_centres,
    "map.kind": lambda config, task: "grid" if len(task.descriptor_names) <= MOST_GRID_DIMENSIONS else "cvt",
    "map.bounds": _bounds,
    "map.cells": lambda config, task: default_cells(config["map.kind"], len(task.descriptor_names)),
    "map.qd_offset": _qd_offset,
    "compute.engine": _engine,
    "compute.rollout": _rollout,
    "compute.chunk_pairs": _chunk_pairs,
    "compute.rollout_block_pairs": lambda config, task: default_rollout_block_pairs(
        config["compute.chunk_pairs"], config.policy.parameters, gpu=config.on_gpu
    ),
    "compute.gradient_block_pairs": lambda config, task: default_gradient_block_pairs(
        _pairs(config), config["compute.chunk_pairs"], config.policy.parameters
    ),
}
"""Key -> its default, as a function of the config and the task."""
LEFT_OPEN = {key: None if key == "task.episode_steps" else "auto" for key in DEFAULTS}
"""Key with such a default -> the value that asks for it. Leaving the key out has the same effect."""
