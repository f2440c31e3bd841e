"""Descriptions of the episodes of a chunk whose worker was lost, so that a user can run them alone."""

from __future__ import annotations

from collections.abc import Sequence

from es_service.protocol.messages import GradientChunk, Work, WorkerSpec
from es_service.protocol.parameters import ParameterSpec
from workers.asking import rows_of

SHOWN_ROWS = 4
"""Calls of a function that a description names with their parameters."""
SHOWN_SEEDS = 16
"""Seeds of resets that it names."""


def described(spec: WorkerSpec, parameters: ParameterSpec | None, work: Sequence[Work]) -> str:
    """The parameters and seeds of the calls of a function, or the seeds of the resets of environments, as a sentence.

    Args:
        parameters: those of a function that is the task; None for an environment.
        work: the chunks of a work item.
    """
    if not work or any(isinstance(chunk, GradientChunk) for _, chunk in work):
        return ""
    rows = rows_of(spec, work)
    seeds = rows.seed_N.tolist()
    if parameters is None:
        shown = list(dict.fromkeys(seeds))
        more = f" and {len(shown) - SHOWN_SEEDS} more" if len(shown) > SHOWN_SEEDS else ""
        return f"The resets of its episodes have the seeds {', '.join(map(str, shown[:SHOWN_SEEDS]))}{more}"
    calls = [
        f"{parameters.text(row_D)} (seed {seed})"
        for row_D, seed in zip(rows.parameters_N_D[:SHOWN_ROWS], seeds, strict=False)
    ]
    more = f"; and {len(seeds) - SHOWN_ROWS} more" if len(seeds) > SHOWN_ROWS else ""
    return f"Its calls have {'; '.join(calls)}{more}"
