"""Faults of every kind, at random: what each does to a world, how it is undone, and what it costs.

The seed fixes the order of the kinds, the hosts, the pauses and what else a fault draws. It does not fix the instants,
which depend on the machine.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

from tests.system.chaos_world import HEAD, NODES, World

Inject = Callable[[World, str, Random], str]
"""Does it to a host, and says in words what it has done."""
Heal = Callable[[World, str], None]
TWO_MORE = 2
"""Generations that must be committed after a fault was undone: the first may have been computed before."""


@dataclass(frozen=True)
class Fault:
    """A kind of fault."""

    inject: Inject
    heal: Heal = lambda world, host: None
    hosts: tuple[str, ...] = NODES
    hold_s: tuple[float, float] = (0.0, 0.0)
    """How long it lasts, from and to."""
    ends_driver: bool = False
    """Whether the driver ends by it, so that the run is submitted again."""


@dataclass(frozen=True)
class Strike:
    """One fault of a plan."""

    number: int
    kind: str
    host: str
    pause_s: float
    """Time for which the run is left in peace before it."""
    hold_s: float
    early: bool
    """Whether the next one may come before all workers are there again."""


@dataclass(frozen=True)
class Cost:
    """What one fault cost."""

    strike: Strike
    what: str
    seconds: float
    """From the fault to the second generation after it was undone, or until all workers were there again."""
    commits: int
    """Generations that were committed in this time."""
    repeated: int
    copied: int
    lost: int
    sessions: int


COUNTED = ("lost", "repeated", "copied", "sessions")
"""What a fault costs besides time, as the tally counts it."""


def plan(seed: int, kinds: list[str]) -> Iterator[Strike]:
    """Endless; each kind comes once before any comes again."""
    number = 0
    while True:
        for kind in Random(f"{seed} {number}").sample(kinds, len(kinds)):
            rng, fault = Random(f"{seed} {number} {kind}"), FAULTS[kind]
            host, hold_s, pause_s = rng.choice(fault.hosts), rng.uniform(*fault.hold_s), rng.uniform(0.0, 1.5)
            yield Strike(number, kind, host, round(pause_s, 2), round(hold_s, 2), rng.random() < 0.5)
            number += 1


def play(world: World, seed: int, seconds: float, kinds: list[str], least: int) -> list[Cost]:
    """Strike for some time, and until as many kinds as `least` have struck; what each fault cost."""
    costs: list[Cost] = []
    until = time.monotonic() + seconds
    for strike in plan(seed, kinds):
        if time.monotonic() > until and len({cost.strike.kind for cost in costs}) >= least:
            return costs
        world.rest(strike.pause_s)
        fault, before, ends = FAULTS[strike.kind], replace(world.tally), len(world.ends)
        world.may_end, began = fault.ends_driver, time.monotonic()
        what = fault.inject(world, strike.host, Random(f"{seed} {strike.number} inject"))
        print(f"chaos: seed {seed}, fault {strike.number}: {strike.kind}: {what}, for {strike.hold_s} s", flush=True)
        world.rest(strike.hold_s)
        if fault.ends_driver:
            world.wait(lambda ends=ends: len(world.ends) > ends)
        fault.heal(world, strike.host)
        world.tend()
        enough = world.tally.commits + TWO_MORE
        world.wait(lambda enough=enough: world.tally.commits >= enough)
        world.may_end = False
        if not strike.early:
            world.wait(lambda: len(world.tally.up) == len(NODES))
        took_s, now = time.monotonic() - began, vars(world.tally)
        spent = {name: now[name] - getattr(before, name) for name in ("commits", *COUNTED)}
        costs.append(Cost(strike, what, took_s, **spent))
    raise AssertionError("the plan has no end")


def table(costs: list[Cost], usual_s: float) -> str:
    """Table in Markdown: kind, number of faults, seconds lost for each (mean and most), and what was done again.

    Args:
        usual_s: seconds of a generation that nothing disturbs. The seconds of a fault less those that its generations
            usually take are lost.
    """
    lines = [
        "| fault | times | seconds lost, mean | most | workers lost | episodes repeated | copied | sessions |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for kind in FAULTS:
        of_kind = [cost for cost in costs if cost.strike.kind == kind]
        if of_kind:
            lost = [max(0.0, cost.seconds - cost.commits * usual_s) for cost in of_kind]
            sums = [sum(getattr(cost, name) for cost in of_kind) for name in COUNTED]
            cells = [kind, len(of_kind), f"{sum(lost) / len(lost):.1f}", f"{max(lost):.1f}", *sums]
            lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def missing() -> dict[str, str]:
    """Kind -> what this machine lacks for it."""
    lacks = {}
    if shutil.which("cc") is None:
        lacks["clock moved"] = "needs cc, which compiles wall_clock.c"
    command = ["unshare", "--net", "tc", "qdisc", "add", "dev", "lo", "root", *SLOW]
    if shutil.which("tc") is None or subprocess.run(command, capture_output=True, check=False).returncode:
        lacks["link slow"] = "needs tc and the kernel's token bucket filter"
    return lacks


SLOW = ("tbf", "rate", "256kbit", "burst", "16kb", "latency", "2s")


def _kill(name: str, number: int = signal.SIGKILL) -> Inject:
    """Send a signal to a program of a host, or of another one if it has none."""

    def inject(world: World, host: str, rng: Random) -> str:
        where, pid = _find(world, host, name)
        world.signal([pid], number)
        return f"{signal.Signals(number).name} to {name} on {where}"

    return inject


def _find(world: World, host: str, name: str) -> tuple[str, int]:
    """A host with a program, the given one first, and its process id. While a node joins, it may have no worker."""
    found: list[tuple[str, int]] = []

    def look() -> bool:
        for where in (host, *NODES):
            found.extend((where, pid) for pid in world.pids(where, name))
        return bool(found)

    world.wait(look)
    return found[0]


def _lose_node(world: World, host: str, rng: Random) -> str:
    world.clear(host)
    return f"all processes of {host} killed"


def _lose_head(world: World, host: str, rng: Random) -> str:
    if rng.random() < 0.5:
        world.clear(HEAD)
        return "all processes of the head killed, the driver among them"
    world.signal(world.pids(HEAD, "gcs_server"), signal.SIGKILL)
    return "the head's gcs_server killed"


def _kill_driver(world: World, host: str, rng: Random) -> str:
    world.signal([world.driver()], signal.SIGKILL)
    return "SIGKILL to the driver"


def _stop(world: World, host: str, rng: Random) -> str:
    """Stop a worker, a raylet, all of a node, the driver, or what the head node consists of."""
    where, name = rng.choice(
        [(host, "WorkerActor"), (host, "/raylet/raylet "), (host, ""), (HEAD, "es-service run"), (HEAD, "gcs_server")]
    )
    world.signal(world.pids(where, name), signal.SIGSTOP)
    return f"{name or 'everything'} on {where} stopped"


def _go_on(world: World, host: str) -> None:
    for where in (HEAD, host):
        world.proceed(where)


def _cut(world: World, host: str, rng: Random) -> str:
    world.link(host, "down")
    return f"the link of {host} cut"


def _slow(world: World, host: str, rng: Random) -> str:
    world.shape(host, *SLOW)
    return f"the link of {host} limited to 256 kbit/s"


def _move_clock(world: World, host: str, rng: Random) -> str:
    seconds = rng.choice([-1, 1]) * rng.choice([5, 3600, 86400])
    world.move_clock(host, seconds)
    return f"the wall clock of {'the driver' if host == HEAD else host} moved by {seconds} s"


def _set_clock_right(world: World, host: str) -> None:
    """Ray's timers follow the wall clock: until a raylet's clock has reached again where it was, or for five minutes,
    it reports no free CPU. So an operator must start it again."""
    world.move_clock(host, 0)
    if host != HEAD:
        world.clear(host)


def _fill_run(world: World, host: str, rng: Random) -> str:
    _fill(world.disk / "ballast")
    return "the disk of the run folder filled"


def _fill_node(world: World, host: str, rng: Random) -> str:
    _fill(world.root(host) / "tmp" / "ray" / "ballast")
    return f"the disk for temporary files of {host} filled"


def _fill(ballast: Path) -> None:
    with ballast.open("wb", buffering=0) as file:
        for size in (2**20, 2**12, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:  # smaller pieces may still fit
                continue


def _fill_memory(world: World, host: str, rng: Random) -> str:
    world.fill_memory(host, 0.99)
    return f"the memory of {host} seems full"


FAULTS = {
    "worker killed": Fault(_kill("WorkerActor")),
    "actor told to end": Fault(_kill("WorkerActor", signal.SIGTERM)),
    "raylet killed": Fault(_kill("/raylet/raylet ")),
    "node lost": Fault(_lose_node),
    "head lost": Fault(_lose_head, hosts=(HEAD,), ends_driver=True),
    "driver killed": Fault(_kill_driver, hosts=(HEAD,), ends_driver=True),
    "link cut": Fault(_cut, lambda world, host: world.link(host, "up"), (HEAD, *NODES), (1.0, 15.0)),
    "link slow": Fault(_slow, lambda world, host: world.shape(host), (HEAD, *NODES), (2.0, 6.0)),
    "clock moved": Fault(_move_clock, _set_clock_right, (HEAD, *NODES), (1.0, 4.0)),
    "run's disk full": Fault(
        _fill_run, lambda world, host: (world.disk / "ballast").unlink(), (HEAD,), (1.0, 5.0), ends_driver=True
    ),
    "node's disk full": Fault(
        _fill_node, lambda world, host: (world.root(host) / "tmp/ray/ballast").unlink(), hold_s=(2.0, 6.0)
    ),
    "stopped": Fault(_stop, _go_on, hold_s=(1.0, 8.0)),
    "out of memory": Fault(_fill_memory, lambda world, host: world.fill_memory(host, 0.0), hold_s=(1.0, 4.0)),
}
"""Kind -> what it is."""
