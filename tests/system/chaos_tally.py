"""What the dispatch log of a run tells while it is written: commits, workers, episodes that were begun again."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass
class Tally:
    """What the dispatch log tells, as far as it has been read."""

    commits: int = 0
    sessions: int = 0
    lost: int = 0
    repeated: int = 0
    """Episodes that were begun again after a loss, or because their generation was lost with its driver."""
    copied: int = 0
    """Episodes that were sent a second time because a worker was late."""
    at: int = 0
    """Bytes that have been read."""
    up: set[int] = field(default_factory=set)
    """Workers that are up."""
    begun: dict[tuple, int] = field(default_factory=dict)
    """Work item -> its episodes, for all of the generation that is being computed."""

    def read(self, path: Path, episodes_per_chunk: int) -> None:
        """Read the whole lines that have been added."""
        if not path.exists():
            return
        with path.open("rb") as file:
            file.seek(self.at)
            lines, newline, _ = file.read().rpartition(b"\n")
        self.at += len(lines) + len(newline)
        for line in lines.split(b"\n"):
            try:
                self._count(json.loads(line), episodes_per_chunk)
            except ValueError:  # cut short by a kill or a full disk
                continue

    def _count(self, entry: dict[str, Any], episodes_per_chunk: int) -> None:
        match entry["is"]:
            case "Session":
                self.sessions += 1
                self.repeated += sum(self.begun.values())
                self.begun, self.up = {}, set()
            case "WorkerUp":
                self.up.add(entry["worker"])
            case "WorkerLost" | "StopWorker":
                self.lost += entry["is"] == "WorkerLost"
                self.up.discard(entry["worker"])
            case "Assign":
                item_id = tuple(entry["item_id"])
                episodes = 0 if item_id[2] == "GradientChunk" else item_id[-1] * episodes_per_chunk
                if entry["copy"]:
                    self.copied += episodes
                elif item_id in self.begun:
                    self.repeated += episodes
                self.begun[item_id] = episodes
            case "Committed":
                self.commits += 1
                self.begun = {}
