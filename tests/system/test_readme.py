"""The guides: their commands and code are run in order, as a reader would; their tables, links and names are held
against the code and the files."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from es_service import ask_tell
from es_service.cli.main import app
from es_service.search.algorithms import OURS
from tests.system import warm

ROOT = Path(__file__).parents[2]
USING = "es_service/guides/using.md"
TUTORIAL = "es_service/guides/tutorial.md"
BUDGET_S = {
    "README.md": 400,
    USING: 600,
    "es_service/guides/certify.md": 100,
    "configs/README.md": 100,
    "configs/which_method.md": 10,
    "configs/methods.md": 100,
    "configs/parts.md": 10,
    "configs/keys.md": 10,
    "configs/sweeps.md": 100,
    "configs/own_searches.md": 200,
    "configs/other_libraries.md": 100,
    "docker/README.md": 10,
    "es_service/README.md": 100,
    "workers/README.md": 100,
    "workers/own_tasks.md": 200,
    "workers/other_suites.md": 100,
    "workers/policies.md": 100,
    "tests/README.md": 10,
    "tests/benchmarks/README.md": 10,
    "tests/benchmarks/speed.md": 300,
    "tests/benchmarks/tried.md": 10,
    "CONTRIBUTING.md": 10,
}
"""Guide -> seconds that all its commands may take together, several times what they take on two idle cores."""
LOOKED_AT = (
    *(*BUDGET_S, TUTORIAL, "CHANGELOG.md", "workers/simd/README.md"),
    *(f"tests/benchmarks/{folder}/README.md" for folder in ("baselines", "gpu")),
)
"""Guides whose links and names are checked."""
TEXT = {guide: (ROOT / guide).read_text() for guide in LOOKED_AT}


def steps(guide: str) -> list[tuple[str, str]]:
    """(language, text) of what a guide has its reader run: each line of a bash block, each Python block."""
    found = []
    for language, text in re.findall(r"^```(bash|python)\n(.*?)^```", TEXT[guide], re.MULTILINE | re.DOTALL):
        found += [(language, line) for line in text.splitlines()] if language == "bash" else [(language, text)]
    return found


((REPLAYING, REPLAYS),) = [(guide, text) for guide in BUDGET_S for _, text in steps(guide) if "np.load" in text]
"""The guide whose lines replay exported policies, and these lines: a test of their own runs them after all others."""
STEPS = [(guide, text) for guide in BUDGET_S for _, text in steps(guide) if text != REPLAYS]


def of_a_reader(test):
    """Mark a test whose guide's commands it may be the first to need: it waits for all of them."""
    return pytest.mark.slow(pytest.mark.timeout(3600)(test))


def started(language, text, folder, environment, core, left) -> subprocess.CompletedProcess[str]:
    """A step's program, from its start to its end, or for `left` seconds: what it started ends with it, too."""
    program = {"bash": ["sh", "-c"], "python": [sys.executable, "-c"]}[language]
    return subprocess.run(
        ["timeout", "--kill-after=10", f"{left:.0f}", *program, text],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: os.sched_setaffinity(0, {core}),
    )


def at_once(language, text, folder, environment, core) -> None:
    """Be a step's program, in a process that has its modules already."""
    os.sched_setaffinity(0, {core})
    if language == "python":
        warm.be_script(text, folder, environment)
    else:
        program = str(Path(sys.executable).with_name("es-service"))
        warm.be_program([program, *shlex.split(text, comments=True)[1:]], folder, environment)


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    """Guide -> the folder in which everything in it was run in order, and what each step that failed has printed.

    The reader has one core: most of a short run is the start of its workers, of which `auto` is one for each core.
    README.md's steps are programs that the system starts; those of other guides are in processes that have the modules
    of `es-service` already, if the shell has no part in them.
    """

    @cache
    def read(guide: str) -> tuple[Path, dict[str, str]]:
        folder, failed = tmp_path_factory.mktemp("reader"), {}
        (folder / "configs").symlink_to(ROOT / "configs")
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)}
        core = max(os.sched_getaffinity(0))
        end = time.monotonic() + BUDGET_S[guide]
        for language, text in steps(guide):
            left = max(1.0, end - time.monotonic())
            if text == REPLAYS:
                continue
            if guide == "README.md" or (language == "bash" and not re.match(r"es-service [^|&;<>$()`]*$", text)):
                result = started(language, text, folder, environment, core, left)
            else:
                try:
                    result = warm.call(at_once, language, text, str(folder), environment, core, limit_s=left)
                except subprocess.TimeoutExpired:
                    result = subprocess.CompletedProcess(text, 124, "", "")
            if result.returncode:
                late = f"; {guide} has {BUDGET_S[guide]} s for all its steps" if result.returncode == 124 else ""
                failed[text] = f"exit code {result.returncode}{late}:\n{result.stdout}{result.stderr}"
        return folder, failed

    return read


@pytest.mark.slow
def test_the_python_of_the_guides_type_checks_outside_of_the_clone(tmp_path):
    """As in the editor of a user: nothing but the installed package says where it is, and what its functions take."""
    for guide in BUDGET_S:
        for number, (language, text) in enumerate(steps(guide)):
            if language == "python":
                (tmp_path / f"{guide.replace('/', '_')}_{number}.py").write_text(text)
    words = ["pyright", "--pythonpath", sys.executable, tmp_path]
    checked = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert checked.returncode == 0, checked.stdout


@of_a_reader
@pytest.mark.parametrize(("guide", "text"), STEPS, ids=[f"{guide}: {text.splitlines()[0]}" for guide, text in STEPS])
def test_every_command_and_every_script_works(read, guide, text):
    _, failed = read(guide)
    assert text not in failed, failed[text]


@of_a_reader
def test_exported_policies_replayed_by_a_guide_s_lines_return_what_the_run_says(read, monkeypatch):
    """From the corner, so that there is no luck in an episode: but for last bits, which 200 steps add up, and which a
    few episodes, at the end of a wall or the edge of the goal, add up to more."""
    monkeypatch.chdir(read(REPLAYING)[0])
    names: dict = {}
    exec(REPLAYS, names)
    assert len(names["returns"]) >= 8
    told = names["file"]["fitness"]
    np.testing.assert_allclose(names["returns"], told, rtol=1e-3)
    assert np.isclose(names["returns"], told, rtol=1e-5, atol=1e-3).mean() > 0.95
    names["file"].close()


def test_the_tour_shows_every_important_command():
    shown = {text.split()[1] for guide, text in STEPS if guide == USING}
    assert shown >= {"run", "resume", "fork", "status", "evaluate", "export", "digest", "list", "doctor"}


def test_the_generation_at_the_top_of_the_guide_is_the_service_s(tmp_path):
    """But for the last bits: the service computes in float32, and adds the noise of pairs in another order."""
    names: dict = {}
    exec(steps("es_service/README.md")[0][1], names)
    config = {
        "task": {"environment": "caller", "options": {"parameters": 3, "start": [0.3, -0.1, 0.2]}},
        "search": {"algorithm": "es", "pairs": 16, "sigma": 0.1, "evaluation_episodes": 1},
        "map": {"enabled": False},
        "budget": {"generations": 4},
    }
    compared, state = 0, None

    def fitness_of(members):
        return -np.square(members - [0.5, -0.2, 0.1]).sum(axis=-1)

    with ask_tell(config, tmp_path / "run") as search:
        while (asked := search.ask()) is not None:
            policies = asked.parameters.astype(float)
            if state is None:
                state = policies[0], np.zeros(3), np.zeros(3), 0
            elif asked.trains.all():
                plus, minus = policies.reshape(16, 2, 3).swapaxes(0, 1)
                state = names["generation"](*state, (plus - minus) / 0.2, fitness_of)
            else:
                np.testing.assert_allclose(policies[0], state[0], atol=1e-7)
                compared += 1
            search.tell(asked, fitness_of(policies), policies[:, :2])
    assert compared == 4


MOST = dict.fromkeys(LOOKED_AT, (400, 0, 0)) | {
    "README.md": (150, 0, 0),
    "CHANGELOG.md": (200, 0, 0),
}
"""Guide -> the most lines, sentences of more than 35 words, and cells of more than 160 characters. They only fall."""


def long_sentences(text: str) -> list[str]:
    """Sentences of more than 35 words outside of code and tables; links count as their words, code as one."""
    prose = re.sub(r"^```.*?^```|^[|#!<][^\n]*$", "", text, flags=re.MULTILINE | re.DOTALL)
    prose = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", prose)
    prose = re.sub(r"`[^`]*`", "code", re.sub(r"(?<=[.!?]\s)`[^`]*`", "Code", prose))
    sentences = re.split(r"(?<=[.!?:;])\s+(?=[A-Z(*])|\n\n|\n *(?:-|\d+\.) ", prose)
    return [" ".join(sentence.split()) for sentence in sentences if len(sentence.split()) > 35]


def long_cells(text: str) -> list[str]:
    """Cells of tables that have more than 160 characters, without the addresses of links."""
    rows = re.findall(r"^\|(.*)\|$", re.sub(r"\]\([^)]*\)", "]", text), re.MULTILINE)
    return [cell.strip() for row in rows for cell in row.split(" | ") if len(cell.strip()) > 160]


def test_long_sentences_and_cells_are_seen():
    long, short = (f"Word{' word' * count}." for count in (35, 34))
    text = f"# Title\n\n{short} {short}\n`key` is one word. {short}\n\n- {long}\n\n```text\n{long}\n```\n\n1. {long}\n"
    assert long_sentences(text) == [f"- {long}", long]
    assert long_cells(f"| a | {'x' * 161} |\n| [{'x' * 158}](address) | b |\n") == ["x" * 161]


@pytest.mark.parametrize("guide", MOST)
def test_a_tired_reader_can_read_it(guide):
    text, (lines, sentences, cells) = TEXT[guide], MOST[guide]
    assert len(text.splitlines()) <= lines
    assert len(found := long_sentences(text)) <= sentences, found
    assert len(found := long_cells(text)) <= cells, found


def test_assistants_find_every_guide():
    listed = (ROOT / "es_service" / "guides" / "llms.txt").read_text()
    folder = ROOT / "es_service" / "guides"
    linked = {(folder / path).resolve().relative_to(ROOT) for path in re.findall(r"\]\(([^)]+)\)", listed)}
    assert {str(path) for path in linked} == {
        *(guide for guide in LOOKED_AT if guide.count("/") and not guide.startswith("tests/"))
    }


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text()
    named = {target for text in TEXT.values() for target in re.findall(r"(?:^|`)make (?:\w+=\S*\s+)*(\w+)", text, re.M)}
    assert named >= {"run", "test"}
    for target in named:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
    assert "make test" in (ROOT / ".ci" / "run").read_text()


def test_the_guides_agree_on_how_long_all_tests_take():
    said = {guide: re.findall(r"all tests: (\d+ minutes on .*? cores)", text) for guide, text in TEXT.items()}
    assert {*map(tuple, filter(None, said.values()))} == {tuple(said["README.md"])}
    assert len(said["README.md"]) == len(said["CONTRIBUTING.md"]) == 1


def test_every_attribute_that_a_task_may_have_is_explained():
    folder = ROOT / "workers" / "environments"
    _, docstring, code = (folder / "user_task.py").read_text().split('"""', 2)
    code += (folder / "declared.py").read_text()
    read = {
        *re.findall(r'(?:getattr|hasattr)\(task, "([a-z]\w*)"', code),
        "options",
    }  # `declared_options` reads the latter
    known = read - {"observe"}  # which every class must have
    table = TEXT["workers/own_tasks.md"].partition("A class may also have:")[2].strip().partition("\n\n")[0]
    rows = {name for row in table.splitlines() for name in re.findall(r"`(\w+)[^`]*`", row.partition(" | ")[0])}
    assert known == rows
    assert known <= {*re.findall(r"`(\w+)[^`]*`", docstring)}


def test_the_page_of_keys_is_what_the_command_prints():
    printed = CliRunner().invoke(app, ["config", "--keys", "--markdown"]).stdout
    assert TEXT["configs/keys.md"] == printed, "es-service config --keys --markdown > configs/keys.md"


def test_the_table_that_chooses_a_method_has_medians_of_certified_values():
    table = pd.read_csv(ROOT / "tests/benchmarks/results/certified_methods.csv")
    shown = TEXT["configs/which_method.md"].split("<!-- certified -->")[1].split("<!-- /certified -->")[0]
    found = {
        method: cells.split(" | ") for method, cells in re.findall(r"^\| `(\w+)` \| (.*) \|$", shown, re.MULTILINE)
    }
    assert found.keys() == {*table.method}
    columns = ("point_maze", "return_mean"), ("ant_trap", "return_mean"), ("ant_maze", "successes")
    for method, cells in found.items():
        for (task, column), value, seeds in zip(columns, cells[::2], cells[1::2], strict=True):
            runs = table[(table.method == method) & (table.task == task) & (table.env_steps >= 1e8)]
            assert sorted(runs.seed) == [0, 1, 2, 3, 4]
            median = runs[column].median()
            assert float(value.replace(",", "")) == pytest.approx(median, abs=0.5 if abs(median) >= 100 else 0.05)
            assert int(seeds) == (runs.successes >= 128).sum()


@pytest.mark.parametrize("name", [*OURS, "module:function"])
def test_every_method_has_its_section(name):
    guide = TEXT["configs/methods.md" if name in OURS else "configs/own_searches.md"]
    assert re.search(rf"^## .*`{name}`$", guide, re.MULTILINE)
    for table in ("configs/methods.md", USING):  # one row each, or beside others
        assert name not in OURS or re.search(rf"^\|.*`{name}`.*\|", TEXT[table], re.MULTILINE), table


def test_every_shipped_config_is_named():
    for path in (ROOT / "configs").glob("*.yaml"):
        assert f"]({path.name})" in TEXT["configs/methods.md"], path.name


def anchors(text: str) -> set[str]:
    """What links into a guide may name: its headings in lower case, hyphens for spaces, without punctuation."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("guide", LOOKED_AT)
def test_links_lead_somewhere(guide):
    for path, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", TEXT[guide]):
        target = (ROOT / guide).parent / path if path else ROOT / guide
        assert target.exists(), path
        assert not anchor or anchor in anchors(target.read_text()), f"{path}#{anchor}"


@pytest.mark.parametrize("guide", LOOKED_AT)
def test_files_it_names_exist(guide):
    """Named from the top of the repository, or from the guide's own folder. Ids of Gymnasium look like files, too."""
    for path in re.findall(r"(?<![\w/.])(?:es_service|workers|configs|tests|docker)/[\w./*-]+", TEXT[guide]):
        path = path.rstrip("./")
        if re.search(r"-v\d$", path):
            continue
        assert any([*ROOT.glob(path), *(ROOT / guide).parent.glob(path)]), path
