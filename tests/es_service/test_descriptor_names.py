"""Names of a descriptor become columns of a run's tables: none may be taken for another one."""

import pytest

from es_service import api
from es_service.cli.evaluate import row_of
from es_service.runs.evaluation import candidates, evaluate
from tests.examples.fourier import Fourier
from workers.environments import TaskError, declared, user_task

FOURIER = "tests.examples.fourier:Fourier"
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 5},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "es", "pairs": 4, "evaluation_episodes": 2},
    "budget": {"generations": 1},
    "compute": {"engine": "inline", "workers": 1},
}


def columns_of(run):
    """Of every table: as they are in a run."""
    chosen = candidates(run, best=True, centre=False, cells=(), every=False)
    (fresh,) = evaluate(run, chosen, 2, 1)
    return {
        "the history": [column for column in run.history.reset_index().columns if column.startswith("centre_")],
        "the map": list(run.map.columns),
        "the novelty archive": list(run.novelty.columns),
        "evaluate --out": list(row_of(fresh, run.descriptor_names, run.folder)),
    }


@pytest.mark.usefixtures("workers_here")
def test_the_columns_that_names_are_held_against_are_those_of_a_run(tmp_path):
    grid, cvt = (
        columns_of(api.run(api.load_config(CONFIG, overrides), tmp_path / name).run)
        for name, overrides in (("grid", []), ("cvt", ["map.kind=cvt", "map.cells=[9]"]))
    )
    for table, (ours, others) in declared.TABLES.items():
        named = {form.format(name) for form in ours for name in ("x", "y")}
        assert set(grid[table]) | set(cvt[table]) == named | set(others), table


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("fitness", "y"), "'fitness' would be the column centre_fitness_std of the history, .*choose another name"),
        (("x", "generation"), "'generation' would be the column generation of the map"),
        (("x", "Cell"), "'Cell' would be the column Cell of the map"),
        (("x", "novelty"), "'novelty' would be the column centre_novelty of the history"),
        (("episodes", "y"), "'episodes' would be the column episodes of evaluate --out"),
        (("x", "X"), "'X' would be the column centre_X of the history"),
        (("run", "y"), "'run' would be the column run of evaluate --out"),
        (("x_std", "x"), "'x' would be the column centre_x_std of the history"),
        (("x", "cell_x"), "'cell_x' would be the column cell_x of the map"),
    ],
)
def test_a_name_that_would_overwrite_a_column_is_refused(monkeypatch, names, message):
    monkeypatch.setattr(Fourier, "descriptor_names", names)
    with pytest.raises(TaskError, match=rf"^{FOURIER}: descriptor_names: {message}"):
        user_task.describe(FOURIER)


def test_names_of_columns_that_no_name_becomes_may_be_used(monkeypatch):
    monkeypatch.setattr(Fourier, "descriptor_names", ("goal_distance", "coverage"))
    assert user_task.describe(FOURIER).descriptor_names == ("goal_distance", "coverage")
