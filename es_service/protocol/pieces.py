"""Evaluation and policy chunks in pieces, for tasks whose episodes may take long: each piece can go to another worker.
And policy chunks that are several in one, for tasks whose episodes take less than a message.

Results know the addresses of their rows (`protocol.episodes`), so nobody needs to know how chunks were cut. They stay
those of the whole chunks, as far as the bits of an episode do not depend on the others that are computed with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from es_service.protocol.messages import (
    EvaluationChunk,
    Policies,
    PolicyChunk,
    Subject,
    Work,
    recipes_in,
)
from es_service.protocol.policies import POLICY_SLOTS, slots
from es_service.protocol.recipes import Recipes


def pieces_of(work: Work, most: int) -> list[Work]:
    """A chunk in pieces with at most `most` episodes each; chunks of training and of gradients are one piece."""
    subject, chunk = work
    if isinstance(chunk, EvaluationChunk):
        starts = range(0, chunk.episodes, most)
        return [
            (subject, replace(chunk, first=chunk.first + start, episodes=min(most, chunk.episodes - start)))
            for start in starts
        ]
    if isinstance(chunk, PolicyChunk) and isinstance(subject, Policies):
        count = len(slots(subject, chunk)[0])
        starts = range(0, count, most)
        return [
            (subject, replace(chunk, first=chunk.first + start, count=min(most, count - start))) for start in starts
        ]
    return [work]


def together(work: Sequence[Work], most: int) -> list[Work]:
    """A work item as it is sent: neighbouring policies of one ask that are made of recipes and have one episode each
    are one chunk, as far as they are at most `most`, and all recipes have the parents that they need.

    The slots of policies with more episodes, or with observation statistics, stay as they are.
    """
    groups: list[list[Work]] = []
    for subject_chunk in work:
        if groups and _goes_on(groups[-1], subject_chunk, most):
            groups[-1].append(subject_chunk)
        else:
            groups.append([subject_chunk])
    sent: dict[int, Subject] = {}  # by `id`, since chunks with the same policies share them
    merged = []
    for group in groups:
        (subject, chunk), recipes = group[0], [recipes_in(its_subject) for its_subject, _ in group]
        if id(subject) not in sent:
            sent[id(subject)] = subject
            if isinstance(subject, Policies) and recipes[0] is not None:
                sent[id(subject)] = replace(subject, parameters_N_D=_joined(recipes).part(slice(None)))
        if isinstance(chunk, PolicyChunk) and len(group) > 1:
            chunk = replace(chunk, count=sum(len(part) for part in recipes if part is not None))
        merged.append((sent[id(subject)], chunk))
    return merged


def _joined(recipes: Sequence[Recipes | None]) -> Recipes:
    """Recipes of one ask, one after another."""
    parts = [part for part in recipes if part is not None]
    if len(parts) == 1:
        return parts[0]
    of_all = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ("parent_N_2", "key_N_4")}
    return replace(parts[0], **of_all)


def _goes_on(group: Sequence[Work], work: Work, most: int) -> bool:
    """Whether the policies of a chunk are the next ones after those of a group."""
    (subject, chunk), (before, last), (beginning, _) = work, group[-1], group[0]
    recipes, earlier = recipes_in(subject), recipes_in(before)
    return (
        recipes is not None
        and earlier is not None
        and recipes.names is earlier.names  # those of one ask
        and isinstance(subject, Policies)
        and isinstance(before, Policies)
        and isinstance(beginning, Policies)
        and subject.first + len(recipes) - beginning.first <= most
        and subject.episodes == 1
        and subject.observation_mean_N_O is before.observation_mean_N_O is None
        and subject == replace(before, first=before.first + len(earlier), parameters_N_D=recipes)
        and chunk == replace(last, chunk_id=last.chunk_id + 1)
        and isinstance(chunk, PolicyChunk)
        and (chunk.part, chunk.first, chunk.count) == (0, 0, POLICY_SLOTS)
    )
