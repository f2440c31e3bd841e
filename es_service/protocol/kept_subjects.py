"""The newest subjects that were sent to a worker: what worker and sender both keep, so that the sender knows what the
worker has; and what a sender makes of each subject once, whoever gets it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from es_service.protocol.kept import Kept
from es_service.protocol.messages import Subject

Made = TypeVar("Made")

KEPT_SUBJECTS = 64
"""Most subjects that a worker keeps after each work item, so that they need not be sent to it again."""
KEPT_BYTES = 32 * 2**20
"""Most bytes of parameters that it keeps."""


def forget_old_subjects(kept: Kept[Any, Any]) -> None:
    """Forget the oldest, so that at most KEPT_SUBJECTS and KEPT_BYTES remain, or the newest alone. Worker and sender
    both do so after each work item."""
    kept.forget_oldest(KEPT_BYTES, KEPT_SUBJECTS, spared=[*kept][-1:])


class MadeOnce(Kept[int, tuple[Subject, Made]]):
    """What a sender makes of subjects, such as messages. One that was forgotten meanwhile is made again.

    The key is the subject's `id`, which the subject in the entry keeps from being reused.
    """

    def __init__(self, make: Callable[[Subject], Made]) -> None:
        super().__init__(lambda entry: entry[0].nbytes)
        self._make = make

    def of(self, subject: Subject) -> Made:
        """What was or is made of a subject."""
        if (known := self.get(id(subject))) is None:
            known = subject, self._make(subject)
            self.add(id(subject), known)
        return known[1]
