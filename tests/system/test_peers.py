"""The benchmark that compares es-service with other programs, as far as it works without them."""

import subprocess
import sys

import pytest

from tests.benchmarks import explain, peers
from tests.benchmarks.peers_environments import ENVIRONMENTS, python_of, their_versions


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_an_environment_that_is_not_the_program_s_is_refused_with_the_command_that_builds_it(tmp_path, name):
    folder = tmp_path / "others"
    with pytest.raises(SystemExit, match=r"it does not exist\n.*--build --environments .*/others"):
        their_versions(folder, name)
    python_of(folder, name).parent.mkdir(parents=True)
    python_of(folder, name).symlink_to(sys.executable)  # has no site-packages of its own
    with pytest.raises(SystemExit, match=r"(No module named|it has [a-z]+ ).*\n.*--build"):
        their_versions(folder, name)


def test_medians_leave_out_the_choice_of_a_batch_and_a_ratio_above_one_means_that_we_are_faster():
    rollouts, search = peers.COMPARISONS[0], peers.COMPARISONS[3]
    rows = [{"round": 0, "program": "qdax", "what": rollouts.what, "env_steps_per_second": 1e9}]
    for number, (theirs, ours) in enumerate([(10.0, 40.0), (20.0, 50.0), (90.0, 10.0)], start=1):
        rows += [
            {"round": number, "program": "qdax", "what": rollouts.what, "env_steps_per_second": theirs},
            {"round": number, "program": peers.OURS, "what": rollouts.what, "env_steps_per_second": ours},
            {"round": number, "program": "qdax", "what": search.what, "ms_per_generation": theirs},
            {"round": number, "program": peers.OURS, "what": search.what, "ms_per_generation": ours},
        ]
    found = [line.split()[-4:] for line in peers.summary(rows).splitlines()[1:]]
    assert found == [
        ["env_steps_per_second", "20.0", "40.0", "2.00"],
        ["ms_per_generation", "20.0", "40.0", "0.50"],
    ]


@pytest.mark.parametrize(("module", "package"), [("peers", "gymnasium"), ("paper", "matplotlib")])
def test_a_package_that_is_not_installed_is_named_without_a_traceback(module, package):
    """As by `python -m`, where the package is hidden."""
    run = f"import runpy, sys; sys.modules[{package!r}] = None; runpy.run_module({f'tests.benchmarks.{module}'!r})"
    done = subprocess.run([sys.executable, "-c", run], capture_output=True, text=True, cwd=peers.ROOT)
    assert done.returncode == 1
    command = "pip install -c constraints.txt -e '.[dev]'"
    assert done.stderr.splitlines() == [
        f"this measurement needs the package {package}, which is not installed; to install it: {command}"
    ]


def test_other_errors_of_a_measurement_keep_their_traceback(capsys):
    error = ImportError("cannot import name x")
    explain(type(error), error, None)
    assert capsys.readouterr().err == "ImportError: cannot import name x\n"
