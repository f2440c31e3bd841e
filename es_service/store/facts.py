"""What a run folder says of itself, checked before anything uses it: it may come from a stranger.

All JSON of a run is read by `facts`. Its size and depth are bounded, it has the form that readers rely on, and ids are
hexadecimal digits, so that nothing that a run says can act as a path, a pattern or a query. A SHA-256 says nothing
about this: whoever writes other contents can write their SHA-256, too.
"""

from __future__ import annotations

import json
import reprlib
import sqlite3
from collections.abc import Collection, Sequence
from datetime import datetime
from functools import cache
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    StringConstraints,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from es_service.config.model import COMPUTE_CONSTANTS
from es_service.config.resolution import policy_spec_of
from es_service.loop.history import Column
from es_service.protocol.messages import TaskSpec

MOST_BYTES = 64 * 1024 * 1024
"""Most bytes of a text of a run."""
DEEPEST = 32
"""Most levels of lists and mappings inside each other."""
MOST_PARAMETERS = 2**31
"""Most parameters of a policy."""
GENERATION = Column("generation", "INTEGER", True, "generation that evaluated the centre")
"""The column before those of the evaluated centres."""
POLICY = ("hidden", "activation", "output", "bias", "memory")


class Damaged(Exception):  # noqa: N818 (caught inside the store, which then repairs or reports the damage)
    """A database is damaged; the message describes the damage, with "it" for the file."""


def said_by(error: Exception) -> str:
    """What an error says, without the bytes of a text that is no UTF-8, which SQLite's repeats with its newlines."""
    return str(error).partition(" with text ")[0] if isinstance(error, sqlite3.Error) else str(error)


def _known_time(text: str) -> str:
    """A time that can be computed with; others raise ValueError."""
    if not 1970 < (time := datetime.fromisoformat(text)).year < 9999 or time.tzinfo is None:
        raise ValueError("must be an ISO time of a known zone, such as 2025-01-01T00:00:00+00:00")
    return text


Id = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]
Time = Annotated[str, AfterValidator(_known_time)]
Natural = Annotated[int, Field(ge=0, lt=2**63)]
Size = Annotated[int, Field(ge=1, le=2**24)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Form(BaseModel):
    """Types of what a mapping must have; it may have more. Two underscores in a name stand for a dot."""

    model_config = ConfigDict(alias_generator=lambda name: name.replace("__", "."), extra="allow")


class Constants(Form):
    """Settings that readers of a run use (`RunMeta.constants`)."""

    seed: Annotated[int, Field(ge=-(2**63), lt=2**64)]
    task__environment: str
    task__episode_steps: Natural
    policy__hidden: list[Size]
    policy__activation: str = ""
    policy__output: str = ""
    policy__bias: bool = True
    policy__memory: Size | None = None
    policy__observation_clip: float | None
    policy__observation_normalization: bool
    search__algorithm: str
    search__step__kind: str | None = None
    map__enabled: bool
    map__cells: list[Size] | None = None
    map__bounds: list[tuple[Finite, Finite]] | None = None
    map__qd_offset: float | None = None
    compute__rollout: str


class Parent(Form):
    """The run from which a run was forked, or took its first centre (`RunMeta.parent`)."""

    run_id: Id
    folder: str
    generation: Natural
    digest: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")] | None
    rollouts: list[str] = []
    certifications: Natural = 0


class Platform(Form):
    """What computed generations (`protocol.machine.platform_info`)."""

    code: dict[str, str] = {}


class TaskSection(Form):
    fitness: Literal["sum", "final"]


class Config(Form):
    """Sections of a config that readers of a run use (`RunMeta.config`)."""

    task: TaskSection
    policy: dict[str, Any]
    search: dict[str, Any]
    budget: dict[str, Any]
    compute: dict[str, Any]
    store: dict[str, Any] = {}

    @model_validator(mode="after")
    def _has_constants(self) -> Config:
        if missing := set(COMPUTE_CONSTANTS) - self.compute.keys():
            raise ValueError(f"lacks compute.{min(missing)}")
        return self


class RunFacts(BaseModel):
    """The description of a run (`schema.RunMeta`)."""

    model_config = ConfigDict(extra="forbid")
    run_id: Id
    created: Time
    config: Config
    constants: Constants
    task: TaskSpec
    columns: list[Column]
    evaluation_columns: list[Column]
    parent: Parent | None = None
    given: dict[str, Any] | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> RunFacts:
        """Raises ValueError if two columns have one name, or sizes do not fit."""
        if problem := column_problem(self.columns) or column_problem([GENERATION, *self.evaluation_columns]):
            raise ValueError(problem)
        names, bounds = self.task.descriptor_names, self.task.descriptor_bounds
        if not 1 <= len(names) == len(bounds) == len(set(names)):
            raise ValueError("the task has not one name and one pair of bounds for each dimension of its descriptor")
        if not all(low < high for low, high in bounds):
            raise ValueError("the task has bounds whose low end is not below the high one")
        if not min(self.task.observation_size, self.task.action_size) >= 1:
            raise ValueError("the task has no observations or no actions")
        values = {f"policy.{name}": getattr(self.constants, f"policy__{name}") for name in POLICY}
        spec = policy_spec_of(values, self.task.observation_size, self.task.action_size)
        if max(spec.widths) > MOST_PARAMETERS or spec.parameters > MOST_PARAMETERS:
            raise ValueError(f"the policy has more than {MOST_PARAMETERS} parameters")
        return self


def facts(text: object, form: Any, what: str, *, has_paths: bool = False) -> Any:
    """A JSON text of a run as values, which have a form.

    Args:
        form: a type; its mappings may be dataclasses or subclasses of `Form`.
        what: the text in words, for the message.
        has_paths: whether it has names of files, which may be no UTF-8.

    Raises:
        Damaged: it is too large or too deep, is no JSON, or has another form; the message names the place.
    """
    if not isinstance(text, str | bytes) or len(text) > MOST_BYTES:
        raise Damaged(f"{what} is no text of at most {MOST_BYTES} bytes")
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise Damaged(f"{what} cannot be read: {error}") from error
    level = [value]
    for _ in range(DEEPEST):
        inside = [part for part in level if isinstance(part, dict | list)]
        level = [one for part in inside for one in (part.values() if isinstance(part, dict) else part)]
    if any(isinstance(part, dict | list) for part in level):
        raise Damaged(f"{what} has more than {DEEPEST} lists and mappings inside each other")
    require_form(value, form, what, has_paths=has_paths)
    return value


def require_form(value: Any, form: Any, what: str, *, has_paths: bool = False) -> None:
    """Raise Damaged unless a value of JSON has a form; see `facts`."""
    try:
        text = json.dumps(value, ensure_ascii=False).encode(errors="replace" if has_paths else "strict")
        _checker(form).validate_json(text, strict=True)
    except UnicodeEncodeError as error:
        raise Damaged(f"{what} has text that is no UTF-8: {error}") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"])) or "its value"
        raise Damaged(f"{what}: {place}: {first['msg']}, not {reprlib.repr(first['input'])}") from error


@cache
def _checker(form: Any) -> TypeAdapter[Any]:
    return TypeAdapter(form)


def column_problem(columns: Sequence[Column], reserved: Collection[str] = ()) -> str:
    """Why no table can have these columns, and others with `reserved` names; empty if one can."""
    names = [column.name.casefold() for column in columns]
    twice = sorted({name for name in names if names.count(name) > 1})
    taken = sorted(set(names) & set(reserved))
    if not twice and not taken and ("generation", "INTEGER") in [(column.name, column.type) for column in columns]:
        return ""
    return (
        f"history columns: duplicate names {twice}, reserved names {taken}; give each column its own name, and include "
        "an INTEGER column `generation`"
    )
