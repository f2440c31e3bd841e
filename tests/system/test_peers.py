"""The benchmark that compares es-service with other programs, as far as it works without them."""

import sys

import pytest

from tests.benchmarks import peers
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
