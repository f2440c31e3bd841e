"""How settings of compared runs are named in pages and figures."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from es_service.config.keys import FIELDS, all_search_fields
from es_service.config.text import in_line
from es_service.search.algorithms import ALGORITHMS

ALGORITHM = "search.algorithm"


def settings_words(settings: Mapping[str, Any]) -> str:
    """Some settings in words: "sigma = 0.1, newest = no limit". The method has its name alone.

    A key has its section only if another one of these keys ends in the same name.
    """
    leaves = [key.rpartition(".")[2] for key in settings]
    words = []
    for leaf, (key, value) in zip(leaves, settings.items(), strict=True):
        text = _meaning_of_null(key) if value is None else in_line(value)
        name = leaf if leaves.count(leaf) == 1 else key
        words.append(text if key == ALGORITHM else f"{name} = {text}")
    return ", ".join(words)


@cache
def _meaning_of_null(key: str) -> str:
    """What the description of a key says of null; "none" if it says nothing short."""
    field = FIELDS.get(key) or all_search_fields(ALGORITHMS).get(key)
    found = re.search(r"\bnull: ([^.,;]{1,40})[.,;]", (field and field.description) or "")
    return found[1] if found else "none"
