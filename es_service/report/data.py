"""What a report shows of a run, read once from its store: columns of numbers, the map, and the paths of its elites.

Axes: G generations, N evaluated centres, T points of a path, B descriptor dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.errors import StoreError
from es_service.loop.blocks import BEST, MAP, joined, value_of
from es_service.loop.forms import problem
from es_service.loop.history import evaluated_nouns
from es_service.protocol.content import Arrays, as_bytes
from es_service.protocol.machine import is_mixed
from es_service.protocol.messages import TaskSpec
from es_service.report.measures import as_compared, with_derived
from es_service.report.series import IN_EVERY_RUN, HistoryColumns
from es_service.runs.certified import Certified, certified_elsewhere, certified_over_time, newest_certified
from es_service.runs.run_status import RunStatus, group_of, status_at
from es_service.runs.snapshot import sizes_of, sound_meta, stored_task
from es_service.runs.view import Run
from es_service.search.maps.behaviour_map import BehaviourMap
from es_service.store.lock import lock_holder
from es_service.store.schema import RunMeta
from es_service.store.sound import Followed, SoundRun, read_sound

TRACE = "trace_T_B"


@dataclass(frozen=True)
class RunData:
    """A run as of one generation, without its policies."""

    folder: Path
    meta: RunMeta
    task: TaskSpec
    history: HistoryColumns
    """Columns of the history, [G], and those of certifications; a damaged row is left out."""
    centres: HistoryColumns
    """Columns of the evaluated centres, [N], in the order of the asks: `generation`, and those of the run."""
    map: BehaviourMap | None
    """None if the run has no map, or if it cannot be read."""
    paths: Mapping[int, NDArray[np.float32]]
    """Number of a cell -> descriptor along the first evaluation episode of its elite, [T, B]."""
    best: tuple[int, float] | None
    """Generation and fitness of the best centre; None before the first generation."""
    certified: Certified | None
    """The policy that the newest certification has put first; None if there is none, or if it cannot be read."""
    certified_elsewhere: Mapping[str, Certified]
    """What `certified_elsewhere` returns; empty if it cannot be read."""
    status: RunStatus
    platforms: list[tuple[int, dict[str, Any]]]
    """(first generation, platform); each applies until the next one."""
    digest: str
    """The digest; empty if it cannot be computed, or while a driver is writing."""
    problems: tuple[str, ...]
    """What is damaged, one sentence each."""
    group: str = ""
    """Name of the group to which its sweep counts it; empty if there is none."""
    bounds_of_fitness: tuple[float, float] | None = None
    """Fitness that counts as 0 and as 1, if its columns are such shares; see `compare.normalised`."""
    best_parameters: Mapping[str, float] = field(default_factory=dict)
    """Parameters of the best centre by name, if the task is a function of them."""

    @property
    def constants(self) -> Mapping[str, Any]:
        """Settings that cannot change in the run: dotted key -> value."""
        return self.meta.constants

    @property
    def name(self) -> str:
        return self.folder.absolute().name

    @property
    def mixed(self) -> bool:
        """Whether generations were computed on several platforms."""
        return is_mixed(platform for _, platform in self.platforms)

    @property
    def names(self) -> tuple[str, ...]:
        return self.task.descriptor_names

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        """(low, high) of each descriptor dimension: those of the map, or those of the task if there is no map."""
        return self.map.geometry.bounds if self.map is not None else self.task.descriptor_bounds

    def last(self, column: str) -> float:
        """Newest value of a history column, for a metric the newest that was recorded; NaN if there is none."""
        if column not in self.history or not self.history[column].size:
            return float("nan")
        return float(as_compared(self.history, column)[-1])

    @property
    def evaluated(self) -> tuple[str, str]:
        """What the newest generation has evaluated, centres or policies, in the singular and in the plural."""
        return evaluated_nouns({name: self.last(name) for name in ("generation", "update_norm")})

    def cell_name(self, cell: int) -> str:
        """A cell as users write it: its place along each dimension, such as 3,17, or its number in a cvt map."""
        assert self.map is not None
        return ",".join(map(str, self.map.geometry.index_of(cell)))


def read_run(folder: Path, *, paths: bool = True, digest: bool = True) -> RunData:
    """Read a run; one transaction, so that a driver that is writing does not change it meanwhile.

    Args:
        paths: whether to read the paths of the elites, for which all of the map's policies must be read once.
        digest: whether to check all data and compute the digest.

    Raises:
        StoreError: `folder` is not a run folder, or nothing of the run can be read.
    """

    driver = lock_holder(folder)  # read before the history, so that the last row is not missed
    sound = read_sound(folder, _kept, partial(_named, paths=paths))
    data = run_data(folder, sound, driver)
    if not digest or driver is not None or sound.newest is None:
        return data
    try:
        return replace(data, digest=data.status.run.digest())
    except StoreError as error:
        return replace(data, problems=data.problems or (error.sentence,))


def run_data(folder: Path, found: SoundRun, driver: Mapping[str, Any] | None) -> RunData:
    """The data of a run that was read before; `driver`: what `lock_holder` said before that.

    Raises StoreError if the history lacks what every run writes.
    """
    problems = list(found.problems)
    run = Run(folder)
    run.__dict__["meta"] = sound_meta(folder, found.meta)  # it is cached there, and `run.db` itself may be damaged
    history = _floats(found.history)
    if lacking := [column for column in IN_EVERY_RUN if not np.isfinite(history[column]).all()]:
        raise StoreError(f"{folder} is not what es-service writes: a generation has no {lacking[0]}", run=folder)
    best, task = found.parts.get(BEST), stored_task(found.meta)
    certified, elsewhere, over_time = _certified(folder, problems)
    spec, content = task.parameters, {} if best is None else found.contents.get(best["policy"].tobytes(), {})
    point_D = content.get("parameters_D")
    return RunData(
        folder=folder,
        meta=found.meta,
        task=task,
        history=with_derived(history, over_time, found.meta.constants["task.fitness"]),
        centres=_floats(found.evaluations),
        map=_map(found, problems),
        paths=_paths(found),
        best=None if best is None else (int(best["generation"]), float(best["fitness"])),
        certified=certified,
        certified_elsewhere=elsewhere,
        status=status_at(run, driver, found.newest),
        platforms=found.platforms,
        digest="",
        problems=tuple(problems),
        group=group_of(folder.absolute()),
        best_parameters={} if spec is None or point_D is None else spec.named(point_D),
    )


def _kept(meta: RunMeta, part: str, arrays: Arrays) -> Arrays | None:
    if found := problem(part, arrays, sizes_of(meta)):
        raise ValueError(found)
    return arrays if _is_shown(part) else None


def _is_shown(part: str) -> bool:
    return part == BEST or part.startswith(MAP)


def _named(meta: RunMeta, parts: dict[str, Arrays], *, paths: bool) -> list[bytes]:
    """Names of the point of a function, and with `paths` of those of the elites."""
    best, has_point = parts.get(BEST), stored_task(meta).parameters is not None
    traces = [name for block in parts.values() if "trace_N" in block for name in as_bytes(block["trace_N"])]
    return [*([best["policy"].tobytes()] if best is not None and has_point else []), *(traces if paths else [])]


def followed(folder: Path) -> Followed:
    """A run that is read again and again for `run_data`, without paths: no elite is read."""
    return Followed(folder, _kept, _is_shown, partial(_named, paths=False))


def _floats(columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[np.float64]]:
    """Columns as floats, in which NaN stands for no value; `columns` is emptied, so that a long history is in memory
    once."""
    return {name: np.ma.filled(columns.pop(name).astype(np.float64, copy=False), np.nan) for name in list(columns)}


def _map(sound: SoundRun, problems: list[str]) -> BehaviourMap | None:
    map_ = value_of(BehaviourMap | None, joined(sound.parts), MAP)
    if map_ is None and sound.meta.constants.get("map.enabled") and sound.generation is not None:
        problems.append("the behaviour map cannot be shown, because its geometry is damaged")
    return map_


def _paths(sound: SoundRun) -> dict[int, NDArray[np.float32]]:
    traces = {
        int(cell): sound.contents.get(name)
        for block in sound.parts.values()
        if "trace_N" in block
        for cell, name in zip(block["cell_N"], as_bytes(block["trace_N"]), strict=True)
    }
    return {cell: trace[TRACE] for cell, trace in traces.items() if trace is not None}


def _certified(
    folder: Path, problems: list[str]
) -> tuple[Certified | None, Mapping[str, Certified], list[dict[str, Any]]]:
    """The certified policy, those in other tasks, and a row of each certification."""
    try:
        return newest_certified(folder), certified_elsewhere(folder), certified_over_time(folder)
    except StoreError as error:
        if error.sentence not in problems:
            problems.append(error.sentence)
        return None, {}, []
