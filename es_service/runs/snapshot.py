"""The state of a run after one generation, read at once and checked, since a run folder may come from a stranger."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from es_service.config.resolution import policy_spec_of
from es_service.config.tasks import task_from_fields
from es_service.errors import NotInRunError, StoreError
from es_service.loop.blocks import ARCHIVE, BEST, MAP, OBSERVATIONS, Tree, centre_path, joined, value_of
from es_service.loop.contents import stored_elite, stored_policy
from es_service.loop.forms import INTEGER, REAL, Sizes, missing, policy_problem, problem
from es_service.loop.state import Best, statistics_in_force
from es_service.protocol import content
from es_service.protocol.content import Arrays, Contents, as_bytes
from es_service.protocol.messages import FloatArray, Moments, PolicySpec, TaskSpec
from es_service.search.algorithms.base import CentreState
from es_service.search.maps.behaviour_map import BehaviourMap, Elite
from es_service.search.maps.geometry import Grid
from es_service.search.novelty import NoveltyArchive
from es_service.search.steps import STEPS
from es_service.store import reader
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore
from workers.policy import act, action, dense_of_each, initial_memory, normalise, split_layers

if TYPE_CHECKING:
    import pandas as pd


# Whether the data of a run fit its config, checked before anything uses them: a run folder may come from a stranger.
#
# The store checks types (`store.facts`); this is about what only readers of a run know: which columns there must be,
# and what the parts of a state are.

COLUMNS = {
    **dict.fromkeys(("generation", "env_steps", "episodes", "centre", "archive_size", "invalid_members"), "INTEGER"),
    **dict.fromkeys(("retries", "lost_workers", "workers"), "INTEGER"),
    **dict.fromkeys(("centre_fitness_mean", "best_fitness", "wall_clock_s", "steps_per_second"), "REAL"),
    **dict.fromkeys(("seconds_rollout", "seconds_gradient", "seconds_evaluation", "seconds_driver"), "REAL"),
}
"""Columns of every history -> their types."""
OF_CENTRES = {"centre": "INTEGER", "fitness_weight": "REAL", "fitness_mean": "REAL", "update_norm": "REAL"}
"""The same for the evaluated centres."""


def stored_task(meta: RunMeta) -> TaskSpec:
    """The task of a run as it was when the run was created; what its version did not record has its default."""
    return task_from_fields(meta.task)


def stored_policy_spec(meta: RunMeta) -> PolicySpec:
    """What a run's policies are."""
    task = stored_task(meta)
    return policy_spec_of(meta.constants, task.observation_size, task.action_size, is_ranked=task.ranked_actions)


def sizes_of(meta: RunMeta) -> Sizes:
    task, has_map = stored_task(meta), meta.constants["map.enabled"]
    cells = tuple(meta.constants["map.cells"] or ()) if has_map else None
    bounds = tuple((low, high) for low, high in meta.constants["map.bounds"] or ()) if has_map else ()
    step, kinds = STEPS.get(meta.constants.get("search.step.kind") or ""), {"i": INTEGER, "f": REAL}
    of_step = {} if step is None else {name: kinds[array.dtype.kind] for name, array in step.fresh(1).items()}
    parameters = stored_policy_spec(meta).parameters
    dominated = {}
    if has_map and meta.constants.get("map.kind") == "dominated":
        dominated = {name: meta.constants[f"map.{name}"] for name in ("slots", "neighbours")}
    dimensions = len(task.descriptor_names)
    return Sizes(parameters, task.observation_size, dimensions, cells, bounds, of_step, dominated)


def sound_meta(folder: Path, meta: RunMeta) -> RunMeta:
    """The description of a run. Raises StoreError if it lacks a column that every run has."""
    for table, needed in ((meta.columns, COLUMNS), (meta.evaluation_columns, OF_CENTRES)):
        types = {column.name: column.type for column in table}
        for name, kind in needed.items():
            if types.get(name) != kind:
                raise StoreError(f"{folder} is not what es-service writes: it has no {kind} column {name}", run=folder)
    return meta


def sound_nodes(folder: Path, meta: RunMeta, blocks: Tree, wanted: Collection[str] = ("",)) -> dict[str, Arrays]:
    """The nodes of a state, of its blocks.

    Args:
        wanted: the beginnings of the paths of the nodes that must be among them, if every state has them.

    Raises StoreError if one is missing, or has arrays that this run cannot have.
    """
    sizes = sizes_of(meta)
    try:
        nodes = joined(blocks)
    except (ValueError, KeyError) as error:  # blocks that do not fit each other
        raise StoreError(f"{folder} is not what es-service writes: {error}", run=folder) from error
    absent = missing(nodes, sizes, wanted)
    found = f"its state has no part {absent}" if absent else ""
    if found := found or next(filter(None, (problem(path, arrays, sizes) for path, arrays in nodes.items())), ""):
        raise StoreError(f"{folder} is not what es-service writes: {found}", run=folder)
    return nodes


def sound_contents(folder: Path, meta: RunMeta, contents: Mapping[bytes, Arrays]) -> Mapping[bytes, Arrays]:
    """Policies and traces. Raises StoreError if one has arrays that this run cannot have."""
    sizes = sizes_of(meta)
    for name, arrays in contents.items():
        if found := policy_problem(arrays, sizes):
            text = f"{folder} is not what es-service writes: the content {name.hex()} {found}"
            raise StoreError(text, run=folder)
    return contents


def require_sound_state(store: RunStore) -> None:
    """Raise StoreError if the newest state in a store, or a policy in it, is none of its run."""
    if store.generation is None:
        return
    sound_nodes(store.folder, store.meta, store.load())
    for name in store.contents():  # one at a time, since all policies together may be large
        sound_contents(store.folder, store.meta, {name: store.content(name)})


@dataclass(frozen=True, eq=False)
class Policy(content.Policy):
    """A trained controller that needs only NumPy: observation [O] or [..., O] -> action [..., A].

    It includes the observation statistics that it runs with. A policy with a memory is called through `start`.

    On one machine, an observation has the same action, bit for bit, alone and among others, whatever their memory
    layout; on a processor of another kind, the last bits of an action may differ.
    """

    observation_clip: float | None
    certified: Mapping[str, Mapping[str, float | int | None]] = field(default_factory=dict, repr=False)
    """Of `policy("certified")`: title of a task -> means with their intervals and successes there, by the names of the
    columns of `Run.certified`; the run's own task first, then others in which it was certified."""

    def __call__(self, observation: Any) -> FloatArray:
        """Action for a raw (not normalised) observation, as in evaluations: without noise, and the most probable one.

        Raises ValueError for a wrong size, or if the policy has a memory.
        """
        if self.spec.memory:
            raise ValueError(
                "this policy has a memory of what it saw in an episode; call act = policy.start() at the start of each "
                "episode, and then act(observation)"
            )
        return self.act(observation)[0]

    @property
    def layers(self) -> list[tuple[FloatArray, FloatArray | None]]:
        """(weights [in, out], biases [out] or None) of each layer; a memory has two, its gates and its candidate."""
        return split_layers(self.spec, self.parameters_D)

    def start(self) -> Callable[[Any], FloatArray]:
        """Function from the observations of one episode, one after another, to actions; of several episodes at once if
        they have leading axes. Each call of it continues the memory, if the policy has one."""
        memory_H = None

        def step(observation: Any) -> FloatArray:
            nonlocal memory_H
            actions, memory_H = self.act(observation, memory_H)
            return actions

        return step

    def act(self, observation: Any, memory: FloatArray | None = None) -> tuple[FloatArray, FloatArray | None]:
        """(action, memory after the step); the memory before it is None at the start of an episode. A policy without a
        memory has None always."""
        observation = np.asarray(observation, np.float32, order="C")
        size = self.spec.widths[0]
        if observation.shape[-1:] != (size,):
            raise ValueError(
                f"this policy takes observations of shape [..., {size}]; got shape {list(observation.shape)}"
            )
        x = normalise(np, observation, self.observation_mean_O, self.observation_std_O, self.observation_clip)
        before = initial_memory(np, self.spec, *x.shape[:-1]) if memory is None else np.asarray(memory, np.float32)
        outputs, after = act(np, self.spec, self.layers, before, x, dense_of_each)
        return action(np, self.spec.output, outputs), after


@dataclass(frozen=True)
class Snapshot:
    """The state of a run after one generation, read at once and checked."""

    folder: Path
    meta: RunMeta
    generation: int
    nodes: Tree
    """Arrays of the nodes of its state, or of those that were wanted."""
    contents: Contents = field(default_factory=dict)
    """The policies and traces that were wanted, by their names."""

    @property
    def novelty(self) -> pd.DataFrame:
        """The novelty archive; see `Run.novelty`."""
        import pandas as pd

        names = stored_task(self.meta).descriptor_names
        archive = self.archive
        columns = {"generation": archive.generation_N, "centre": archive.centre_N}
        return pd.DataFrame(columns | dict(zip(names, archive.descriptor_N_B.T, strict=True)))

    @property
    def archive(self) -> NoveltyArchive:
        return value_of(NoveltyArchive, self.nodes, ARCHIVE)

    @property
    def behaviour_map(self) -> BehaviourMap:
        """The behaviour map as arrays; see `Run.behaviour_map`."""
        map_ = value_of(BehaviourMap | None, self.nodes, MAP)
        if map_ is None:
            raise NotInRunError(
                f"{self.folder} has no behaviour map: it was started with map.enabled = false", run=self.folder
            )
        return map_

    @property
    def map(self) -> pd.DataFrame:
        """The behaviour map as a table; see `Run.map`."""
        import pandas as pd

        map_, names = self.behaviour_map, stored_task(self.meta).descriptor_names
        labels = [f"cell_{name}" for name in names]
        return pd.DataFrame(
            {"cell": map_.cell_N}
            | (dict(zip(labels, map_places(map_).T, strict=True)) if isinstance(map_.geometry, Grid) else {})
            | {"fitness": map_.fitness_N}
            | dict(zip(names, map_.descriptor_N_B.T, strict=True))
            | {"generation": map_.generation_N, "centre": map_.centre_N}
            | ({} if map_.samples_N is None else {"samples": map_.samples_N})
        )

    def cell(self, place: int | Sequence[int]) -> int:
        """Number of a filled cell; see `Run.cell`."""
        map_ = self.behaviour_map
        place = (index(place),) if isinstance(place, int | np.integer) else tuple(map(_whole, place))
        shown = ",".join(map(str, place))
        dimensions = len(map_.geometry.shape)
        if len(place) != dimensions:
            first = ",".join(map(str, map_places(map_)[0])) if map_.size else ""
            example = f", such as {first} (the first filled cell)" if first else "; the map is empty"
            raise NotInRunError(
                f"cell {shown} is not in the map of {self.folder}: its cells are named by "
                f"{dimensions} numbers{example}",
                field="cell",
                value=place,
                run=self.folder,
            )
        cell = map_.geometry.cell_at(place)
        if cell is not None and map_.row_of(cell) is not None:
            return cell
        near = nearest_filled(map_, place)
        hint = f"; the nearest filled cell is {','.join(map(str, near))}" if near else "; the map is empty"
        if cell is None:
            sizes = " and ".join(f"0 to {n - 1}" for n in map_.geometry.shape)
            why = f"cell {shown} is not in the map of {self.folder}, whose cells are numbered {sizes}"
        else:
            why = f"cell {shown} of {self.folder} is empty"
        raise NotInRunError(f"{why}{hint}", field="cell", value=place, suggestion=near, run=self.folder)

    def elites(self, cells: Collection[int] | None = None) -> tuple[BehaviourMap, dict[int, Elite]]:
        """The map and its elites; see `Run.elites`."""
        map_ = self.behaviour_map
        chosen = map_.cell_N.tolist() if cells is None else cells
        names = {cell: map_names(map_, [cell]) for cell in chosen}
        spec = stored_policy_spec(self.meta)
        elites = {
            cell: stored_elite(spec, *(self.contents[name] for name in of_cell)) for cell, of_cell in names.items()
        }
        return map_, elites

    @property
    def best(self) -> Best:
        """The best centre so far."""
        return value_of(Best, self.nodes, BEST)

    @property
    def newest_centre(self) -> tuple[CentreState, float] | None:
        """The centre that this generation updated, the fittest of several, and its mean fitness; None if the generation
        evaluated only policies, as those of map_elites do."""
        [history] = reader.read_history(self.folder, self.generation, 1)
        row = {"centre": history["centre"], "fitness_mean": history["centre_fitness_mean"]}
        if centre_path(int(row["centre"])) not in self.nodes:  # the row of the history is about a policy
            [rows] = reader.read_evaluations(self.folder, self.generation, 1)
            rows = [centre_row for centre_row in rows if centre_path(int(centre_row["centre"])) in self.nodes]
            if not rows:
                return None
            row = max(rows, key=lambda centre_row: np.nan_to_num(centre_row["fitness_mean"], nan=-np.inf))
        return value_of(CentreState, self.nodes, centre_path(int(row["centre"]))), float(row["fitness_mean"])

    def require_newest_centre(self) -> tuple[CentreState, float]:
        """`newest_centre`. Raises NotInRunError if there is none."""
        if (newest := self.newest_centre) is None:
            raise NotInRunError(
                f"{self.folder} has no newest centre: its generation {self.generation} evaluated only policies; choose "
                "the best one, or the elite of a cell",
                field="policy",
                value="centre",
                allowed="best, or a cell",
                suggestion="best",
                run=self.folder,
            )
        return newest

    def policy(self, which: Literal["best", "centre"]) -> Policy:
        """The best or the newest centre as a policy; see `Run.policy`."""
        if which == "best":
            return acting(
                self.meta, stored_policy(stored_policy_spec(self.meta), self.contents[self.best.policy.tobytes()])
            )
        (centre, _), enabled = self.require_newest_centre(), self.meta.constants["policy.observation_normalization"]
        mean_O, std_O = statistics_in_force(value_of(Moments, self.nodes, OBSERVATIONS), centre, enabled)
        return acting(self.meta, content.Policy(stored_policy_spec(self.meta), centre.centre_D, mean_O, std_O))


def acting(meta: RunMeta, policy: content.Policy) -> Policy:
    """A policy of a run, which acts with the run's observation clip."""
    of_policy = (policy.spec, policy.parameters_D, policy.observation_mean_O, policy.observation_std_O)
    return Policy(*of_policy, meta.constants["policy.observation_clip"])


def map_names(map_: BehaviourMap, cells: Collection[int]) -> list[bytes]:
    """Names of the policies of the elites of some cells, each followed by that of its trace. Raises KeyError for an
    empty cell."""
    rows = np.searchsorted(map_.cell_N, list(cells), sorter=(order := np.argsort(map_.cell_N)))
    rows = np.append(order, 0)[rows]
    if empty := [cell for cell, row in zip(cells, rows, strict=True) if not map_.size or map_.cell_N[row] != cell]:
        raise KeyError(empty[0])
    both = zip(as_bytes(map_.policy_N[rows]), as_bytes(map_.trace_N[rows]), strict=True)
    return [name for names in both for name in names]


def map_places(map_: BehaviourMap) -> NDArray[np.int64]:
    """Place of each filled cell along each dimension of the map, [N, dimensions]."""
    places = [map_.geometry.index_of(int(cell)) for cell in map_.cell_N]
    return np.array(places, np.int64).reshape(map_.size, len(map_.geometry.shape))


def nearest_filled(map_: BehaviourMap, place: Sequence[int]) -> tuple[int, ...] | None:
    """Place of the filled cell whose indices are nearest to `place`, the oldest of equally near ones; None if empty."""
    if not map_.size:
        return None
    return min(
        (map_.geometry.index_of(int(cell)) for cell in map_.cell_N),
        key=lambda other: sum((a - b) ** 2 for a, b in zip(other, place, strict=True)),
    )


def _whole(number: Any) -> int:
    """Convert to int. Rows of a pandas table may hold whole numbers as floats. Raises TypeError for a fraction."""
    if int(number) != number:
        raise TypeError(f"{number!r} is not a whole number")
    return int(number)
