"""A run as its reader sees it: history as a DataFrame, policies as NumPy functions. Reading never changes a run."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from es_service.config.compute import COMPUTE_CONSTANTS
from es_service.config.yaml_text import read_yaml_file
from es_service.loop.parts import BEST, BLOCK_PREFIX, CELL_PREFIX, ELITE_PREFIX, GEOMETRY_PART, elite_part
from es_service.protocol.messages import PolicyShape
from es_service.runs.moment import Moment, Policy, descriptor_names, make_policy, policy_shape
from es_service.search.maps.behaviour_map import BehaviourMap, Elite
from es_service.store import reader
from es_service.store.digest import checked_parts, digest_of
from es_service.store.folder import CONFIG
from es_service.store.schema import RunMeta

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Run:
    """A run folder, opened for reading. Every access reads what is committed now, also while a driver is writing."""

    folder: Path

    @cached_property
    def meta(self) -> RunMeta:
        """What was fixed when the run was created."""
        return reader.read_meta(self.folder)

    @property
    def run_id(self) -> str:
        """Name of the run for ever, wherever its folder is moved."""
        return self.meta.run_id

    @property
    def config(self) -> dict[str, Any]:
        """The resolved config the run was created with."""
        return self.meta.config

    @property
    def present_config(self) -> dict[str, Any]:
        """`config` as the run would go on with it: budget, engine and time limits as they were last set.

        Other edits of `config.yaml` are left aside: they are for `resume` to refuse, and no part of what the run has.
        Raises ConfigError if the folder's `config.yaml`, which has them, cannot be read.
        """
        file = self.folder / CONFIG
        if not file.exists():
            return self.config
        recorded = read_yaml_file(file)
        budget, compute = (recorded.get(section, self.config[section]) for section in ("budget", "compute"))
        if isinstance(compute, Mapping):
            compute = {**compute, **{key: self.config["compute"][key] for key in COMPUTE_CONSTANTS}}
        return self.config | {"budget": budget, "compute": compute}

    @property
    def constants(self) -> dict[str, Any]:
        """What cannot change in this run: dotted key -> value."""
        return self.meta.constants

    @property
    def history(self) -> pd.DataFrame:
        """One row per generation, indexed by generation; `es_service.loop.history` documents the columns. Whole numbers
        stay whole where some are missing: pandas' Int64."""
        return self.history_until(None)

    def history_until(self, generation: int | None) -> pd.DataFrame:
        """`history` up to a generation, that one included."""
        import pandas as pd  # a quarter of a second that starting a run need not spend

        columns, count = self.meta.columns, None if generation is None else generation + 1
        rows = reader.read_history(self.folder, None, count)
        table = pd.DataFrame(rows, columns=pd.Index([column.name for column in columns]))
        whole = [column.name for column in columns if column.type == "INTEGER"]
        return table.astype({name: "Int64" for name in whole if table[name].hasnans}).set_index("generation")

    def history_rows(self, since_generation: int | None = None) -> list[dict[str, Any]]:
        """History as dictionaries, oldest first; only from `since_generation` on if given."""
        return reader.read_history(self.folder, since_generation)

    def parts(
        self, generation: int | None = None, wanted: Callable[[str], bool] = lambda part: True
    ) -> tuple[int, dict[str, dict[str, np.ndarray]]]:
        """(generation, state parts, perhaps only some), verified; the newest, or one of the last two generations."""
        return reader.read_parts(self.folder, generation, wanted)

    def at(self, generation: int | None = None, wanted: Callable[[str], bool] = lambda part: True) -> Moment:
        """The state after a generation, the newest or the one before it, or only some of its parts. All of them take
        as much memory as all of the map's policies."""
        return Moment(self.folder, self.meta, *self.parts(generation, wanted))

    @property
    def novelty(self) -> pd.DataFrame:
        """The novelty archive, one row per evaluated valid centre in order: generation, centre, descriptor."""
        return self.at(wanted=lambda part: part.startswith(BLOCK_PREFIX)).novelty

    @property
    def behaviour_map(self) -> BehaviourMap:
        """The map as arrays, without the elites' parameters. Raises NotInRunError if the run keeps none."""
        return self.at(wanted=is_light).behaviour_map

    @property
    def map(self) -> pd.DataFrame:
        """The map, one row per filled cell in the order of discovery: the cell's number, as the history has it, and its
        place along each dimension (none of a cvt), fitness when it entered, descriptor, generation, centre."""
        return self.at(wanted=is_light).map

    def cell(self, place: int | Sequence[int]) -> int:
        """Number of a filled cell named by its place, as `map` has it: (3, 17), or 1023 of a cvt.

        Raises NotInRunError if there is no such cell, or nothing in it; the message names the nearest one that is
        filled.
        """
        return self.at(wanted=is_light).cell(place)

    def elite(self, place: int | Sequence[int]) -> Elite:
        """What is kept of a cell's elite: parameters, statistics, trace. Raises as `cell`."""
        cell = self.cell(place)
        return self.elites([cell])[1][cell]

    def elites(self, cells: Collection[int] | None = None) -> tuple[BehaviourMap, dict[int, Elite]]:
        """The map and, by number of their cells, some of its elites or all of them, as of one generation.

        All of them take as much memory as all of their policies.
        """
        names = None if cells is None else {elite_part(cell) for cell in cells}

        def wanted(part: str) -> bool:
            return is_light(part) or (part.startswith(ELITE_PREFIX) if names is None else part in names)

        return self.at(wanted=wanted).elites(cells)

    @property
    def descriptor_names(self) -> list[str]:
        """Of the descriptor's dimensions, in order."""
        return descriptor_names(self.meta)

    @property
    def generation(self) -> int | None:
        """Newest committed generation; None before the first."""
        return reader.read_generation(self.folder)

    def digest(self) -> str:
        """SHA-256 over everything deterministic in the run, after checking all that is stored.

        Raises StoreError that names what is damaged, as the command does.
        """
        return digest_of(checked_parts(self.folder)[0])

    @property
    def policy_shape(self) -> PolicyShape:
        """Layer widths of this run's policies."""
        return policy_shape(self.meta)

    def policy(self, which: Literal["best", "centre"] | int | Sequence[int] = "best") -> Policy:
        """The best centre so far, or a cell's elite, with the statistics it was evaluated with; or the newest centre
        with those it would go on with.

        Args:
            which: "best", "centre", or a cell by its place, such as (3, 17). Raises NotInRunError for an empty one.
        """
        if which == "best":
            return self.at(wanted=lambda part: part == BEST).policy("best")
        if which == "centre":
            return self.at(wanted=is_no_elite).policy("centre")
        if isinstance(which, str):
            raise ValueError(f"policy({which!r}): choose 'best', 'centre', or a cell such as (3, 17)")
        elite = self.elite(which)
        return make_policy(self.meta, elite.centre_D, elite.observation_mean_O, elite.observation_std_O)


def is_light(part: str) -> bool:
    """Whether a part of the state belongs to the map without its elites' policies."""
    return part == GEOMETRY_PART or part.startswith(CELL_PREFIX)


def is_no_elite(part: str) -> bool:
    """Whether a part of the state is anything but the policy of an elite, of which there may be many."""
    return not part.startswith(ELITE_PREFIX)


def open_run(folder: str | os.PathLike[str]) -> Run:
    """Open a run folder for reading.

    Raises:
        StoreError: not a run folder, or written by a newer version.
    """
    run = Run(Path(folder))
    _ = run.meta  # fail here, not at the first access
    return run
