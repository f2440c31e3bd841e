"""A run as its reader sees it: history as a DataFrame, policies as NumPy functions. Reading never changes a run."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from es_service.store import digest as run_digest
from es_service.search.algorithms.base import Member, member_from_arrays, member_part
from es_service.config.compute import COMPUTE_CONSTANTS
from es_service.config.yaml_text import read_yaml_file
from es_service.errors import NotInRunError
from es_service.search.maps.behaviour_map import CELL_PREFIX, ELITE_PREFIX, GEOMETRY_PART, BehaviourMap, Elite, elite_from_arrays, elite_part, map_from_parts
from es_service.search.maps.geometry import Grid
from es_service.search.novelty import BLOCK_PREFIX, archive_from_parts
from es_service.protocol.messages import FloatArray, PolicyShape
from es_service.loop.state import best_from_arrays, moments_from_arrays, statistics_in_force
from es_service.store import reader
from es_service.store.folder import CONFIG
from es_service.store.schema import RunMeta
from workers.policy import act, normalise, split_layers

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Policy:
    """A trained controller, NumPy only: observation [O] or [..., O] -> action [..., A] in [-1, 1].

    It carries the observation statistics it runs with, so it needs nothing else.
    """

    shape: PolicyShape
    parameters_D: FloatArray
    observation_mean_O: FloatArray
    observation_std_O: FloatArray
    observation_clip: float | None

    def __call__(self, observation: Any) -> FloatArray:
        """Action for a raw (not normalised) observation; no action noise. Raises ValueError for another size."""
        observation = np.asarray(observation, np.float32)
        size = self.shape.widths[0]
        if observation.shape[-1:] != (size,):
            raise ValueError(
                f"this policy takes observations of {size} numbers, [..., {size}]; got {observation.shape}"
            )
        x = normalise(np, observation, self.observation_mean_O, self.observation_std_O, self.observation_clip)
        return act(np, split_layers(self.shape, self.parameters_D), x)


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
        recorded = read_yaml_file(file)[0]
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
        """One row per generation, indexed by generation; columns are documented in `es_service.loop.history`. Whole numbers
        stay whole where some are missing: pandas' Int64."""
        import pandas as pd  # a quarter of a second that starting a run need not spend

        columns = self.meta.columns
        table = pd.DataFrame(self.history_rows(), columns=pd.Index([column.name for column in columns]))
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

    @property
    def novelty(self) -> pd.DataFrame:
        """The novelty archive, one row per evaluated valid centre in order: generation, member, descriptor."""
        import pandas as pd

        names = self.descriptor_names
        parts = self.parts(wanted=lambda part: part.startswith(BLOCK_PREFIX))[1]
        archive = archive_from_parts(parts, len(names))
        columns = {"generation": archive.generation_N, "member": archive.member_N}
        return pd.DataFrame(columns | dict(zip(names, archive.descriptor_N_B.T, strict=True)))

    @property
    def behaviour_map(self) -> BehaviourMap:
        """The map as arrays, without the elites' parameters. Raises NotInRunError if the run keeps none."""
        return self._map(self.parts(wanted=_light)[1])

    @property
    def map(self) -> pd.DataFrame:
        """The map, one row per filled cell in the order of discovery: the cell's number, as the history has it, and its
        place along each dimension (none of a cvt), fitness when it entered, descriptor, generation, member."""
        import pandas as pd

        map_, names = self.behaviour_map, self.descriptor_names
        labels = [f"cell_{name}" for name in names]
        return pd.DataFrame(
            {"cell": map_.cell_N}
            | (dict(zip(labels, map_places(map_).T, strict=True)) if isinstance(map_.geometry, Grid) else {})
            | {"fitness": map_.fitness_N}
            | dict(zip(names, map_.descriptor_N_B.T, strict=True))
            | {"generation": map_.generation_N, "member": map_.member_N}
        )

    def cell(self, place: int | Sequence[int]) -> int:
        """Number of a filled cell named by its place, as `map` has it: (3, 17), or 1023 of a cvt.

        Raises NotInRunError if there is no such cell, or nothing in it; the message names the nearest one that is
        filled.
        """
        map_ = self.behaviour_map
        place = (index(place),) if isinstance(place, int | np.integer) else tuple(map(_whole, place))
        shown = ",".join(map(str, place))
        dimensions = len(map_.geometry.shape)
        if len(place) != dimensions:
            near = ",".join(map(str, map_places(map_)[0])) if map_.size else "none yet"
            raise NotInRunError(
                f"cell {shown} is not in the map of {self.folder}: a cell has {dimensions} numbers there, "
                f"such as {near}, the first that was filled",
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
            why = f"cell {shown} is not in the map of {self.folder}, whose cells are {sizes}"
        else:
            why = f"cell {shown} of {self.folder} is empty"
        raise NotInRunError(f"{why}{hint}", field="cell", value=place, suggestion=near, run=self.folder)

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
            return _light(part) or (part.startswith(ELITE_PREFIX) if names is None else part in names)

        parts = self.parts(wanted=wanted)[1]
        map_ = self._map(parts)
        chosen = map_.cell_N.tolist() if cells is None else cells
        return map_, {cell: elite_from_arrays(parts[elite_part(cell)]) for cell in chosen}

    def _map(self, parts: Mapping[str, Mapping[str, np.ndarray]]) -> BehaviourMap:
        map_ = map_from_parts(parts)
        if map_ is None:
            raise NotInRunError(f"{self.folder} keeps no map; it was started with map.enabled = false", run=self.folder)
        return map_

    @property
    def descriptor_names(self) -> list[str]:
        """Of the descriptor's dimensions, in order."""
        return list(self.meta.task["descriptor_names"])

    @property
    def generation(self) -> int | None:
        """Newest committed generation; None before the first."""
        return reader.read_generation(self.folder)

    def digest(self) -> str:
        """SHA-256 over everything deterministic in the run."""
        return run_digest.digest(self.folder)

    @property
    def policy_shape(self) -> PolicyShape:
        """Layer widths of this run's policies."""
        task = self.meta.task
        return PolicyShape((task["observation_size"], *self.constants["policy.hidden"], task["action_size"]))

    def policy(self, which: Literal["best", "centre"] | int | Sequence[int] = "best") -> Policy:
        """The best centre so far, or a cell's elite, with the statistics it was evaluated with; or the newest centre
        with those it would go on with.

        Args:
            which: "best", "centre", or a cell by its place, such as (3, 17). Raises NotInRunError for an empty one.
        """
        if which == "centre":
            return self.newest_policy()[1]
        if which == "best":
            best = best_from_arrays(self.parts(wanted=lambda part: part == "best")[1]["best"])
            return self.policy_of(best.centre_D, best.observation_mean_O, best.observation_std_O)
        if isinstance(which, str):
            raise ValueError(f"policy({which!r}): choose 'best', 'centre', or a cell such as (3, 17)")
        elite = self.elite(which)
        return self.policy_of(elite.centre_D, elite.observation_mean_O, elite.observation_std_O)

    def policy_of(self, parameters_D: FloatArray, mean_O: FloatArray, std_O: FloatArray) -> Policy:
        """A policy of this run's shape."""
        return Policy(self.policy_shape, parameters_D, mean_O, std_O, self.constants["policy.observation_clip"])

    def newest_policy(self) -> tuple[int, Policy]:
        """(generation, the centre updated in it with the statistics that it would go on with)."""
        at, parts = self.parts(wanted=lambda part: not part.startswith((ELITE_PREFIX, CELL_PREFIX)))
        member = self.newest_member(at, parts)
        enabled = self.constants["policy.observation_normalization"]
        mean_O, std_O = statistics_in_force(moments_from_arrays(parts["observations"]), member, enabled)
        return at, self.policy_of(member.centre_D, mean_O, std_O)

    def newest_member(self, generation: int, parts: Mapping[str, Mapping[str, np.ndarray]]) -> Member:
        """The member that the history row of `generation` is about, `parts` being the state of that generation."""
        member = int(self.history_rows(generation)[0]["member"])
        return member_from_arrays(parts[member_part(member)])


def map_places(map_: BehaviourMap) -> NDArray[np.int64]:
    """Place of each filled cell along each dimension of the map, [N, dimensions]."""
    places = [map_.geometry.index_of(int(cell)) for cell in map_.cell_N]
    return np.array(places, np.int64).reshape(map_.size, len(map_.geometry.shape))


def nearest_filled(map_: BehaviourMap, place: Sequence[int]) -> tuple[int, ...] | None:
    """Place of the filled cell nearest to another place, counted in cells (of a cvt: numbers); the first of equals."""
    if not map_.size:
        return None
    return min(
        (map_.geometry.index_of(int(cell)) for cell in map_.cell_N),
        key=lambda other: sum((a - b) ** 2 for a, b in zip(other, place, strict=True)),
    )


def _whole(number: Any) -> int:
    """A whole number; pandas makes floats of them where it takes a row out of a table."""
    if int(number) != number:
        raise TypeError(f"{number!r} is no whole number")
    return int(number)


def _light(part: str) -> bool:
    return part == GEOMETRY_PART or part.startswith(CELL_PREFIX)


def open_run(folder: str | os.PathLike[str]) -> Run:
    """Open a run folder for reading.

    Raises:
        StoreError: not a run folder, or written by a newer version.
    """
    run = Run(Path(folder))
    _ = run.meta  # fail here, not at the first access
    return run
