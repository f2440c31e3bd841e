"""Reading of a run: history as a DataFrame, policies as NumPy functions. Reading never changes a run."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from es_service.config.model import COMPUTE_CONSTANTS
from es_service.config.text import read_yaml_file
from es_service.errors import ConfigError, NotInRunError, WayOut
from es_service.loop.blocks import ARCHIVE, BEST, CENTRES, MAP, OBSERVATIONS, Tree, names_of
from es_service.protocol.machine import given_path
from es_service.protocol.messages import PolicySpec, TaskSpec
from es_service.runs.certified import (
    all_certifications,
    certified_by_task,
    certified_policies,
    is_same_policy,
    newest_certified,
)
from es_service.runs.snapshot import (
    Policy,
    Snapshot,
    acting,
    map_names,
    sound_contents,
    sound_meta,
    sound_nodes,
    stored_policy_spec,
    stored_task,
)
from es_service.search.maps.behaviour_map import BehaviourMap, Elite
from es_service.store import reader
from es_service.store.digest import checked_parts, digest_of
from es_service.store.folder import CONFIG
from es_service.store.rows import Columns
from es_service.store.schema import RunMeta

if TYPE_CHECKING:
    import pandas as pd


draw_for_notebook: Callable[[Run], str] | None = None
"""Set by `api`."""


@dataclass(frozen=True)
class Run:
    """A run folder, opened for reading. Every access reads the committed data, also while a driver is writing."""

    folder: Path

    @cached_property
    def meta(self) -> RunMeta:
        """The data that were fixed when the run was created."""
        return sound_meta(self.folder, reader.read_meta(self.folder))

    @property
    def task(self) -> TaskSpec:
        """The task, as it was when the run was created."""
        return stored_task(self.meta)

    @property
    def run_id(self) -> str:
        """Unique name of the run, which stays the same when its folder is moved."""
        return self.meta.run_id

    @property
    def config(self) -> dict[str, Any]:
        """The resolved config the run was created with."""
        return self.meta.config

    @property
    def config_file(self) -> Path:
        """The folder's `config.yaml`, which errors of `present_config` name."""
        return self.folder / CONFIG

    @property
    def present_config(self) -> dict[str, Any]:
        """`config` with the budget, engine, workers, time limits and kept states that were set last, as `resume` would
        use them.

        Other edits of the folder's `config.yaml` are ignored here; `resume` refuses them. Raises ConfigError if that
        file cannot be read.
        """
        if not self.config_file.exists():
            return self.config
        recorded = read_yaml_file(self.config_file)
        budget, compute, store = (
            recorded.get(section, self.config[section]) for section in ("budget", "compute", "store")
        )
        if isinstance(compute, Mapping):
            compute = {**compute, **{key: self.config["compute"][key] for key in COMPUTE_CONSTANTS}}
        return self.config | {"budget": budget, "compute": compute, "store": store}

    @property
    def constants(self) -> dict[str, Any]:
        """Settings that cannot change in this run: dotted key -> value."""
        return self.meta.constants

    @property
    def history(self) -> pd.DataFrame:
        """One row per generation, indexed by generation; `es_service.loop.history` documents the columns. Integer
        columns with missing values have pandas' type Int64."""
        return self.history_until(None)

    def history_until(self, generation: int | None) -> pd.DataFrame:
        """`history` up to a generation, that one included."""
        count = None if generation is None else int(generation) + 1
        return _frame(reader.read_history_columns(self.folder, count)).set_index("generation")

    def history_rows(self, since_generation: int | None = None) -> list[dict[str, Any]]:
        """History as dictionaries, oldest first; only from `since_generation` on if given. Use `history` for a whole
        long history, which takes a tenth of the memory."""
        return reader.read_history(self.folder, None if since_generation is None else int(since_generation))

    @property
    def evaluations(self) -> pd.DataFrame:
        """One row per centre that was evaluated, in the order of evaluation: its generation, and the columns that
        `es_service.loop.history.evaluated_columns` documents. Integer columns with missing values have pandas' type
        Int64."""
        return self.evaluations_until(None)

    def evaluations_until(self, generation: int | None) -> pd.DataFrame:
        """`evaluations` up to a generation, that one included."""
        count = None if generation is None else int(generation) + 1
        return _frame(reader.read_evaluation_columns(self.folder, count))

    def at(
        self,
        generation: int | None = None,
        wanted: Collection[str] = ("",),
        named: Callable[[Snapshot], Iterable[bytes]] = lambda snapshot: (),
    ) -> Snapshot:
        """The state after a generation (None: the newest), as named arrays, all as of one moment.

        Args:
            wanted: beginnings of the paths of the nodes that are wanted.
            named: returns the names of the policies and traces that are wanted, too.

        Raises StoreError if the state is not kept: the last two are, and those of `store.keep_every`; or if it is none
        of this run.
        """
        snapshots: list[Snapshot] = []

        def named_by(at: int, blocks: Tree) -> Iterable[bytes]:
            nodes = sound_nodes(self.folder, self.meta, blocks, wanted)
            snapshots.append(Snapshot(self.folder, self.meta, at, nodes))
            return named(snapshots[-1])

        _, _, contents = reader.read_parts(
            self.folder, generation, lambda block: block.startswith(tuple(wanted)), named_by
        )
        return replace(snapshots[-1], contents=sound_contents(self.folder, self.meta, contents))

    @property
    def novelty(self) -> pd.DataFrame:
        """The novelty archive, one row per evaluated valid centre in order: generation, centre, descriptor."""
        return self.at(wanted=[ARCHIVE]).novelty

    @property
    def behaviour_map(self) -> BehaviourMap:
        """The behaviour map as arrays, without the elites' parameters. Raises NotInRunError if the run has none."""
        return self.at(wanted=[MAP]).behaviour_map

    @property
    def map(self) -> pd.DataFrame:
        """The behaviour map, one row per filled cell in the order of discovery: the cell's number (as in the history)
        and its index along each dimension (only for a grid); the elite's fitness, descriptor, generation and centre,
        and the number of its samples where the search counts them.
        """
        return self.at(wanted=[MAP]).map

    def cell(self, place: int | Sequence[int]) -> int:
        """Number of the filled cell at a place: its indices, such as (3, 17), or its number in a map of another kind.

        Raises NotInRunError if the cell does not exist or is empty; the message names the nearest filled cell.
        """
        return self.at(wanted=[MAP]).cell(place)

    def elite(self, place: int | Sequence[int]) -> Elite:
        """The elite of a cell: parameters, observation statistics and trace. Raises as `cell`."""
        [elite] = self.elites(lambda snapshot: [snapshot.cell(place)])[1].values()
        return elite

    def elites(
        self, choose: Callable[[Snapshot], Collection[int]] | None = None, generation: int | None = None
    ) -> tuple[BehaviourMap, dict[int, Elite]]:
        """The map, and its elites by the numbers of their cells, read from one generation, also while a driver writes.

        Args:
            choose: called with the state without the elites, returns the numbers of filled cells, in the order in which
                their elites are wanted; None: all, which takes as much memory as all of their policies.
            generation: one whose state is kept; None: the newest.

        Raises what `choose` raises.
        """
        cells: Collection[int] = ()

        def chosen(snapshot: Snapshot) -> list[bytes]:
            nonlocal cells
            map_ = snapshot.behaviour_map
            cells = map_.cell_N.tolist() if choose is None else choose(snapshot)
            return map_names(map_, cells)

        return self.at(generation, [MAP], chosen).elites(cells)

    @property
    def certified(self) -> pd.DataFrame:
        """The certified policies, one row per policy in the order of certification and rank; empty if there are none.

        `Certified.row` in `es_service.runs.certified` has the columns. Values are of episodes that no choice has
        seen, with intervals of 95 %; the policy with rank 0 is the one that selection put first.
        """
        import pandas as pd

        return pd.DataFrame([policy.row() for policy in certified_policies(self.folder)])

    @property
    def certified_by_task(self) -> pd.DataFrame:
        """The newest certified value in each task, one row per task, indexed by its title: the run's own task first,
        then the others in which policies were certified. Empty if there are none.

        Columns are those of `certified` for a task alone: certification, policy, generation, episodes, means with
        their intervals, successes.
        """
        import pandas as pd

        rows = [
            {
                "task": task,
                "certification": value.policy.number,
                "policy": value.policy.name,
                "generation": value.policy.generation,
                "episodes": value.episodes.count,
                **value.episodes.values(),
            }
            for task, value in certified_by_task(self.folder).items()
        ]
        return pd.DataFrame(rows).set_index("task") if rows else pd.DataFrame()

    @property
    def decisions(self) -> pd.DataFrame:
        """The tries to reach `budget.target_certified`, with the columns of `certified`; empty if there are none.

        They decide whether the run is over, so the value of a policy that has passed is too good on average.
        """
        import pandas as pd

        return pd.DataFrame([policy.row() for policy in all_certifications(self.folder) if policy.decides])

    @property
    def descriptor_names(self) -> list[str]:
        return list(self.task.descriptor_names)

    @property
    def generation(self) -> int | None:
        """Newest committed generation; None before the first."""
        return reader.read_generation(self.folder)

    def _repr_html_(self) -> str | None:
        """What a notebook shows: summary, curves and map; `report/write.py` draws it, which is above this room."""
        return None if draw_for_notebook is None else draw_for_notebook(self)

    def digest(self) -> str:
        """SHA-256 of everything deterministic in the run, after a check of all stored data.

        Raises StoreError if data are damaged; the message names them.
        """
        return digest_of(checked_parts(self.folder)[0])

    @property
    def policy_spec(self) -> PolicySpec:
        """What this run's policies are: their layers, memory and output."""
        return stored_policy_spec(self.meta)

    def policy(self, which: Literal["best", "centre", "certified"] | int | Sequence[int] = "best") -> Policy:
        """A policy of the run, with its observation statistics.

        Args:
            which: "best" (the best centre so far) or the place of a cell, such as (3, 17) (its elite), with the
                statistics of their evaluation; or "centre" (the centre that the newest generation updated, the fittest
                of several), with the statistics it would use next.

        "certified" is the policy that the newest certification of the run has put first; its attribute `certified` has
        its values by task.

        Raises NotInRunError for "certified" if the run has no certification, for a cell that does not exist or is
        empty, and for "centre" if the newest generation evaluated only policies, as those of map_elites do; ConfigError
        for another name.
        """
        name = which if isinstance(which, str) else None  # a place may be an array
        if name == "best":
            return self.at(wanted=[BEST], named=named_best).policy("best")
        if name == "centre":
            return self.at(wanted=[CENTRES, OBSERVATIONS]).policy("centre")
        if name == "certified":
            policy = newest_certified(self.folder)
            if policy is None:
                way_out = WayOut("certify", "certify one", str(self.folder))
                raise NotInRunError(f"{self.folder} has no certified policy", run=self.folder, ways_out=[way_out])
            values = certified_by_task(self.folder).items()
            values = {task: one.episodes.values() for task, one in values if is_same_policy(one.policy, policy)}
            return replace(acting(self.meta, policy.policy), certified=values)
        if isinstance(which, str):
            allowed = "'best', 'centre', 'certified', or a cell such as (3, 17)"
            raise ConfigError(f"policy({which!r}): choose {allowed}", field="which", value=which, allowed=allowed)
        return acting(self.meta, self.elite(which))

    def parameters(
        self, which: Literal["best", "centre", "certified"] | int | Sequence[int] = "best"
    ) -> dict[str, float]:
        """Parameters of the function that is the run's task, by name, as the function gets them.

        Args:
            which: as for `policy`.

        Raises as `policy`, and NotInRunError if the task is no function.
        """
        if (spec := self.task.parameters) is None:
            raise NotInRunError(
                f"{self.folder} has policies: its task {self.task.name} is no function of parameters",
                run=self.folder,
            )
        return spec.named(self.policy(which).parameters_D)


def _frame(columns: Columns) -> pd.DataFrame:
    """A table of columns, with which it shares its memory. Whole numbers of which some are missing have the type
    Int64."""
    import pandas as pd  # takes 0.25 s, which starting a run need not spend

    arrays: dict[str, Any] = {
        name: pd.arrays.IntegerArray(np.asarray(values), np.ma.getmaskarray(values))
        if np.ma.is_masked(values)
        else np.asarray(values)
        for name, values in columns.items()
    }
    return pd.DataFrame(arrays, copy=False)


def named_best(snapshot: Snapshot) -> list[bytes]:
    """Name of the policy of the best centre."""
    return [snapshot.best.policy.tobytes()]


def named_by_all(snapshot: Snapshot) -> frozenset[bytes]:
    """Names of all policies and traces of a state."""
    return names_of(snapshot.nodes)


def open_run(folder: str | os.PathLike[str]) -> Run:
    """Open a run folder for reading.

    Raises:
        StoreError: not a run folder, or written by a newer version.
    """
    run = Run(given_path(folder))
    _ = run.meta  # fail here, not at the first access
    return run
