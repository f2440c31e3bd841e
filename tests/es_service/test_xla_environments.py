"""Environments of Gymnasium whose task simd cannot compile, or not its reset: xla computes them in child processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from es_service.environments.vector import TaskEnv, TaskVectorEnv
from es_service.protocol.child import NoAnswerError
from tests.es_service.test_environments import actions_of, same
from workers.environments import TaskError

DRAWN, TRANSFORMED_START = "tests.es_service.xla_tasks:Drawn", "tests.es_service.xla_tasks:TransformedStart"
WHY = {
    DRAWN: "xla computes it in a process of its own, since simd cannot compile its step: ",
    TRANSFORMED_START: "xla computes its resets in a process of its own, since simd cannot compile its reset: ",
}


def quietly(task: str, *given: Any, single: bool = False, **settings: Any) -> Any:
    """Environments whose warning a test does not look at."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return closing((TaskEnv if single else TaskVectorEnv)(task, *given, **settings))


@pytest.mark.slow
@pytest.mark.parametrize(
    "task",
    [DRAWN, *(pytest.param(one, marks=pytest.mark.long) for one in (TRANSFORMED_START, "brax:ant", "brax:reacher"))],
)
def test_an_environment_has_the_same_bits_alone_and_among_others_in_several_processes(task):
    """Environment 19 is the fourth of the second block, which has a process of its own where there are two threads."""
    lane, steps, limit = 19, 16, 6

    def seen(envs: TaskVectorEnv) -> list[Any]:
        found = [envs.reset(seed=7)[0][lane]]
        rng = np.random.default_rng(1)
        for number, actions in enumerate(actions_of(envs, steps, seed=envs.num_envs)):
            if number == 10:
                envs.set_state(envs.get_state())
            actions[lane] = rng.uniform(-1, 1, actions.shape[1])
            observation, reward, done, _, info = envs.step(actions)
            found += [observation[lane], reward[lane], done[lane], info["descriptor"][lane]]
        return found

    with quietly(task, 21, max_episode_steps=limit, threads=2) as many:
        expected = seen(many)
        last = many.reset(seed=7)[0]
        some = np.isin(np.arange(21), [2, lane])
        again = many.reset(options={"reset_mask": some})[0]
        assert (again != last).any(axis=1).tolist() == some.tolist()
    with quietly(task, single=True, index=lane) as one:
        found, length = [one.reset(seed=7 + lane)[0]], 0
        rng = np.random.default_rng(1)
        for _ in range(steps):
            observation, reward, done, _, info = one.step(rng.uniform(-1, 1, one.action_space.shape))
            length += 1
            if done or length == limit:
                (observation, info), length = one.reset(), 0
            found += [observation, np.float64(reward), np.bool_(done), info["descriptor"]]
        same(found, expected)
    assert len({one.tobytes() for one in expected[0::4]}) == steps + 1


@pytest.mark.long
@pytest.mark.parametrize("task", [DRAWN, TRANSFORMED_START])
def test_a_warning_says_once_why_xla_computes(task):
    from workers import lanes

    lanes._say_once.cache_clear()
    with pytest.warns(UserWarning, match=WHY[task]), closing(TaskEnv(task)):
        pass
    with closing(TaskEnv(task)) as env:  # every warning is an error here
        env.reset(seed=1)


@pytest.mark.long
def test_a_lost_process_is_an_error():
    with quietly(DRAWN, 2) as envs:
        envs.reset(seed=0)
        os.kill(envs._lanes._blocks._children[0]._process.pid, signal.SIGKILL)
        with pytest.raises(NoAnswerError, match=r"xla computes .*Drawn ended with signal SIGKILL; make"):
            envs.step(np.zeros((2, 3)))


@pytest.mark.long
def test_after_an_interrupted_step_no_answer_is_that_of_another_call():
    with quietly(DRAWN, 20, threads=2) as envs:
        envs.reset(seed=0)
        child = envs._lanes._blocks._children[1]._process.pid
        os.kill(child, signal.SIGSTOP)
        threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            envs.step(np.zeros((20, 3)))
        for call in (lambda: envs.step(np.zeros((20, 3))), envs.get_state, envs.reset):
            with pytest.raises(NoAnswerError, match="make the environments anew"):
                call()


@pytest.mark.long
def test_the_end_of_a_forked_process_does_not_end_the_child():
    with quietly(DRAWN, 2) as envs:
        envs.reset(seed=0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # JAX warns
            forked = os.fork()
        if not forked:
            envs._lanes._blocks.close()
            os._exit(0)
        assert os.waitpid(forked, 0) == (forked, 0)
        envs.step(np.zeros((2, 3)))


@pytest.mark.long
def test_what_the_task_raises_is_an_error():
    with quietly("tests.es_service.xla_tasks:Raising", 2) as envs:
        envs.reset(seed=0)
        with pytest.raises(TaskError, match="the sixteenth time is too often"):
            envs.step(np.zeros((2, 3)))


@pytest.mark.long
@pytest.mark.parametrize("how", ["os.kill(os.getpid(), 9)", "del envs; import gc; gc.collect(); time.sleep(60)"])
def test_the_process_ends_with_its_parent_and_with_its_environments(how):
    program = f"""
import os, time, warnings
warnings.simplefilter("ignore")
from es_service.environments.vector import TaskVectorEnv
envs = TaskVectorEnv({DRAWN!r}, 2)
print(envs._lanes._blocks._children[0]._process.pid, flush=True)
{how}
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        until = time.monotonic() + 60
        while os.path.exists(f"/proc/{child}"):
            assert time.monotonic() < until
            time.sleep(0.05)
        parent.kill()
