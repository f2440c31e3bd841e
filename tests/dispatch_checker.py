"""Reads a dispatch log as a stranger would and says whether the run it tells of was in order."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from es_service.dispatch.events import FILE
from es_service.protocol.messages import WorkItemId


def read_dispatch_log(folder: Path) -> list[dict[str, Any]]:
    """All entries, oldest first; lines cut short by a kill or a full disk are left out."""
    entries = []
    for line in (folder / FILE).read_text(encoding="utf-8").split("\n"):
        with suppress(ValueError):
            entries.append(json.loads(line))
    return entries


def check_dispatch(folder: Path) -> dict[str, int]:
    """Assert that each chunk was delivered once, by a worker that was there and had it, and generations are contiguous.

    A worker compiles once for each kind of chunks, when it has an item of this kind.

    Returns counts: sessions, generations committed, items delivered, chunks handed out again after a fault, chunks sent
    a second time because a worker was late, workers lost, compilations.
    """
    entries = read_dispatch_log(folder)
    assert entries[0]["is"] == "Session"
    counts = dict.fromkeys(("sessions", "generations", "delivered", "repeated", "copied", "lost", "compiled"), 0)
    newest, begun = None, -1
    up: set[int] = set()
    compiled: set[tuple[int, str]] = set()
    holders: dict[tuple, set[int]] = {}
    waiting: set[tuple] = set()
    answered: tuple | None = None
    for entry in entries:
        item_id = tuple(entry["item_id"]) if "item_id" in entry else None
        worker = entry.get("worker")
        match entry["is"]:
            case "Session":
                after = entry["after_generation"]
                if counts["sessions"] and after != newest:
                    # A kill has come between a commit, perhaps of several generations, and their lines here.
                    assert (-1 if newest is None else newest) < after <= begun, "stored, and never computed"
                newest = entry["after_generation"]
                up, compiled, holders, waiting = set(), set(), {}, set()
                counts["sessions"] += 1
            case "Submit":
                assert not waiting, f"{waiting} were never delivered"
                waiting = {tuple(item) for item in entry["items"]}
                begun = max(WorkItemId(*item).generation for item in waiting)
                assert len(waiting) == len(entry["items"])
                assert not waiting & holders.keys(), "submitted twice in one session"
            case "WorkerUp":
                assert worker not in up
                up.add(worker)
            case "WorkerLost" | "StopWorker":
                counts["lost"] += entry["is"] == "WorkerLost" and worker in up
                up.discard(worker)
            case "Assign":
                assert worker in up
                assert item_id in waiting
                if entry["copy"]:
                    assert len(holders[item_id]) == 1, "of an item that one other worker has"
                counts["copied" if entry["copy"] else "repeated"] += item_id[-1] if item_id in holders else 0
                holders.setdefault(item_id, set()).add(worker)
            case "Compiled" if worker in up:
                assert (worker, entry["kind"]) not in compiled, "compiled twice"
                assert any(worker in has and item[2] == entry["kind"] for item, has in holders.items())
                assert entry["seconds"] >= 0.0
                compiled.add((worker, entry["kind"]))
                counts["compiled"] += 1
            case "Result":
                answered = item_id if worker in up and worker in holders.get(item_id, ()) else None
            case "Deliver":
                assert item_id == answered, "delivered without an answer of a live worker that had it"
                waiting.remove(item_id)
                counts["delivered"] += 1
            case "Committed":
                early = {item for item in waiting if WorkItemId(*item).generation <= entry["generation"]}
                assert not early, "committed before every chunk was there"  # those of the next one have been sent
                assert entry["generation"] == (0 if newest is None else newest + 1)
                newest = entry["generation"]
                counts["generations"] += 1
    return counts
