"""Computing generations of a run again on this machine, from the states that the run keeps, and comparing the bits;
so the episodes of its certifications; and whether its task repeats itself: equal seeds and actions have equal results,
bit for bit, wherever it runs.

Every generation has in its history the SHA-256 of its whole state, so a recomputed generation can be judged even if its
state is not kept: a kept state is only needed as a beginning.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from es_service.config.model import RunConfig
from es_service.config.tasks import task_of
from es_service.errors import ConfigError, NotInRunError, WayOut
from es_service.loop import driver
from es_service.loop.budget import Clock
from es_service.loop.contents import StatePolicies
from es_service.loop.finished import Finished, reachable_in, rows
from es_service.loop.generation import initial_state
from es_service.loop.history import HistoryRow, Table
from es_service.protocol.child import NoAnswerError, answer_of
from es_service.protocol.content import Arrays
from es_service.protocol.episodes import Evaluator, completed
from es_service.protocol.machine import CODE, platform_info
from es_service.protocol.user_code import RaisedError
from es_service.runs.certification import platform_of, workers_for
from es_service.runs.certified import Certified, Elsewhere, all_certifications, arrays_of
from es_service.runs.checked_config import changes_since, code_of
from es_service.runs.engine import engine_here
from es_service.runs.evaluation import evaluation_config
from es_service.runs.other_task import stored_task
from es_service.runs.selection import StoredEpisodes, new_episodes
from es_service.runs.session import initial_centres, initial_statistics
from es_service.runs.view import Run
from es_service.search.algorithms import ALGORITHMS
from es_service.store import reader
from es_service.store.codec import changed_sum, encode_changes, rows_listed, state_sha256, state_sum, stored_values
from es_service.store.lock import require_unlocked
from es_service.store.rows import StoredRow, table_bytes
from es_service.store.states import KeptRows, rows_in_force
from workers.environments import settings_of_description


@dataclass(frozen=True)
class RecomputedCertification:
    """A stored certification or decision whose episodes were run again."""

    policy: Certified
    differences: tuple[str, ...]
    """Names of the results that differ."""
    changes: list[str]
    """What has changed in packages, processor and code since it was made, in words."""
    not_judged: str = ""
    """Why nothing can be said of the episodes in another task; empty if it can, or if there are none."""


@dataclass(frozen=True)
class Recomputed:
    """Neighbouring generations that were computed again, up to the first that differs."""

    first: int
    last: int
    differences: tuple[str, ...]
    """What differs in generation `last`, in words; empty if all of these generations are equal."""
    changes: tuple[str, ...]
    """Differences in platform and code between what computed `last` in the run and what computed it now, in words. They
    may, but need not, cause other bits."""


def verify(
    run: Run, generations: int = 1, workers: int | None = None, on_output: Callable[[str], None] = lambda line: None
) -> Iterator[Recomputed]:
    """Compute generations of a run again on this machine and compare them with what is stored, bit for bit.

    The run is only read. Each kept state is a beginning, and so is the start of the run, unless it is a fork.

    Args:
        generations: number of generations to compute from each beginning, at most up to the next one. With the number
            of all generations, the whole run is computed again.
        workers: number of worker processes; None: one per core.
        on_output: called with the lines that workers print; see `api.run`.

    Raises:
        RunLockedError: a driver is writing to the run, and so deletes states. This is raised at once, all others later.
        NotInRunError: the run has no generation that can be computed again.
        EvaluationError: the rollouts cannot continue.
        Interrupted: SIGINT or SIGTERM arrived.
    """
    require_unlocked(run.folder)
    return _verify(run, generations, workers, on_output)


def _verify(run: Run, generations: int, workers: int | None, on_output: Callable[[str], None]) -> Iterator[Recomputed]:
    config = evaluation_config(run, workers)
    task, code, platforms = task_of(config), code_of(config), reader.read_platforms(run.folder)
    plan = _plan(run, generations)
    search = driver.Search(
        config=config,
        algorithm=ALGORITHMS[config.search.algorithm](config),
        initial=lambda: initial_centres(config, reader.read_start(run.folder)),
        task=task,
        statistics=lambda: initial_statistics(reader.read_start(run.folder)),
    )
    with engine_here(config, on_output=on_output) as engine:
        for begin, last in plan:
            reached, differences = _recompute(run, search, engine, begin, last)
            then = next((platform for first, platform in reversed(platforms) if first <= reached), {})
            now = {**platform_info(), CODE: code}
            yield Recomputed(0 if begin is None else begin + 1, reached, differences, tuple(changes_since(then, now)))


def _plan(run: Run, generations: int) -> list[tuple[int | None, int]]:
    """(beginning, last generation) of each part of the run to compute; None stands for the start of the run."""
    newest = run.generation
    parent = run.meta.parent
    begins: list[int | None] = [*reader.read_kept(run.folder)[1]]
    if parent is None or reader.read_start(run.folder) is not None:
        begins.insert(0, None)
    if newest is None or begins in ([], [newest]):
        raise NotInRunError(
            f"{run.folder} has no generation that can be computed again from a state that it keeps",
            run=run.folder,
            ways_out=[WayOut("resume", "compute more generations", str(run.folder))],
        )
    ends = [*(at for at in begins[1:] if at is not None), newest]
    lasts = [min(end, (-1 if begin is None else begin) + generations) for begin, end in zip(begins, ends, strict=True)]
    return [(begin, last) for begin, last in zip(begins, lasts, strict=True) if begin is None or last > begin]


def _recompute(
    run: Run, search: driver.Search, evaluator: Evaluator, begin: int | None, last: int
) -> tuple[int, tuple[str, ...]]:
    """The generation that was reached, and what differs in it."""
    stored = _Comparison(run, begin)
    state = driver.stored_state(stored) or initial_state(search)
    policies, clock, reachable = StatePolicies(stored.content), Clock(0.0), reachable_in(search, state)
    while True:
        requests = driver.generation(search, policies, clock, state)
        finished = completed(requests, evaluator.evaluate)
        state = finished.state
        differences = stored.compared(finished, *rows(search, finished, reachable))
        if differences or state.generation == last:
            return state.generation, tuple(differences)


class _Comparison:
    """The state of a run at the beginning and what has been computed since, compared with what the run has stored."""

    def __init__(self, run: Run, begin: int | None) -> None:
        self.generation = begin
        self._run = run
        self._stored, self._whole = reader.read_kept(run.folder)
        self._in_force = {} if begin is None else rows_in_force(self._stored, begin)
        self._sum = state_sum(self._in_force)
        self._contents: dict[bytes, Arrays] = {}

    def load(self) -> Mapping[str, Arrays]:
        return self._run.at(self.generation).nodes

    def newest_history(self, count: int) -> list[HistoryRow]:
        """None, since time is not compared."""
        return []

    def content(self, name: bytes) -> Arrays:
        """A policy or a trace: as it was computed, or else as it was at the beginning."""
        if (computed := self._contents.get(name)) is not None:
            return computed
        return self._run.at(self.generation, [], lambda snapshot: [name]).contents[name]

    def compared(self, finished: Finished, history: HistoryRow, evaluations: Table) -> list[str]:
        """What differs in a generation, in words, which is the next one from now on."""
        generation = finished.state.generation
        new = rows_listed(encode_changes(generation, finished.parts))
        old = {part: self._in_force[part] for part in new if part in self._in_force}
        self._sum = changed_sum(self._sum, old, new)
        self._in_force |= new
        self._contents |= finished.contents
        stored = reader.read_row(self._run.folder, generation)
        differences = _history_differences(self._run, stored, history)
        if table_bytes(self._run.meta.evaluation_columns, evaluations) != stored.evaluations:
            differences.append("the evaluated centres")
        if state_sha256(self._sum) != stored.state:
            differences += _state_differences(self._stored, generation in self._whole, generation, new) or ["the state"]
        return differences


def _history_differences(run: Run, stored: StoredRow, computed: HistoryRow) -> list[str]:
    """Deterministic columns of the history that differ, with both values."""
    columns = run.meta.columns
    values = stored_values(columns, {**computed, "generation": stored.generation})
    return [
        f"{column.name} is {_shown(new)} instead of {_shown(old)}"
        for column, old, new in zip(columns, stored.row, values, strict=True)
        if column.deterministic and old != new
    ]


def _shown(value: float | None) -> str:
    return "missing" if value is None else repr(value)


def _state_differences(
    stored: KeptRows, is_whole: bool, generation: int, computed: Mapping[str, tuple[int, str]]
) -> list[str]:
    """Parts of the state that differ, as far as the run still has those of this generation."""
    at_generation = {part: rows[generation] for part, rows in stored.items() if generation in rows}
    here = {part: sha256 for part, (_, sha256) in computed.items()}
    names = sorted({*at_generation, *(here if is_whole else ())})
    return [f"state/{name}" for name in names if here.get(name) != at_generation.get(name)]


def recomputed_certifications(
    run: Run, workers: int | None = None, on_output: Callable[[str], None] = lambda line: None
) -> Iterator[RecomputedCertification]:
    """The stored certifications and decisions with what comes of their episodes on this machine now; first those in the
    run's task alone."""
    certified = all_certifications(run.folder)
    if not certified:
        return
    config = evaluation_config(run, workers)
    if alone := [policy for policy in certified if policy.elsewhere is None]:
        with workers_for(config, on_output=on_output) as engine:
            for policy in alone:
                changes = changes_since(policy.platform, platform_of(config))
                yield RecomputedCertification(policy, _differing(engine, config, policy, policy.episodes), changes)
    for policy in certified:
        if policy.elsewhere is not None:
            yield _recomputed_elsewhere(config, policy, policy.elsewhere, on_output)


def _recomputed_elsewhere(
    config: RunConfig, policy: Certified, elsewhere: Elsewhere, on_output: Callable[[str], None]
) -> RecomputedCertification:
    """What comes of the episodes of a policy in the run's task and in another one."""
    with workers_for(config, on_output=on_output, compared=True) as engine:
        differences = _differing(engine, config, policy, policy.episodes)
    task, other, there, why = elsewhere.task, None, (), ""
    try:
        other = stored_task(config, elsewhere)
        with workers_for(other.config, on_output=on_output, compared=True) as engine:
            there = _differing(engine, config, policy, elsewhere.episodes)
        if there and (where := why_task_does_not_repeat(other.config)):
            why = f"{task} does not repeat itself: with the same seed it returns other numbers {where}"
    except ConfigError as error:  # such as a package that is missing here
        why = f"the episodes in {task} cannot be run again: {error.sentence}"
    differences += () if why else tuple(f"{name} in {task}" for name in there)
    return RecomputedCertification(policy, differences, changes_since(policy.platform, platform_of(config, other)), why)


def _differing(engine: Evaluator, config: RunConfig, policy: Certified, then: StoredEpisodes) -> tuple[str, ...]:
    """Names of the results that differ from stored ones if the episodes of a certified policy are run again."""
    seed, domain = policy.resets(config.seed)
    [episodes] = new_episodes(engine, [policy.policy], then.count, seed, policy.number, 0, domain)
    before, again = arrays_of(then), arrays_of(episodes)
    return tuple(name for name in before if name not in again or before[name].tobytes() != again[name].tobytes())


ALONE = "alone"
"""Name of the first episode among the hashes of `workers.describe`."""
LONGEST_S = 600.0
"""Longest time of each of the two processes; functions may take long."""


def examined(name: str, settings: Mapping[str, Any], seconds: float) -> dict[str, Any]:
    """What `workers.describe` finds of a task of Python objects or a function in a process of its own.

    Args:
        settings: see `settings_of_description`.
        seconds: duration of its measurement.
    """
    try:
        return answer_of("workers.describe:examiner", name, settings, request=(seconds,), limit_s=LONGEST_S)
    except RaisedError as error:
        return {"problem": error.message}
    except NoAnswerError as error:
        return {"problem": f"it could not be examined: its process {error}", "is_lost": True}


def compared(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """(where a task was tried again, where it has not repeated itself) by two results of `examined`."""
    same = {**first["hashes"], "in another process": second["hashes"][ALONE]}
    tried = [where for where in same if where != ALONE]
    return tried, [where for where in tried if same[where] != same[ALONE]]


def why_not_repeatable(run: Run, config: RunConfig) -> str:
    """Where the task of a run does not repeat itself, in words: as the run has recorded, or else as examined now.

    Empty if it repeats itself, as far as can be found, and for tasks in JAX.
    """
    return run.task.does_not_repeat or why_task_does_not_repeat(config)


def why_task_does_not_repeat(config: RunConfig) -> str:
    """As `why_not_repeatable`, for the task of a config as it is examined now."""
    task = task_of(config)
    if task.kind not in ("python", "function"):
        return ""
    options = config.task.options
    settings = settings_of_description(config.task.environment, options, config.task.choices) | {"options": options}
    answers = [examined(config.task.environment, settings, 0.0) for _ in range(2)]
    if any("problem" in answer for answer in answers):
        return ""
    return " and ".join(compared(*answers)[1])
