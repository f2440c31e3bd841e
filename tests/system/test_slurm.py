"""docker/slurm.sh under a stand-in for Slurm (`slurm.py`); no real Slurm was at hand."""

import os
import signal
import subprocess

import pytest
import yaml

from es_service import api
from es_service.store.digest import digest_parts
from es_service.store.reader import read_generation
from tests.system import cluster
from tests.system.processes import ROOT, committed, running, wait_for
from tests.system.session import SMALL
from tests.system.slurm import Slurm, sbatch_options, write_commands

SCRIPT = ROOT / "docker" / "slurm.sh"
GENERATIONS = 150
CONFIG = SMALL | {"search": SMALL["search"] | {"pairs": 64}, "budget": {"generations": GENERATIONS}}


def test_it_asks_slurm_for_what_it_relies_on():
    """Requeueing, a signal to the script alone in good time, whole nodes, one task each, nodes that may fail."""
    options = sbatch_options(SCRIPT)
    assert options["signal"] == "B:TERM@90"
    assert {"requeue", "exclusive", "no-kill"} <= options.keys()
    assert options["ntasks-per-node"] == "1"
    assert options["open-mode"] == "append"


@pytest.mark.long
@pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing()))
def test_a_job_that_is_preempted_is_requeued_and_ends_with_the_same_digest(tmp_path):
    config, run = tmp_path / "config.yaml", tmp_path / "run"
    config.write_text(yaml.safe_dump(CONFIG | {"compute": CONFIG["compute"] | {"engine": "ray", "workers": "auto"}}))
    with Slurm(tmp_path, hosts=2, cpus=1) as slurm:
        slurm.sbatch(SCRIPT, config, run)
        slurm.wait_for(lambda: committed(run))
        slurm.warn()
        slurm.wait_for(lambda: slurm.restarts == 1)
        interrupted_at = read_generation(run)
        assert interrupted_at < GENERATIONS
        slurm.wait_for(slurm.ended)
        assert slurm.exit_code == 0, slurm.output()
    printed = slurm.output()
    assert f"es-service resume {run}" in printed, "the driver stopped by itself"
    assert printed.count("On worker node. Connecting to Ray cluster at 10.77.0.1:6379") == 2
    alone = CONFIG | {"compute": CONFIG["compute"] | {"engine": "inline", "workers": 1}}
    api.run(api.load_config(alone), tmp_path / "alone")
    assert digest_parts(run) == digest_parts(tmp_path / "alone")


RUNS_HERE = """#!/bin/bash
while [ "$1" != -- ]; do shift; done
shift
exec "$@"
"""
"""srun with one node, without Ray."""
STATE = """#!/bin/bash
echo {}
"""
REQUEUES = """#!/bin/bash
echo "$@" > "$STAND_IN/requeued"
"""
WAITS = """#!/bin/bash
trap 'exit 143' TERM
touch "$STAND_IN/begun"
while true; do sleep 0.1; done
"""


@pytest.mark.parametrize(
    ("driver", "srun", "state", "signalled", "code", "requeued"),
    [
        pytest.param("exit 0", RUNS_HERE, "RUNNING", False, 0, False, id="done"),
        pytest.param("exit 2", RUNS_HERE, "RUNNING", False, 2, False, id="a driver that fails"),
        pytest.param("exit 143", RUNS_HERE, "RUNNING", False, 0, True, id="SIGTERM to the driver alone"),
        pytest.param("exit 0", "exit 143", "RUNNING", False, 0, True, id="SIGTERM to all tasks"),
        pytest.param("exit 0", "exit 0", "RUNNING", False, 1, False, id="Ray does not start"),
        pytest.param("exit 0", "exit 137", "RUNNING", False, 1, False, id="SIGKILL to all tasks"),
        pytest.param(WAITS, RUNS_HERE, "RUNNING", True, 0, True, id="preempted"),
        pytest.param(WAITS, RUNS_HERE, "COMPLETING", True, 143, False, id="cancelled"),
        pytest.param("exit 0", WAITS, "RUNNING", True, 0, True, id="preempted before the driver begins"),
    ],
)
def test_it_requeues_a_job_that_was_told_to_stop_and_no_other(tmp_path, driver, srun, state, signalled, code, requeued):
    driver, srun = (text if text.startswith("#!") else f"#!/bin/bash\n{text}\n" for text in (driver, srun))
    programs = {"es_service": driver, "srun": srun, "squeue": STATE.format(state), "scontrol": REQUEUES}
    path = f"{write_commands(tmp_path, **programs)}{os.pathsep}{os.environ['PATH']}"
    job = {"SLURM_JOB_ID": "7", "SLURM_JOB_NUM_NODES": "1", "SLURM_CPUS_PER_TASK": "1"}
    environment = os.environ | job | {"PATH": path, "STAND_IN": str(tmp_path), "TMPDIR": str(tmp_path)}
    with (
        (tmp_path / "printed").open("wb") as log,
        running(
            "bash", SCRIPT, "config.yaml", "/runs/x", env=environment, stdout=log, stderr=log, start_new_session=True
        ) as script,
    ):
        if signalled:
            wait_for((tmp_path / "begun").exists)
            script.send_signal(signal.SIGTERM)
        script.wait(timeout=20)
        if srun == WAITS:  # Slurm would end it
            os.killpg(script.pid, signal.SIGTERM)
    assert script.returncode == code, (tmp_path / "printed").read_text()
    assert (tmp_path / "requeued").exists() == requeued
    if requeued:
        assert (tmp_path / "requeued").read_text() == "requeue 7\n"
    assert not list(tmp_path.glob("tmp.*")), "its own folder is gone"


def test_it_says_how_it_is_used():
    result = subprocess.run(["bash", SCRIPT, "config.yaml"], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "usage: sbatch docker/slurm.sh CONFIG RUN_FOLDER" in result.stderr
