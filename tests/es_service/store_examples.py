"""A small run whose every generation is known: what the tests of the run store write and expect to read back."""

import contextlib
import json
import math
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np

from es_service.config.model import COMPUTE_CONSTANTS
from es_service.loop.history import NO_INTEGER, Column
from es_service.loop.state import Generation
from es_service.protocol.content import NO_NAME, name_of, names, names_in
from es_service.store import upkeep as store_upkeep
from es_service.store.codec import decode_part
from es_service.store.digest import digest_of, digest_parts
from es_service.store.facts import Damaged
from es_service.store.folder import DATABASE
from es_service.store.reader import read_evaluations, read_history, read_parts, reading
from es_service.store.states import sound_content
from es_service.store.verify import verify
from es_service.store.writer import RunMeta, RunStore, no_hook
from workers.environments import SHIPPED

CONFIG_YAML = "seed: 0\n"
COLUMNS = (
    Column("generation", "INTEGER", True, ""),
    Column("env_steps", "INTEGER", True, ""),
    Column("centre_fitness_mean", "REAL", True, ""),
    Column("goal_distance", "REAL", True, ""),
    Column("seconds_rollout", "REAL", False, ""),
)
EVALUATION_COLUMNS = (
    Column("centre", "INTEGER", True, ""),
    Column("cell", "INTEGER", True, ""),
    Column("fitness_mean", "REAL", True, ""),
    Column("fitness_first", "REAL", False, ""),
)
CENTRES = 3
CONFIG = {
    **{"policy": {}, "search": {}, "budget": {}, "task": {"fitness": "sum"}},
    "compute": dict.fromkeys(COMPUTE_CONSTANTS, 16),
}
CONSTANTS = {
    **{"seed": 0, "task.environment": "point_maze", "task.episode_steps": 200, "search.algorithm": "es"},
    **{"policy.hidden": [4], "policy.observation_clip": None, "policy.observation_normalization": False},
    **{"map.enabled": False, "compute.rollout": "simd", "search.pairs": 8},
}
"""What every run says of itself."""


def meta(**changes):
    fields = {
        "run_id": f"{1:032x}",
        "created": "2025-01-01T00:00:00+00:00",
        "config": CONFIG,
        "constants": CONSTANTS,
        "task": json.loads(json.dumps(asdict(SHIPPED["point_maze"]))),
        "columns": COLUMNS,
        "evaluation_columns": EVALUATION_COLUMNS,
        "parent": None,
    }
    return RunMeta(**{**fields, **changes})


def parts_of(generation, seed=0):
    """The parts that this generation changes: the statistics, one centre of three (all of them at first), the names of
    the policies of three cells, and of the best one every fourth generation, and a guest that comes with generations 1,
    5, 9, ... and goes with 3, 7, ...; None for a part that goes."""
    centres = range(CENTRES) if generation == 0 else [generation * 7 % 5 % CENTRES]
    parts = {f"centre_{centre}": _centre(seed, generation, centre) for centre in centres}
    parts["observations"] = {
        "count": np.asarray(100.0 * generation),
        "mean_O": np.random.default_rng([seed, generation, 99]).standard_normal(5),
        "steps": np.asarray(generation, np.int64),
    }
    newest = [max((at for at in range(generation + 1) if at % 3 == cell), default=None) for cell in range(3)]
    parts["map"] = {"policy_N": names(NO_NAME if at is None else name_of(policy(at, seed)) for at in newest)}
    if generation % 4 == 0:
        parts["best"] = {"policy": names([name_of(policy(generation, seed))])[0]}
    if generation % 2:
        parts["guest"] = {"x": np.full(9, generation)} if generation % 4 == 1 else None
    return parts


def policy(generation, seed=0):
    """The policy that a generation adds; of seven, so that one that nothing names any more comes back."""
    values = np.random.default_rng([seed, generation * 5 % 7, 77]).standard_normal(40)
    return {"parameters_D": values.astype(np.float32)}


OTHER = {"parameters_D": np.arange(40, dtype=np.float32)}
"""A policy that no state names, but a certification may."""


def certified(*contents):
    """A certification of policies: their rows, and the policies by name."""
    rows = [({}, {"policy": names([name_of(content)]).reshape(())}) for content in contents]
    return rows, {name_of(content): content for content in contents}


def contents_of(generation, seed=0):
    """What a generation's parts name, as far as they are new."""
    content = policy(generation, seed)
    return {name_of(content): content}


def _centre(seed, generation, centre):
    rng = np.random.default_rng([seed, generation, centre])
    return {
        "centre_D": rng.standard_normal(150).astype(np.float32),
        "adam_m_D": rng.standard_normal(150).astype(np.float32),
        "step": np.asarray(generation, np.int64),
    }


def state_at(generation, seed=0):
    """Every part as of `generation`."""
    state = {}
    for at in range(generation + 1):
        state.update(parts_of(at, seed))
    return {name: part for name, part in state.items() if part is not None}


def named_at(generation):
    """The contents that the state of a generation names."""
    names_N = frozenset().union(*map(names_in, state_at(generation).values()))
    contents = {name: content for at in range(generation + 1) for name, content in contents_of(at).items()}
    return {name: contents[name] for name in names_N}


def history_row(generation):
    return {
        "generation": generation,
        "env_steps": generation * 3_000_000_000,
        "centre_fitness_mean": -math.inf if generation == 1 else 1.0 / (generation + 3),
        "goal_distance": math.nan if generation % 2 else float(generation),
        "seconds_rollout": 0.25 + generation,
    }


def evaluated(generation):
    """The centres that this generation evaluates: all of them at first, then one or two."""
    centres = range(CENTRES) if generation == 0 else range(1 + generation % 2)
    return [
        {
            "centre": centre,
            "cell": math.nan if centre else generation,
            "fitness_mean": generation + centre / 7,
            "fitness_first": generation + centre / 3,
        }
        for centre in centres
    ]


def as_table(columns, rows):
    """Rows as columns; None or NaN stands for no value."""
    kinds = {"INTEGER": (np.int64, NO_INTEGER), "REAL": (np.float64, math.nan)}
    table = {}
    for column in columns if rows else ():
        kind, none = kinds[column.type]
        values = [row[column.name] for row in rows]
        table[column.name] = np.array([none if value is None or value != value else value for value in values], kind)
    return table


def evaluated_table(generation):
    return as_table(EVALUATION_COLUMNS, evaluated(generation))


def create(folder, *, seed=0, generations=0, hook=no_hook, run_meta=None, together=1):
    store = RunStore.create(Path(folder), CONFIG_YAML, run_meta or meta(), hook=hook)
    advance(store, generations - 1, seed=seed, together=together)
    return store


def generation_of(number, seed=0):
    """What is stored of a generation."""
    parts, contents = parts_of(number, seed), contents_of(number, seed)
    return Generation(number, parts, history_row(number), evaluated_table(number), contents)


def advance(store, last, *, seed=0, together=1):
    """Commit generations up to and including `last`, so many in a transaction."""
    first = 0 if store.generation is None else store.generation + 1
    for begin in range(first, last + 1, together):
        store.commit([generation_of(at, seed) for at in range(begin, min(begin + together, last + 1))])


def finished(folder, generations, seed=0):
    """A run that ended cleanly."""
    create(folder, seed=seed, generations=generations).close()
    return Path(folder)


def copy_at_every_commit(monkeypatch):
    """Refresh the verified copy with every generation, as a run of many minutes would now and then."""
    monkeypatch.setattr(store_upkeep, "LOCAL_COPY_INTERVAL_S", 0.0)
    monkeypatch.setattr(store_upkeep, "COPY_TIME_FRACTION", math.inf)


def assert_same_state(found, expected):
    assert found.keys() == expected.keys()
    for part in expected:
        assert found[part].keys() == expected[part].keys()
        for name, array in expected[part].items():
            assert found[part][name].dtype == array.dtype
            assert found[part][name].shape == array.shape
            assert found[part][name].tobytes() == array.tobytes(), (part, name)


def assert_policies(folder, generation):
    """The policies that this generation's state names are there, and all that are there are named."""
    expected = {name: content for at in range(7) for name, content in contents_of(at).items()} | {name_of(OTHER): OTHER}
    with reading(folder) as (connection, _):
        stored = {name for (name,) in connection.execute("SELECT name FROM content")}
        payloads = connection.execute("SELECT payload FROM state UNION ALL SELECT payload FROM certification")
        rows = [decode_part(payload) for (payload,) in payloads if payload]
        assert named_at(generation).keys() <= stored == frozenset().union(*map(names_in, rows))
        for name in stored:
            assert_same_state({"": sound_content(connection, name)}, {"": expected[name]})


def assert_same_history(found, generations):
    assert len(found) == generations
    for generation, row in enumerate(found):
        assert_same_row(row, history_row(generation))


def assert_same_evaluations(found, generations):
    assert len(found) == generations
    for generation, rows in enumerate(found):
        for row, expected in zip(rows, evaluated(generation), strict=True):
            assert_same_row(row, expected)


def assert_same_row(row, expected):
    assert row.keys() == expected.keys()
    for name, value in expected.items():
        assert type(row[name]) is type(value)
        assert row[name] == value or (math.isnan(value) and math.isnan(row[name]))


def flip_bit(file, position, bit=0):
    content = bytearray(Path(file).read_bytes())
    content[position] ^= 1 << bit
    Path(file).write_bytes(content)


def position_of(file, content):
    """Where `content` stands in the file; it must stand there once."""
    data = Path(file).read_bytes()
    assert data.count(content) == 1
    return data.index(content)


def stored_bytes(folder):
    """Content of all files but the shared memory of the log, which readers rebuild."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if not path.name.endswith("-shm")}


def assert_sound(folder, generation):
    """The run opens with exactly this generation and nothing to report; reading it before that gave the same."""
    before = stored_bytes(folder)
    assert_same_history(read_history(folder), generation + 1)
    assert_same_evaluations(read_evaluations(folder), generation + 1)
    if generation >= 0:
        assert_same_state(read_parts(folder)[1], state_at(generation))
        assert_policies(folder, generation)
    assert stored_bytes(folder) == before
    with RunStore.open(folder) as run:
        assert run.notices == []
        assert run.generation == (None if generation < 0 else generation)
        assert_same_state(run.load(), state_at(generation))


@contextlib.contextmanager
def without_root_rights():
    """Root may write anywhere; as nobody, permissions count."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def verify_run(folder: Path) -> list[str]:
    """What is wrong with anything stored."""
    with reading(folder) as (connection, _):
        try:
            return list(verify(connection, folder / DATABASE).problems)
        except Damaged as damage:
            return [str(damage)]


def digest(folder):
    """The digest of what the tables contain, without the checks of `checked_parts`."""
    return digest_of(digest_parts(folder))
