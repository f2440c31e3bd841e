"""Parses `search.init_from`, the policy that a run starts from, and checks that its folder exists."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Mapping
from typing import Any

from es_service.config.problems import problem_of
from es_service.errors import Problem


def start_of(init_from: str) -> tuple[str, str | tuple[int, ...]]:
    """Parse `search.init_from`: (folder of a run, "centre" for the one updated last, "best", or the index of a cell).

    The forms are RUN, RUN:best and RUN:3,17. If a folder has the whole text as its name, that folder is used.
    """
    folder, _, which = init_from.rpartition(":")
    if not folder or os.path.isdir(init_from) or not re.fullmatch(r"best|\d+(,\d+)*", which):
        return init_from, "centre"
    return folder, which if which == "best" else tuple(map(int, which.split(",")))


def folder_problems(values: Mapping[str, Any]) -> list[Problem]:
    """The problem of a `search.init_from` that does not name an existing folder."""
    start = values.get("search.init_from")
    if start is None:
        return []
    folder, _ = start_of(start)
    try:
        status = os.stat(folder)
    except (FileNotFoundError, NotADirectoryError):
        what = "does not exist"
    except (OSError, ValueError) as error:  # permission denied, too long, or a null character
        what = f"cannot be accessed ({getattr(error, 'strerror', error)})"
    else:
        what = "" if stat.S_ISDIR(status.st_mode) else "is a file"
    allowed = "the folder of another run, with :best or a cell as :3,17 after it if wanted, or null"
    return (
        [problem_of("search.init_from", start, f"{folder} {what}; must be {allowed}", allowed=allowed)] if what else []
    )
