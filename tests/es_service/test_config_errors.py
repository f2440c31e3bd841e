"""Everything wrong with a config is said at once, each with the field, the value, what is allowed and the way out."""

from __future__ import annotations

import pickle
import sqlite3
from contextlib import closing, nullcontext
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from es_service.config.model import RunConfig
from es_service.config.rules import MOST_DESCRIPTOR_DIMENSIONS
from es_service.errors import ConfigError
from es_service.loop.history import history_columns
from es_service.protocol.messages import TaskSpec
from es_service.search.algorithms import OURS
from es_service.store.schema import table_statements
from tests.es_service.config_examples import MINIMAL, MINIMAL_TEXT, POINT_MAZE, WORDS, load_config
from tests.es_service.store_examples import without_root_rights
from workers.rollouts import BACKENDS

NO_FINAL = TaskSpec("no_final", 2, 2, 50, ("x",), ((0.0, 1.0),), final_fitness=False, has_goal=False)
TASKS = {"point_maze": POINT_MAZE, "no_final": NO_FINAL}


def load(source=MINIMAL, *overrides: str) -> RunConfig:
    return load_config(source, overrides, tasks=TASKS, algorithms={"es": OURS["es"]}, rollouts=BACKENDS)


def problems(source=MINIMAL, *overrides: str) -> list[str]:
    """The lines of the error, without its heading and indentation."""
    with pytest.raises(ConfigError) as caught:
        load(source, *overrides)
    heading, *lines = str(caught.value).splitlines()
    assert heading.endswith(f": {len(lines)} problem" + "s" * (len(lines) > 1))
    return [line.strip() for line in lines]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("search.pairs='512'", "'512' ... must be a whole number from 1 to 16,777,216; remove the quotes"),
        ("search.pairs=512.5", "512.5 ... must be a whole number from 1 to 16,777,216"),
        ("search.pairs=0", "0 ... must be a whole number from 1 to 16,777,216"),
        ("search.pairs=1_000_000_000_000", "1000000000000 ... must be a whole number from 1 to 16,777,216"),
        ("search.pairs=true", "true ... must be a whole number"),
        ("search.pairs=null", "null ... must be a whole number from 1 to 16,777,216; leave the key out"),
        ("budget.env_steps=1e6", "1000000.0 ... must be a whole number, at least 1 or null; write 1000000"),
        ("seed=true", "true ... must be a whole number, at least 0 and below 2**63"),
        ("seed=-1", "-1 ... must be a whole number, at least 0 and below 2**63"),
        ("seed=9223372036854775808", "9223372036854775808 ... must be"),
        ("search.sigma=0", "0 ... must be a number above 0"),
        ("compute.no_worker_timeout_s=1", "1 ... must be a number, at least 20"),
        ("store.keep_every=0", "0 ... must be a whole number, at least 1 or null"),
        ("search.sigma=.nan", ".nan ... must be a number above 0"),
        ("search.sigma=1e999", ".inf is not allowed"),
        ("search.sigma=true", "true is not allowed"),
        ("search.sigma='1e-3'", "'1e-3' ... must be a number above 0; remove the quotes around 1e-3"),
        ("search.init_from=''","'' ... must be text"),
        ("search.step.l2=-1", "-1 ... must be a number, at least 0"),
        ("search.max_invalid_fraction=1.5", "1.5 ... must be a number from 0 to 1"),
        ("search.preset=litrature", "litrature ... must be literature or uber; did you mean literature?"),
        ("search.algorithm=ess", "ess is not a known algorithm; must be es, or module:function; did you mean es?"),
        ("task.environment=pointmaze", "pointmaze is not a known task; must be point_maze or no_final, or brax:NAME"),
        ("task.episode_steps=auto", "auto ... must be null or a whole number, at least 1"),
        ("task.fitness=finl", "finl ... must be sum or final; did you mean final?"),
        ("task.options.start=cornr", "cornr ... must be default or corner; did you mean corner?"),
        ("task.options.start=3", "3 ... must be default or corner"),
        ("task.options.start=off", "off ... must be default or corner"),
        ("task.options.start=[3]", "[3] ... must be default or corner"),
        ("task.options.strat=corner", "unknown option; point_maze has start; did you mean start?"),
        ("policy.hidden=64", "64 ... must be a list of whole numbers, each at least 1, such as [64, 64]"),
        ("policy.hidden=[64, 0]", "[64, 0] is not allowed"),
        ("policy.observation_normalization=1", "1 ... must be true or false"),
        ("policy.activation=rely", "rely ... must be tanh or relu; did you mean relu?"),
        ("policy.observation_clip=0", "0 ... must be a number above 0 or null"),
        ("compute.engine=rey", "rey ... must be auto or ray or inline; did you mean ray?"),
        ("compute.rollout=sind", "sind ... must be auto or xla or simd; did you mean simd?"),
        ("compute.workers=0", "0 ... must be auto or a whole number, at least 1"),
        ("compute.chunk_pairs=half", "half ... must be auto or a whole number"),
        ("policy.hidden=[10000000000, 10000000000]", "[10000000000, 10000000000] makes more than 80,000,000 para"),
        ("policy.hidden=[8950, 8950]", "[8950, 8950] makes more than 80,000,000 parameters for point_maze, which"),
        ("search.init_from=/etc/passwd", "/etc/passwd is a file; must be the folder of another run, with :best"),
        ("search.init_from=/etc/passwd/run", "/etc/passwd/run does not exist; must be the folder of another run"),
        ("search.init_from=/" + 300 * "a", f"/{300 * 'a'} cannot be accessed (File name too long); must be the"),
        ('search.init_from="/a\\0b"', "/a\0b cannot be accessed ("),
        ("search.init_from=/no/such/run", "/no/such/run does not exist; must be the folder of another run"),
        ("map.kind=gird", "gird ... must be auto or grid, cvt or dominated; did you mean grid?"),
        ("map.bounds=3", "3 ... must be auto or a list of pairs [low, high], such as [[-1, 1], [-1, 1]]"),
        ("map.bounds=[[0, 1], [0, .inf]]", "[[0, 1], [0, .inf]] is not allowed"),
        ("map.bounds=[[0, 1], [a, 1]]", "[[0, 1], [a, 1]] is not allowed"),
        ("map.bounds=[[0, 1], [1]]", "[[0, 1], [1]] is not allowed"),
        ("map.bounds=[[0, 1]]", "[[0, 1]] has 1 pairs, but the descriptor has 2 dimensions (x, y); must be a list of"),
        ("map.bounds=[[0, 1], [3, -2]]", "[3, -2] for y ... must be [low, high] with low below high; did you mean"),
        ("map.bounds=[[-1e308, 1e308], [0, 1]]", "[[-1.0e+308, 1.0e+308], [0, 1]] ... must be within 1e+30 of 0"),
        ("map.qd_offset=-1e308", "-1.0e+308 ... must be within 1e+30 of 0"),
        ("map.cells=[20]", "[20] has 1 numbers; must be 2 numbers, one for each of x, y, or auto"),
        ("map.cells=[20, 0]", "[20, 0] ... must be auto or a list of whole numbers, each at least 1"),
        ("map.cells=[]", "[] ... must be auto or a list of whole numbers"),
        ("map.cells=20", "[20] has 1 numbers; must be 2 numbers, one for each of x, y, or auto"),
        ("map.cells=0", "0 ... must be auto or a list of whole numbers, each at least 1, such as [20, 20], or one"),
        ("map.cells=true", "true ... must be auto or a list of whole numbers"),
        ("map.cells=[2.5, 3]", "[2.5, 3] is not allowed"),
        ("map.cells=[9999, 9999]", "[9999, 9999] makes 99,980,001 cells; must be at most 10,000,000; with many dim"),
        ("map.qd_offset=low", "low ... must be auto or a number"),
        ("compute.rollout_block_pairs=24", "24 does not divide compute.chunk_pairs (64); try 16 or 32"),
        ("compute.gradient_block_pairs=513", "513 is more than search.pairs (512); try 512"),
    ],
)  # fmt: skip
def test_a_bad_value_is_one_line_with_field_value_and_what_is_allowed(override, message):
    """`...` in the table stands for "is not allowed;"."""
    (line,) = problems(MINIMAL, override)
    assert line.startswith(f"{override.split('=')[0]}: {message.replace('...', 'is not allowed;')}")


@pytest.mark.parametrize("overrides", [["search.pairs=1"], ["search.shaping.kind=top_pairs", "search.shaping.count=1"]])
def test_halves_of_one_pair_are_refused(overrides):
    (line,) = problems(MINIMAL, "search.step_gate=true", *overrides)
    assert ": 1 pair has no halves, so that search.step_gate would allow no step; try 2" in line


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("search.algorithm=ES", "did you mean es?"),
        ("task.environment=Point_Maze", "did you mean point_maze?"),
        ("task.environment=CartPole-v1", "did you mean gymnasium:CartPole-v1?"),
        ("search.sgima=1", "search.sgima: unknown key; did you mean search.sigma?"),
        ("serach.sigma=1", "did you mean search.sigma?"),
        ("sigma=1", "sigma: unknown key; did you mean search.sigma?"),
        ("search.hidden=[4]", "did you mean policy.hidden?"),
        ("seeed=3", "did you mean seed?"),
        ("search.population=5", "search.population: unknown key; did you mean search.pairs?"),
        ("popsize=5", "did you mean search.pairs?"),
        ("lr=0.1", "did you mean search.step.learning_rate?"),
        ("search.std=0.1", "did you mean search.sigma?"),
        ("task.option=5", "unknown key; task has options, environment, episode_steps, fitness, episodes_per_member"),
        ("task.options.start.x=3", "task.options.start.x: unknown key"),
        ("qqq.zzz=3", "unknown key; the sections are task, policy, search, novelty, map, budget, compute"),
        ("budget.qqq=3", "unknown key; budget has generations, env_steps, wall_clock_s, rollout_s, cpu_s, target_"),
        ("search.sigma", "override search.sigma: write KEY=VALUE, such as search.sigma=0.05"),
        ("=3", "override =3: write KEY=VALUE"),
        ("search.init_from=", "override search.init_from=: the value is missing; write null"),
        ("search=3", "search: this is a section; set its keys one by one, such as search.algorithm=..."),
        ("task.options=3", "task.options: this is a section; set its keys one by one, such as task.options.NAME=..."),
        ("policy.hidden=[64,", "override policy.hidden=[64,: line 1, column 5: not YAML"),
        ("compute.chunk_pairs=48", "512 is not a multiple of compute.chunk_pairs (48); try pairs = 528 (or 480)"),
        ("compute.chunk_pairs=600", "512 is not a multiple of compute.chunk_pairs (600); try pairs = 600, or"),
        ("budget.generations=1.5e300", "1.5e+300 is not allowed; must be a whole number, at least 1"),
        ("compute.worker_resources.gpu=1.5", "gpu: 1.5 is not allowed; must be a whole number or a fraction below 1"),
        ("compute.worker_resources.gpus=1", "did you mean compute.worker_resources.gpu?"),
        ("compute.worker_resources=1", "is a section; set its keys one by one, such as compute.worker_resources.cpu="),
        ("budget.generations=null", "budget: this run has no limit; set at least one of budget.generations, bud"),
    ],
)  # fmt: skip
def test_a_problem_elsewhere_is_one_line_with_a_hint(override, message):
    (line,) = problems(MINIMAL, override)
    assert message in line
    assert len(line) < 400


def test_a_run_to_start_from_in_a_folder_that_may_not_be_looked_into(tmp_path):
    (tmp_path / "locked").mkdir(mode=0)
    with without_root_rights():
        (line,) = problems(MINIMAL, f"search.init_from={tmp_path}/locked/run")
    assert "cannot be accessed (Permission denied); must be the folder of another run, with :best" in line


def test_a_cluster_without_ray_is_refused():
    assert problems(MINIMAL, "compute.engine=inline", "compute.address=auto") == [
        "compute.address: auto needs compute.engine = ray, but the engine is inline",
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MINIMAL_TEXT + "weather: {rain: 10}\n", "weather: unknown key; the top level has task, policy, search"),
        (MINIMAL_TEXT + "polcy: {hidden: [3]}\n", "polcy: unknown key; did you mean policy?"),
        (MINIMAL_TEXT + "policy:\n", "policy: null is not a mapping of keys; indent its keys below `policy:`, or"),
        (MINIMAL_TEXT + "compute: 3\n", "compute: 3 is not a mapping of keys"),
        (MINIMAL_TEXT + "seed: 1\nseed: 2\n", 'line 5, column 1: found duplicate key "seed" with value "2"'),
        (MINIMAL_TEXT + "policy.hidden: [3]\n", "policy.hidden: a key in a file has no dots; write hidden"),
        (MINIMAL_TEXT.replace("algorithm: es", "preset: uber"), "search.algorithm: missing; must be es, or module:"),
        (MINIMAL_TEXT.partition("\n")[2], "environment: missing; must be point_maze or no_final, or brax:NAME, mu"),
        (MINIMAL_TEXT.replace("es}", "es, sigma: 1, sigma: 2}"), 'found duplicate key "sigma" with value "2" (o'),
        (MINIMAL_TEXT.replace("maze}", "maze, options: }"), "task.options: null is not a mapping of keys"),
        ("- 1\n", "the top level is [1]; write sections such as `task:`"),
        ("", "the file is empty"),
        ("# nothing\n", "the file is empty"),
        ("task: a: b\n", "line 1, column 8: not YAML: mapping values are not allowed here: task: a: b"),
        ("task:\n\tx: 1\n", "line 2, column 1: not YAML: while scanning for the next token found character '\\t'"),
        ("task: [1,\nsearch: 2\n", "not YAML: while parsing a flow sequence"),
        ("task: !!python/name:os.system\n", "line 1, column 7: not YAML: could not determine a constructor"),
        ("task: 1\n---\ntask: 2\n", "expected a single document"),
        ("task: \x01\n", "line 1: not YAML: character code 1 is not allowed"),
        ("task: !!bool maybe\n", "line 1, column 7: not YAML: this is no !!bool: task: !!bool maybe"),
        ("a:\n  - !!int foo\n", "line 2, column 5: not YAML: this is no !!int"),
        ("task: !!float ''\n", "line 1, column 7: not YAML: this is no !!float"),
        ("task: !!int 1.5\n", "line 1, column 7: not YAML: this is no !!int"),
        ("seed: " + "9" * 5000, "line 1, column 7: not YAML: this is no !!int"),
        ("[" * 500, "nested too deeply"),
        (b"task: \xff\n", "not a text file: byte 6 is not UTF-8"),
    ],
)  # fmt: skip
def test_file_problems_say_where_and_what(file, text, message):
    path = file(text)
    (line,) = problems(path)
    assert message in line
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: 1 problem\n")


def test_missing_file_and_directory(tmp_path):
    assert problems(tmp_path / "none.yaml") == ["no such file"]
    assert problems(tmp_path) == ["this is a directory; name a YAML file"]


def test_a_list_that_contains_itself_is_refused_and_a_merge_key_is_no_repetition(file):
    (line,) = problems(file(MINIMAL_TEXT + "policy: {hidden: &a [*a]}\n"))
    assert line.startswith("policy.hidden: [[...]] is not")
    merged = "task: {environment: point_maze}\nsearch: &s {algorithm: es}\nbudget: {generations: 3}\n"
    (line,) = problems(file(merged + "policy: {<<: *s, hidden: [3]}\n"))
    assert line == "policy.algorithm: unknown key; did you mean search.algorithm?"


def test_final_fitness_only_where_the_task_declares_it():
    (line,) = problems(MINIMAL, "task.environment=no_final", "task.fitness=final")
    assert line.startswith("task.fitness: final is not allowed for no_final")
    (line,) = problems(MINIMAL, "task.environment=no_final", "task.options.start=corner")
    assert line == "task.options.start: unknown option; no_final has none"


def test_everything_at_once_and_no_echoes(file):
    """Sections are checked against each other where they can be, and a bad value is reported once, as itself."""
    text = """\
task: {environment: nowhere, options: {start: 3}}
policy: {hidden: big}
search: {algorithm: es, sgima: 0.1, preset: nobody}
compute: {chunk_pairs: 64, rollout_block_pairs: 24, gradient_block_pairs: lots}
seed: true
"""
    lines = problems(file(text), "search.pairs=500", "budgt.generations=3")
    fields = [line.split(":")[0] for line in lines]
    assert sorted(fields) == sorted(
        [
            "search.sgima",
            "budgt.generations",
            "policy.hidden",
            "search.preset",
            "compute.gradient_block_pairs",
            "seed",
            "task.environment",
            "search.pairs",
            "compute.rollout_block_pairs",
            "budget",
        ]
    )
    assert next(line for line in lines if line.startswith("search.pairs")) == (
        "search.pairs: 500 is not a multiple of compute.chunk_pairs (64); try pairs = 512 (or 448), "
        "or compute.chunk_pairs = auto"
    )


@pytest.mark.parametrize("section", ["task", "search", "budget", "compute", "policy"])
def test_an_unusable_section_is_one_problem(section):
    (line,) = problems({**MINIMAL, "compute": {"chunk_pairs": 64}, section: None})
    assert line.startswith(f"{section}: null is not a mapping of keys")


@settings(deadline=None, max_examples=150)
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | WORDS,
        lambda inner: st.lists(inner, max_size=2) | st.dictionaries(WORDS, inner, max_size=2),
        max_leaves=4,
    ),
    st.sampled_from(sorted({*load().constants(), "budget.generations", "compute.workers", "task.options", "search"})),
)
def test_any_value_anywhere_loads_or_is_a_config_error_that_names_the_field(value, name):
    source: dict = {section: dict(MINIMAL.get(section, {})) for section in ("task", "search", "budget")}
    *path, leaf = name.split(".")
    target = source
    for group in path:
        target = target.setdefault(group, {})
    target[leaf] = value
    message = ""
    try:
        load(source)
    except ConfigError as error:
        message = str(error)
    assert all(len(line) < 400 for line in message.splitlines())
    assert not message or name in message


def test_config_errors_survive_pickling():
    with pytest.raises(ConfigError) as caught:
        load(MINIMAL, "search.sgima=1")
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_a_map_that_does_not_fit_the_algorithm_or_its_kind_is_refused():
    assert problems(MINIMAL, "map.kind=cvt", "map.cells=[20, 20]") == [
        "map.cells: [20, 20] has 2 numbers; must be one number for a cvt, or auto"
    ]
    (line,) = problems(MINIMAL, "map.kind=cvt", "map.cells=[5000]")
    assert line == "map.cells: [5000] makes 5,000 cells; must be at most 4,096 for a cvt"
    assert problems(MINIMAL, "map.centroids=kmeans") == [
        "map.centroids: kmeans has no effect with map.kind = grid; leave it out (a key of kind cvt)"
    ]


def test_what_would_take_too_long_or_be_too_wide_is_refused_with_the_number():
    def wide(dimensions):
        names = tuple(f"x{index}" for index in range(dimensions))
        return replace(POINT_MAZE, descriptor_names=names, descriptor_bounds=((-1.0, 1.0),) * dimensions)

    def found(dimensions, *overrides):
        try:
            known = {"tasks": {"point_maze": wide(dimensions)}, "algorithms": OURS, "rollouts": BACKENDS}
            load_config(MINIMAL, overrides, **known)
        except ConfigError as error:
            return [problem.sentence for problem in error.problems]
        return []

    assert found(1000, "map.enabled=false") == [
        "task.environment: the descriptor of point_maze has 1,000 dimensions; a run can store at most 973, since its "
        "history has two columns for each"
    ]
    assert (
        found(973, "map.enabled=false")
        == found(973, "map.kind=cvt")
        == found(7, "map.cells=[4096]", "map.kind=cvt")
        == []
    )
    assert found(973, "map.cells=[4096]") == [
        "map.cells: placing 4,096 centroids in 973 dimensions would take about 1797 s; must be at most 2,366, or "
        "map.centroids = kmeans, which is faster"
    ]
    assert found(973, "map.cells=[2366]") == found(973, "map.cells=[4096]", "map.centroids=kmeans") == []
    assert found(100, "map.centroids=kmeans", "map.kind=grid", "map.cells=[2]")[-1].startswith(
        "map.centroids: kmeans has"
    )


def test_the_history_of_the_widest_descriptor_fits_into_a_table():
    names = tuple(f"x{index}" for index in range(MOST_DESCRIPTOR_DIMENSIONS))
    columns = history_columns(replace(POINT_MAZE, descriptor_names=names), True, True, True)
    more = (*columns, *(replace(columns[-1], name=f"y{index}") for index in range(2)))
    for wanted, outcome in (columns, nullcontext()), (more, pytest.raises(sqlite3.Error, match="too many columns")):
        with closing(sqlite3.connect(":memory:")) as connection, outcome:
            connection.execute(table_statements(wanted)["history"])
    with pytest.raises(ConfigError) as caught:
        load_config(
            MINIMAL,
            ["search.algorithm=me_es", "map.enabled=false"],
            tasks=TASKS,
            algorithms={"me_es": OURS["me_es"]},
            rollouts=BACKENDS,
        )
    (line,) = (line.strip() for line in str(caught.value).splitlines()[1:])
    assert line.startswith("map.enabled: false is not allowed for me_es, whose blocks start from elites of the map")


def test_outputs_that_are_no_numbers_have_no_action_noise():
    assert load(MINIMAL, "policy.output=categorical").policy.action_noise == 0.0
    assert load(MINIMAL, "policy.output=linear").policy.action_noise == 0.01
    (line,) = problems(MINIMAL, "policy.output=gaussian", "policy.action_noise=0.1")
    assert line.startswith("policy.action_noise: 0.1 is not allowed for policy.output = gaussian, which")
    assert line.endswith("must be 0")


def test_a_memory_has_its_rollout_and_the_reason_for_it():
    assert load(MINIMAL, "policy.memory=4").compute.rollout == "xla"
    (line,) = problems(MINIMAL, "policy.memory=4", "compute.rollout=simd")
    assert line == (
        "compute.rollout: simd cannot run point_maze: its code of a policy has no memory (policy.memory); must be auto "
        "or xla"
    )
