"""What a generation would take on more cores than there are: costs measured on this machine, then a simulation."""

from __future__ import annotations

import pickle
import statistics
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np

from es_service.config.model import RunConfig
from es_service.config.search import PopulationConfig, SearchConfig
from es_service.config.tasks import task_of
from es_service.config.workload import chunks_of_phases, worker_spec
from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.dispatch.ray_engine import ray_engine
from es_service.dispatch.ray_nodes import actor_cores
from es_service.dispatch.simulation import NEVER_S, Costs, Phase, predict
from es_service.errors import ConfigError
from es_service.loop import driver
from es_service.loop.budget import REACHED
from es_service.loop.evaluated import policies_asked
from es_service.loop.generation import initial_state, with_archive
from es_service.loop.state import no_observations
from es_service.protocol.episodes import addressed, each, in_blocks
from es_service.protocol.machine import platform_text
from es_service.protocol.messages import (
    NO_CENTRE,
    Centre,
    ChunkResult,
    EpisodesResult,
    GradientChunk,
    TaskSpec,
    TrainingChunk,
    Work,
    WorkerSpec,
    evaluation_chunks,
)
from es_service.protocol.nearest import NOVELTY
from es_service.protocol.policies import ALL_TOGETHER, Policies, Recipes
from es_service.protocol.sent import Received
from es_service.runs.checked_config import columns
from es_service.runs.engine import dispatch_limits
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.base import Algorithm, Ask, CentreEvaluation, SearchState
from es_service.search.novelty import archive_of, extended
from es_service.store.create import Beginning
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore
from workers.actor import WorkerActor
from workers.compiling import Compilable
from workers.cores import parts
from workers.policy import initial_parameters
from workers.reports import Reports
from workers.worker import Made

MEASURE_S = 1.0
"""Time for the measurement of each kind of chunk."""
GENERATIONS = 12
"""Generations of the loop with replayed results; the first third does not count."""
PAST_ENTRIES = 5000
"""Entries of the novelty archive before the first of these generations."""
REPLAYED, SCATTER = 2048, 0.05
"""Different answers of each kind, and the standard deviation of an answer's descriptors as a share of their range."""
UNBOUNDED = 1e3
"""In the place of a bound of the descriptor that is larger."""
ECHO_ITEMS, ECHO_CHUNKS, SPIN_S = 100, 128, 0.003
"""Work items in each measurement of messages, chunks of an item for a node, and the time that the actor computes for
it: while it does so, the driver falls asleep, and being woken is a part of what a message costs."""


def bench_scaling(config: RunConfig, workers: Sequence[int], cores_per_node: int) -> Iterator[dict[str, Any]]:
    """Yield a row per number of workers: workers, seconds_per_generation, steps_per_second, efficiency, limit.

    Measured are the duration of each kind of chunk on one core, with the initial policies; a generation of the driver
    and the store with such results; and messages between the Ray engine and actors on this machine. A network makes
    messages slower. Actors have the cores that the config gives each, or all of a node.

    Raises:
        ConfigError: a number of workers is no multiple of `compute.worker_resources.cpu`. EvaluationError: Ray or the
            task cannot be used.
    """
    each = config.compute.worker_resources.cpu
    if each != "auto" and (uneven := [count for count in workers if count % each]):
        field = "compute.worker_resources.cpu"
        raise ConfigError(f"{field}: {each} cores each do not divide {uneven[0]} workers", field=field, value=each)
    search, spec, phases = config.search, worker_spec(config, task_of(config)), _phases(config)
    centres = _initial_centres(config, spec)
    works = [_work(phase, centres, spec, config) for phase in phases]
    initial = [(replace(centres[0], archive=None), chunk) for chunk in evaluation_chunks(1, search.evaluation_episodes)]
    chunk_s, answers = _chunk_costs(spec, [*works, initial], replace(dispatch_limits(config), workers=1))
    message_s, way_s, chunk_message_s = message_costs(spec, works, answers)
    costs = Costs(chunk_s, message_s, way_s, *_driver_cost(config, answers), chunk_message_s)
    steps = _steps(search, answers)
    for count in workers:
        cores = actor_cores([cores_per_node], count, None) if each == "auto" else each
        prediction = predict(phases, costs, count // cores, cores, partial(longest_part, cores=cores))
        yield {
            "workers": count,
            "seconds_per_generation": round(prediction.seconds, 6),
            "steps_per_second": round(steps / prediction.seconds),
            "efficiency": round(prediction.efficiency, 3),
            "limit": prediction.limit,
        }


def _initial_centres(config: RunConfig, spec: WorkerSpec) -> list[Centre]:
    """A centre for each population of a generation, with a novelty archive where workers need one."""
    search, zeros_O = config.search, np.zeros(spec.policy.widths[0], np.float32)
    parameters = initial_parameters(spec.policy, config.policy.init, config.seed, 0)
    parameters.setflags(write=False)  # as in a state: its name is computed once
    sigma = search.sigma if isinstance(search, PopulationConfig) else 0.0
    centres = [Centre(1, parameters, sigma, zeros_O, zeros_O + 1.0) for _ in range(max(1, search.populations()))]
    if not isinstance(search, PopulationConfig):
        return centres
    begun = _search(config)
    asks = [ask for ask in begun.algorithm.ask(initial_state(begun).search, 1) if isinstance(ask, Ask)]
    none_N = np.zeros(PAST_ENTRIES, np.int64)
    archive = archive_of(_past(np.random.default_rng(0), _bounds(begun.task)), none_N, none_N)
    return with_archive(centres, asks, archive, config.novelty)


def _bounds(task: TaskSpec) -> np.ndarray:
    return np.clip(task.descriptor_bounds, -UNBOUNDED, UNBOUNDED)


def _past(random: np.random.Generator, bounds_B_2: np.ndarray) -> np.ndarray:
    """Descriptors of earlier entries of the novelty archive."""
    return random.uniform(*bounds_B_2.T, size=(PAST_ENTRIES, len(bounds_B_2)))


def _phases(config: RunConfig) -> list[Phase]:
    if not isinstance(config.search, PopulationConfig):
        return [Phase(name, "PolicyChunk", chunks) for name, chunks in chunks_of_phases(config).items()]
    kinds = {"rollout": "TrainingChunk", "gradient": "GradientChunk", "evaluation": "EvaluationChunk"}
    return [Phase(name, kinds[name], chunks) for name, chunks in chunks_of_phases(config).items()]


def _work(phase: Phase, centres: Sequence[Centre], spec: WorkerSpec, config: RunConfig) -> list[Work]:
    """The chunks of a phase, in the order of the populations; of policies those that descend from the first ones."""
    if phase.kind == "PolicyChunk":
        search = _search(config)
        asked = search.algorithm.ask(initial_state(search).search, 1)
        return [
            subject_chunk
            for policies in policies_asked(config, search.task, 1, asked)
            for subject_chunk in policies.work
        ]
    ids = range(phase.chunks // len(centres))
    weights_P = np.ones(spec.gradient_block_pairs, np.float32)
    if phase.name == "gradient":
        return [(NO_CENTRE, GradientChunk(1, i, weights_P, ask)) for ask in range(len(centres)) for i in ids]
    if phase.name == "rollout":
        return [(centre, TrainingChunk(1, i, ask, ask)) for ask, centre in enumerate(centres) for i in ids]
    return [
        (replace(centre, parameters_D=centre.parameters_D.copy(), archive=None), chunk)
        for ask, centre in enumerate(centres)
        for chunk in evaluation_chunks(1, config.search.evaluation_episodes, ask=ask, request=ask)
    ]


def _steps(search: SearchConfig, answers: Mapping[str, ChunkResult]) -> float:
    if not isinstance(search, PopulationConfig):
        answer = answers["PolicyChunk"]
        assert isinstance(answer, EpisodesResult), "policies have episodes"
        return search.policies() * search.evaluation_episodes * float(answer.steps.mean())
    episodes = {
        "TrainingChunk": 2 * search.pairs,  # the steps of a member are those of all of its episodes
        "EvaluationChunk": search.evaluation_episodes,
    }
    each = [(answers[kind], count) for kind, count in episodes.items()]
    return search.populations() * sum(
        count * float(answer.steps.mean()) for answer, count in each if isinstance(answer, EpisodesResult)
    )


def longest_part(chunks: int, cores: int) -> float:
    """Number of chunks that the busiest core of an actor runs, when cores take the next part as they become free."""
    free = [0] * cores
    for part in parts(range(chunks), cores):
        free[free.index(min(free))] += len(part)
    return max(free)


def _kind(work: Work) -> str:
    return type(work[1]).__name__


def _chunk_costs(
    spec: WorkerSpec, works: Sequence[Sequence[Work]], limits: Limits
) -> tuple[dict[str, float], dict[str, ChunkResult]]:
    """(seconds of one core per chunk, a result) of each kind, from the chunks of each phase."""
    seconds: dict[str, float] = {}
    answers: dict[str, ChunkResult] = {}
    with inline_engine(spec, limits) as engine:
        for work in works:
            kind, (answer,) = _kind(work[0]), engine.evaluate(work[:1])  # which compiles
            answers[kind] = answer
            count, took_s = 1, 0.0
            while took_s < MEASURE_S:
                began = time.perf_counter()
                engine.evaluate(list(islice(cycle(work), count)))
                took_s = time.perf_counter() - began
                seconds[kind] = took_s / count
                count = 1 + int(1.2 * MEASURE_S / seconds[kind])
    return seconds, answers


@dataclass(frozen=True)
class _EchoSpec(WorkerSpec):
    answers: dict[str, ChunkResult] = field(default_factory=dict)
    """Answer of each kind of chunk."""


class EchoActor(WorkerActor):
    """A worker that computes for SPIN_S and gives each chunk the recorded answer of its kind."""

    def build(self, given: bytes | None = None) -> str:
        """As `WorkerActor.build`, without the code of a task."""
        spec: _EchoSpec = pickle.loads(given or self._spec)

        def echo(work: Sequence[Work]) -> list[ChunkResult]:
            until = time.perf_counter() + SPIN_S
            while time.perf_counter() < until:
                pass
            return [_for_chunk(spec.answers[_kind(one)], one) for one in work]

        self._joins = True  # as an actor with the cores of a node
        self._received, self._reports = Received(spec.parent_cache_bytes, Recipes.made), Reports(spec, self._cores)
        self._made = Made(Compilable(echo, lambda work: None), set())
        return platform_text({})


def message_costs(
    spec: WorkerSpec, works: Sequence[Sequence[Work]], answers: Mapping[str, ChunkResult]
) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """(seconds of the driver per work item of one chunk, seconds of an item's way to a worker, seconds of the driver
    for each further chunk) through Ray, by kind of chunk."""
    message_s: dict[str, float] = {}
    way_s: dict[str, float] = {}
    chunk_message_s: dict[str, float] = {}
    echo = _EchoSpec(**vars(spec), answers=dict(answers))
    with ray_engine(echo, Limits(1, item_s=0.0), actor=EchoActor) as engine:
        for work in (chunks[0] for chunks in works):
            engine.evaluate([work] * ECHO_ITEMS)
            began = time.process_time()  # also of Ray's threads in this process, but not while it waits
            engine.evaluate([work] * ECHO_ITEMS)
            message_s[_kind(work)] = driver_s = (time.process_time() - began) / ECHO_ITEMS
            alone_s = []
            for _ in range(ECHO_ITEMS):
                began = time.perf_counter()
                engine.evaluate([work])
                alone_s.append(time.perf_counter() - began)
            way_s[_kind(work)] = max(0.0, (statistics.median(alone_s) - SPIN_S - driver_s) / 2)
    with ray_engine(echo, Limits(1, item_s=NEVER_S, policies_together=ALL_TOGETHER), actor=EchoActor) as engine:
        for work in works:
            item = list(islice(cycle(work), ECHO_CHUNKS))
            for _ in range(2):  # from now on it is known how long a chunk takes, and all of them are one item
                engine.evaluate(item)
            began = time.process_time()
            for _ in range(ECHO_ITEMS):
                engine.evaluate(item)
            more_s = (time.process_time() - began) / ECHO_ITEMS - message_s[_kind(work[0])]
            chunk_message_s[_kind(work[0])] = max(0.0, more_s / (ECHO_CHUNKS - 1))
    return message_s, way_s, chunk_message_s


def _for_chunk(answer: ChunkResult, work: Work) -> ChunkResult:
    """The recorded answer for a chunk that may have fewer episodes, and traces only of first ones."""
    if not isinstance(answer, EpisodesResult):
        return answer
    row_N = addressed(work, answer).row_N
    assert row_N is not None
    (subject, _), trace_T_B = work, answer.trace_T_B
    if isinstance(subject, Policies) and trace_T_B is not None:
        trace_T_B = trace_T_B[: int((row_N % subject.episodes == 0).sum())]
    cut = each(lambda array: array[: len(row_N)], answer, traces=False)
    outputs = {name: array for name, array in cut.outputs.items() if name != NOVELTY}
    if isinstance(subject, Centre) and subject.archive is not None:
        outputs[NOVELTY] = cut.fitness.astype(np.float64)
    return addressed(work, replace(cut, moments=answer.moments, trace_T_B=trace_T_B, outputs=outputs))


def _moved(answer: ChunkResult, random: np.random.Generator, bounds_B_2: np.ndarray) -> ChunkResult:
    """The result with its descriptors somewhere within the bounds."""
    if not isinstance(answer, EpisodesResult):
        return answer
    low_B, high_B = bounds_B_2.T
    scatter = random.normal(scale=SCATTER * (high_B - low_B), size=answer.descriptor.shape)
    return replace(answer, descriptor=np.float32(np.clip(random.uniform(low_B, high_B) + scatter, low_B, high_B)))


def _with_past(algorithm: Algorithm, descriptor_N_B: np.ndarray) -> Algorithm:
    """The algorithm, with these entries in the novelty archive after generation 0."""

    def tell(state: SearchState, told: Sequence[CentreEvaluation]) -> SearchState:
        state = algorithm.tell(state, told)
        if told[0].generation == 0:
            archive = state.archive
            for centre, descriptor_B in enumerate(descriptor_N_B, len(state.centres)):
                archive = extended(archive, descriptor_B, 0, centre)
            state = replace(state, archive=archive)
        return state

    return replace(algorithm, tell=tell)


def _search(config: RunConfig) -> driver.Search:
    """The search of a run that begins with random centres."""
    task = task_of(config)
    shape = worker_spec(config, task).policy
    centres = [initial_parameters(shape, config.policy.init, config.seed, i) for i in range(config.search.centres)]
    return driver.Search(
        config=config,
        algorithm=ALGORITHMS[config.search.algorithm](config),
        initial=lambda: (centres, no_observations(task.observation_size)),
        task=task,
    )


def _driver_cost(config: RunConfig, answers: Mapping[str, ChunkResult]) -> tuple[float, float]:
    """Seconds of a generation in which only the driver works, and those that it and the store need beside rollouts."""
    budget = config.budget.model_copy(update={**dict.fromkeys(REACHED), "generations": GENERATIONS})
    config = config.model_copy(update={"budget": budget})
    search = _search(config)
    task = search.task
    random, bounds_B_2 = np.random.default_rng(0), _bounds(task)
    if isinstance(config.search, PopulationConfig):  # with policies, only the first ones enter the archive
        search = replace(search, algorithm=_with_past(search.algorithm, _past(random, bounds_B_2)))
    history, evaluations = columns(config, task)
    meta = RunMeta(
        run_id=f"{0:032x}",
        created="2025-01-01T00:00:00+00:00",
        config=config.model_dump(mode="json"),
        given=dict(config.made.given),
        constants=config.constants(),
        task=asdict(task),
        columns=history,
        evaluation_columns=evaluations,
    )
    # The novelty of equal descriptors takes many times longer. They are therefore those of a search that has been
    # everywhere: a place for each answer, and a scatter around it.
    replayed = {
        kind: cycle([_moved(answer, random, bounds_B_2) for _ in range(REPLAYED)]) for kind, answer in answers.items()
    }
    driver_s = beside_s = 0.0
    times: list[tuple[float, float]] = []

    with (
        tempfile.TemporaryDirectory() as folder,
        RunStore.create(Path(folder) / "run", config.resolved_yaml(), meta, Beginning()) as store,
    ):
        session = driver.run(search, store, None, lambda _: times.append((driver_s, beside_s)))
        results: Any = None
        with suppress(StopIteration):
            while True:
                began = time.perf_counter()
                work = session.send(results)
                assert isinstance(work, Sequence)
                sent = time.perf_counter()
                driver_s += sent - began
                next(session)
                beside_s += time.perf_counter() - sent
                answered = [_for_chunk(next(replayed[_kind(subject_chunk)]), subject_chunk) for subject_chunk in work]
                results = in_blocks(answered)
    driver_s, beside_s = map(float, np.median(np.diff(times, axis=0)[GENERATIONS // 3 :], axis=0))
    return driver_s, beside_s
