"""The Python interface: start, resume and fork runs, and evaluate policies of your own."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any

from es_service.config.given import Overrides, Source, parse_overrides
from es_service.config.model import RunConfig
from es_service.errors import WayOut
from es_service.loop.state import Observer as Observer
from es_service.loop.state import Stop as Stop
from es_service.protocol.episodes import OverlappedRequests
from es_service.protocol.machine import given_path
from es_service.report.progress import in_notebook, show_in_notebook
from es_service.runs import view
from es_service.runs.checked_config import changed_config, load_config
from es_service.runs.evaluator import evaluator as evaluator
from es_service.runs.lineage import fork_config, forked, started
from es_service.runs.session import OnGeneration, OnNotice, Outcome, show_notice
from es_service.runs.sessions import Listener, continue_run, create_run, outcome_of
from es_service.runs.view import Run, open_run
from es_service.store.create import Beginning
from es_service.store.folder import CONFIG, holds_run
from es_service.store.writer import RunStore, no_hook

RUNS_FOLDER = Path("runs")
"""Default parent folder of runs, relative to the current folder."""


def _draw_for_notebook(run: Run) -> str:
    from es_service.report.write import run_html  # takes time that other programs need not spend

    return run_html(run)


view.draw_for_notebook = _draw_for_notebook


def _ignore(sentence: str) -> None:
    """Do nothing; the default for `on_compile` and `on_output`."""


def _listener(
    on_generation: OnGeneration | None,
    on_notice: OnNotice,
    on_compile: OnNotice,
    progress: bool,
    on_output: OnNotice,
    hook: Callable[[str], None] = no_hook,
) -> Listener:
    """What a session calls: with each history row `on_generation`, or if there is none, what shows the progress in a
    notebook."""

    @contextmanager
    def shown(folder: Path) -> Iterator[OnGeneration]:
        if on_generation is not None:
            yield on_generation
        elif progress and in_notebook():
            with show_in_notebook(str(folder)) as show:
                yield Observer(show)
        else:
            yield Observer(lambda row: None)

    return Listener(shown, on_notice, on_compile, on_output, hook)


def run(
    config: RunConfig | Source,
    out: str | os.PathLike[str] | None = None,
    *,
    on_generation: OnGeneration | None = None,
    on_notice: OnNotice = show_notice,
    progress: bool = True,
    on_compile: OnNotice = _ignore,
    on_output: OnNotice = _ignore,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Start a run and continue it until its budget is spent.

    Args:
        config: a RunConfig, or what `load_config` accepts.
        out: folder of the run, new or empty, which is created with its parents; default
            runs/<environment>_<algorithm>_seed<seed>_<time>-<process>.
        on_generation: called with the history row of each generation after it is committed, or while another program
            holds the database, after it has begun to wait for that. If it returns `Stop("reason")`, the run ends there
            with this reason, and can be resumed. A mapping from names to numbers that it returns, or
            `Stop("reason", {...})`, records these as `metric_NAME` of the generation: columns of the history, curves,
            metrics of trackers, and measures of comparisons. Other values have no effect. Each generation is then
            committed by itself; not with `Observer(function)`, which only looks (`store.commit_interval_s`).
        on_notice: called with each notice for the user; by default, each is printed as a line on stderr.
        progress: whether a notebook shows the progress of the run, if there is no `on_generation`. Other programs print
            nothing.
        on_compile: called with a sentence when workers compile, or make environments, for more than two seconds.
        on_output: called with the lines that workers print, their simulators included, such as "worker 3: a limit was
            reached"; of what is printed fast, only with the newest.
        hook: called with the name of each point of the store that is passed; for tests that kill the process there.

    Raises:
        ConfigError: the config is wrong. StoreError: the folder cannot be used. EvaluationError: the rollouts cannot
            continue. Interrupted: SIGINT or SIGTERM arrived. Committed generations are safe in every case.
    """
    named = os.fspath(config) if isinstance(config, str | os.PathLike) else None
    if not isinstance(config, RunConfig):
        config = load_config(config)
    listener = _listener(on_generation, on_notice, on_compile, progress, on_output, hook)
    return outcome_of(_begin(config, out, named, listener))


def _begin(
    config: RunConfig, out: str | os.PathLike[str] | None, named: str | None, listener: Listener
) -> OverlappedRequests[Outcome]:
    """Start a run whose config was loaded from a file of this name."""
    again = WayOut("run", "", config=named, out=_text(out))
    parent, beginning = None, Beginning()
    if config.search.init_from is not None:
        parent, beginning = started(config, config.search.init_from, listener.on_notice)
    return create_run(config, _folder(out, config), parent, beginning, again, listener)


def resume(
    folder: str | os.PathLike[str],
    overrides: Overrides = (),
    *,
    strict: bool = False,
    on_generation: OnGeneration | None = None,
    on_notice: OnNotice = show_notice,
    progress: bool = True,
    on_compile: OnNotice = _ignore,
    on_output: OnNotice = _ignore,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Continue a run from its last committed generation; its result has the same bits as without an interruption.

    Args:
        overrides: only budget, engine, workers and time limits may change; the run's `config.yaml` records the change.
        strict: whether to refuse to continue with other code, other packages or another kind of processor than those
            that computed the newest generation. If not, this is a notice, and the digest is marked `mixed`.

    Raises:
        ConfigError: a constant of the run would change (all are listed), or `strict` is set and something has changed.
            Otherwise as `run`.
    """

    def changed(store: RunStore) -> RunConfig:
        # The whole file, unlike `Run.present_config`: a constant that was edited there must be refused, not ignored.
        recorded = store.folder / CONFIG
        source = recorded if recorded.exists() else store.meta.config
        return changed_config(source, overrides, given=store.meta.given)

    overrides, asked = _with_values(overrides)
    listener = _listener(on_generation, on_notice, on_compile, progress, on_output, hook)
    return outcome_of(continue_run(given_path(folder), changed, listener, asked, strict=strict))


def run_or_resume(
    config: RunConfig | Source,
    out: str | os.PathLike[str],
    *,
    on_generation: OnGeneration | None = None,
    on_notice: OnNotice = show_notice,
    progress: bool = True,
    on_compile: OnNotice = _ignore,
    on_output: OnNotice = _ignore,
) -> Outcome:
    """Start a run, or resume it if the folder already holds it; the same call can be repeated after any interruption.

    Raises:
        ConfigError: the folder's run has other constants than `config` (all are listed). Otherwise as `run`.
    """
    return outcome_of(
        begin_or_resume(config, out, _listener(on_generation, on_notice, on_compile, progress, on_output))
    )


def begin_or_resume(
    config: RunConfig | Source, out: str | os.PathLike[str], listener: Listener
) -> OverlappedRequests[Outcome]:
    """The session of `run_or_resume`, and of `ask_tell`."""
    folder = given_path(out)
    begun = holds_run(folder)
    wanted = config if isinstance(config, RunConfig) else load_config(config, new=not begun)
    return continue_run(folder, lambda store: wanted, listener) if begun else _begin(wanted, out, None, listener)


def fork(
    parent: str | os.PathLike[str],
    overrides: Overrides = (),
    *,
    generation: int | None = None,
    out: str | os.PathLike[str] | None = None,
    on_generation: OnGeneration | None = None,
    on_notice: OnNotice = show_notice,
    progress: bool = True,
    on_compile: OnNotice = _ignore,
    on_output: OnNotice = _ignore,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Start a new run from another run's state, with changed settings.

    The new run copies the history and continues the numbering of generations, so a fork without changes ends with the
    same bits as its parent. If a setting changes the meaning of an evaluation (the task, or how observations are
    normalised), all past fitness is discarded: the best centre, nsra_es's record and the map start again; the weight
    of fitness is kept. A fork may change between ns_es, nsr_es and nsra_es; its weight of fitness then starts again.
    me_es derives its blocks from the generation's number alone, so changes of `search.block_generations`, `mode`,
    `first_block` and `alternation` take effect at once, also in the middle of a block.

    Args:
        generation: one whose state the parent keeps: one of its last two, or of `store.keep_every`; None: the newest.

    Raises:
        ConfigError: the state does not fit a change (another task, descriptor, network, algorithm or map), or a key
            would have no effect. StoreError: the generation is not kept. Otherwise as `run`.
    """
    overrides, asked = _with_values(overrides)
    generation = None if generation is None else int(generation)  # of NumPy, from a table
    again = WayOut("fork", "", os.fspath(parent), asked, generation=generation, out=_text(out))
    config = fork_config(parent, overrides)
    lineage, beginning = forked(open_run(parent), config, generation)
    listener = _listener(on_generation, on_notice, on_compile, progress, on_output, hook)
    outcome = outcome_of(create_run(config, _folder(out, config), lineage, beginning, again, listener))
    if outcome.run.generation == (begun := lineage["generation"]):
        on_notice(
            f"no generation was run: {outcome.reason} already at generation {begun}, where this fork begins; resume it "
            "with a larger budget"
        )
    return outcome


def _with_values(overrides: Overrides) -> tuple[Overrides, dict[str, Any]]:
    """The overrides, which may be an iterator, and their values by key as far as they are valid."""
    overrides = overrides if isinstance(overrides, str | Mapping) else tuple(overrides)
    return overrides, parse_overrides(overrides)[0]


def _text(path: str | os.PathLike[str] | None) -> str | None:
    return None if path is None else os.fspath(path)


_NAMED: set[Path] = set()
"""Folders that this process has named for runs that may not have begun yet; threads may name one at the same time."""
_NAMING = threading.Lock()


def _folder(out: str | os.PathLike[str] | None, config: RunConfig) -> Path:
    return default_folder(config) if out is None else given_path(out)


def default_folder(config: RunConfig, which: str = "") -> Path:
    """A new folder under `runs/`, named after task, algorithm, `which` or the seed, time and process id, so that runs
    that start at the same time get different folders. Colons and slashes in names become underscores: scp and others
    read HOST:PATH, and runs are found in this folder only.
    """
    when = datetime.now().strftime("%Y%m%d-%H%M%S")
    kind = f"{config.task.environment}_{config.search.algorithm}".translate(str.maketrans(":/", "__"))
    name = f"{kind}_{which or f'seed{config.seed}'}_{when}-{os.getpid()}"
    folders = (RUNS_FOLDER / (name if number == 1 else f"{name}-{number}") for number in count(1))
    with _NAMING:
        folder = next(folder for folder in folders if folder not in _NAMED and not folder.exists())
        _NAMED.add(folder)
    return folder
