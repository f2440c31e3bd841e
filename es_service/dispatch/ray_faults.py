"""What messages say about a fault of a Ray actor."""

from __future__ import annotations

import re

from es_service.protocol.raised import RaisedError


def fault_reason(error: Exception) -> str:
    """Cause of an actor's fault, on one line."""
    first = error_text(error).strip().partition("\n")[0]
    known = {
        "OutOfMemoryError": "its node ran out of memory and Ray killed it",
        "ActorUnavailableError": "its node does not answer",
        "ActorDiedError": "its process or its node died",
    }
    kind = type(error).__name__
    return f"{known.get(kind, kind)}: {first}"


def raised_in_actor(error: Exception) -> RaisedError:
    """The exception of an actor's call, which `workers.actor` has turned into texts."""
    cause = getattr(error, "cause", None)
    return cause if isinstance(cause, RaisedError) else RaisedError(error_text(error), "")


def error_text(error: Exception) -> str:
    """Text of an error without the colour codes that Ray adds."""
    return re.sub(r"\x1b\[[0-9;]*m", "", str(error))
