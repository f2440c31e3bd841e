"""What a run starts from: `search.init_from`, and whether it is there."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Mapping
from typing import Any

from es_service.config.problems import unfit
from es_service.errors import Problem


def start_of(init_from: str) -> tuple[str, str | tuple[int, ...]]:
    """What `search.init_from` names: (folder of a run, "centre" for the one updated last, "best", or a cell's place).

    RUN, RUN:best and RUN:3,17; a folder whose own name ends so is meant if there is one.
    """
    folder, _, which = init_from.rpartition(":")
    if not folder or os.path.isdir(init_from) or not re.fullmatch(r"best|\d+(,\d+)*", which):
        return init_from, "centre"
    return folder, which if which == "best" else tuple(map(int, which.split(",")))


def folder_problems(values: Mapping[str, Any]) -> list[Problem]:
    """Where the config names a run that is not there."""
    start = values.get("search.init_from")
    if start is None:
        return []
    folder, _ = start_of(start)
    try:
        found = os.stat(folder)
    except (FileNotFoundError, NotADirectoryError):
        what = "does not exist"
    except (OSError, ValueError) as error:  # in a folder that may not be looked into, too long, a null character
        what = f"cannot be looked at ({getattr(error, 'strerror', error)})"
    else:
        what = "" if stat.S_ISDIR(found.st_mode) else "is a file"
    allowed = "the folder of another run, or null"
    return [unfit("search.init_from", start, f"{folder} {what}; must be {allowed}", allowed=allowed)] if what else []
