"""What do open live pages cost a run on the same machine?

    python -m tests.benchmarks.watch_load [--pages 20] [--seconds 30] [--rounds 4] [--folder FOLDER]

A run of ME-ES on PointMaze goes on with a worker for each core. By turns, nobody watches it, and as many pages of it as
asked are open for some seconds: connections of the live page that read whatever is sent, as browsers on other machines
would. Generations are counted by the store, seconds of the processor by the kernel: those of the driver with its
workers, and those of the server. On a machine that others use, too, compare the seconds: a watched generation must not
take more of them, and the server's share is what it can take from the run at most.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

from es_service.store.reader import read_generation

SETTINGS = ("search.pairs=64", "budget.generations=10000000", "compute.engine=inline", "compute.workers=auto")
TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pages", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--folder", type=Path, default=None)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as parent:
        measure(Path(parent) / "run", given.pages, given.seconds, given.rounds)


def measure(folder: Path, pages: int, seconds: float, rounds: int) -> None:
    program = str(Path(sys.executable).with_name("es-service"))
    words = [program, "run", "point_maze_me_es", "--out", str(folder), *(f"--set={setting}" for setting in SETTINGS)]
    driver = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    server = subprocess.Popen([program, "watch", str(folder), "--port", "0"], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        address = server.stdout.readline().strip()
        while not (folder / "run.db").exists() or (read_generation(folder) or 0) < 200:
            assert driver.poll() is None
            time.sleep(0.5)
        measurements: dict[bool, list[dict[str, float]]] = {False: [], True: []}
        for turn in range(2 * rounds):
            watched = bool((turn + turn // 2) % 2)  # nobody, all, all, nobody, ...
            row = _turn(folder, address, driver.pid, server.pid, pages if watched else 0, seconds)
            measurements[watched].append(row)
            print(json.dumps({"pages": pages if watched else 0, **row}), flush=True)
        rate = {
            watched: statistics.median(measurement["generations_s"] for measurement in rows)
            for watched, rows in measurements.items()
        }
        cost = {
            watched: statistics.median(measurement["run_cpu_ms"] for measurement in rows)
            for watched, rows in measurements.items()
        }
        share = statistics.median(measurement["server_cores"] for measurement in measurements[True])
        lost = {"generations_lost_%": 100 * (1 - rate[True] / rate[False])}
        more = {"cpu_a_generation_more_%": 100 * (cost[True] / cost[False] - 1)}
        print(json.dumps(lost | more | {"server_share_of_the_machine_%": 100 * share / (os.cpu_count() or 1)}))
    finally:
        for process in (driver, server):
            process.terminate()
            process.wait()


def _turn(folder: Path, address: str, driver: int, server: int, pages: int, seconds: float) -> dict[str, float]:
    ended, received = threading.Event(), [0] * pages
    threads = [threading.Thread(target=_look, args=(address, ended, received, page)) for page in range(pages)]
    for thread in threads:
        thread.start()
    time.sleep(5.0)  # the first pictures are not part of it: a page is open for longer
    began = time.monotonic(), read_generation(folder) or 0, _cpu_s(driver), _cpu_s(server)
    first = sum(received)
    time.sleep(seconds)
    took_s = time.monotonic() - began[0]
    generations = (read_generation(folder) or 0) - began[1]
    run_s, server_s = _cpu_s(driver) - began[2], _cpu_s(server) - began[3]
    sent = sum(received) - first
    ended.set()
    for thread in threads:
        thread.join()
    return {
        "generations_s": round(generations / took_s, 3),
        "run_cpu_ms": round(1000 * run_s / generations, 3),
        "server_cores": round(server_s / took_s, 4),
        "sent_mb": round(sent / 1e6, 1),
    }


def _look(address: str, ended: threading.Event, received: list[int], page: int) -> None:
    """Be one open page of the only run until told to end."""
    with urllib.request.urlopen(f"{address}events/list") as answer:
        line = next(line for line in answer if line.startswith(b"data: "))
    key = re.search(rb"/run/(\w+)", line)
    assert key is not None
    with urllib.request.urlopen(f"{address}events/run/{key[1].decode()}", timeout=60) as answer:
        while not ended.is_set():
            received[page] += len(answer.read1(1 << 20))


def _cpu_s(pid: int) -> float:
    """Seconds of the processor that a process and its descendants have used."""
    total_s, parents = 0.0, {}
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            fields = Path(f"/proc/{name}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents[int(name)] = int(fields[1]), (int(fields[11]) + int(fields[12])) * TICK_S
    for process, (_, used_s) in parents.items():
        above = process
        while above not in (pid, 0, 1) and above in parents:
            above = parents[above][0]
        total_s += used_s if above == pid else 0.0
    return total_s


if __name__ == "__main__":
    main()
