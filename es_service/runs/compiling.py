"""What a run says while its workers compile, and what workers of this machine have compiled before.

Workers keep compiled code on disk, in caches whose keys only they can compute. So an empty file for each kind of chunk
that they have compiled for, named by all that the code depends on, stands beside these caches.
"""

from __future__ import annotations

import contextlib
import hashlib
from dataclasses import replace
from pathlib import Path

from es_service.dispatch.dispatch_log import Entry, Log
from es_service.dispatch.events import Compiled
from es_service.protocol.machine import platform_info, platform_text
from es_service.protocol.messages import WorkerSpec
from workers.rollouts import BACKENDS
from workers.simd.backend.cache import cache_folder

CONTENTS = {
    "TrainingChunk": "training episodes",
    "EvaluationChunk": "evaluation episodes",
    "PolicyChunk": "episodes of policies",
    "GradientChunk": "gradients",
}
"""Class name of a kind of chunk -> what it computes, in words."""
MOST_FILES = 1000


def compiling_sentence(spec: WorkerSpec, kind: str, text: str, *, here: bool) -> str:
    """That workers compile for a kind of chunk, or load what they have compiled before, and about how long it takes.
    That they start, if they compile nothing; or how many environments they have made or reset. Else empty.

    Args:
        kind, text: see `on_compile` in `Waits`.
        here: whether they are on this machine; of others it is not known what they have on disk.
    """
    if text or not kind:
        return f"{text} ({spec.environment})" if text else ""
    first_s, again_s = BACKENDS[spec.rollout].compile_s
    if not first_s:
        return f"starting workers for {spec.environment} ({CONTENTS[kind]})"
    if here and was_compiled(spec, kind):
        return f"loading compiled code for {spec.environment} ({CONTENTS[kind]}, about {again_s} s)"
    how_long = f"first time, about {first_s} s" if here else f"about {first_s} s the first time"
    return f"compiling for {spec.environment} ({CONTENTS[kind]}, {how_long})"


def was_compiled(spec: WorkerSpec, kind: str) -> bool:
    """Whether workers of this machine have compiled for this kind of chunk before."""
    file = _file(spec, kind)
    return file is not None and file.exists()


def note_compiled(spec: WorkerSpec, kind: str) -> None:
    """Remember that workers of this machine have compiled for this kind of chunk."""
    if (file := _file(spec, kind)) is None:
        return
    with contextlib.suppress(OSError):  # nothing but a sentence depends on it
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        file.touch()
        for old in sorted(file.parent.iterdir(), key=lambda path: path.stat().st_mtime)[:-MOST_FILES]:
            old.unlink(missing_ok=True)


def noting(log: Log, spec: WorkerSpec) -> Log:
    """The dispatch log of workers on this machine, which also remembers for which kinds they have compiled."""
    noted: set[str] = set()

    def log_and_note(entry: Entry) -> None:
        log(entry)
        if isinstance(entry, Compiled) and entry.kind not in noted:
            noted.add(entry.kind)
            note_compiled(spec, entry.kind)

    return log_and_note


def _file(spec: WorkerSpec, kind: str) -> Path | None:
    kernels = cache_folder()
    if kernels is None:
        return None
    text = f"{kind} {replace(spec, seed=0)} {platform_text(platform_info())}"
    return kernels.with_name("compiled") / hashlib.sha256(text.encode()).hexdigest()
