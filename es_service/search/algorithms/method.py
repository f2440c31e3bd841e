"""A search method: a function that makes an `Algorithm` for a run, with the class of its settings.

class MySettings(PopulationConfig):
    reach: float = Field(0.5, ge=0.0, description="...")     # a key of the config, `search.reach`

@method(MySettings)
def my_search(config: RunConfig) -> Algorithm:
    reach = settings_of(config, MySettings).reach

A search of a user is named `package.module:function`. Without the decorator, it has the keys of
`settings.UndeclaredSettings`. `es_service.search.algorithms.base` defines `Algorithm`; `common` has the functions that
the shipped algorithms share. Most searches of your own are a shipped one with one function replaced. A search remembers
between generations only its `SearchState`, which the run store keeps; a value kept anywhere else is lost when the
process ends. The search runs in the driver.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from es_service.config.model import RunConfig
from es_service.config.search import SearchConfig
from es_service.errors import ConfigError
from es_service.protocol.user_code import import_user_module, in_no_file, raised, why_not_imported
from es_service.search.algorithms.base import Algorithm
from es_service.search.algorithms.settings import UndeclaredSettings


@dataclass(frozen=True)
class Method:
    """What makes the algorithm of a run from its config."""

    make: Callable[[RunConfig], Algorithm]
    settings: type[SearchConfig]
    """Its keys, and what it declares; see `es_service/config/search.py`."""
    name: str
    """Value of `search.algorithm`."""
    summary: str
    """What it does, in one sentence."""

    def __call__(self, config: RunConfig) -> Algorithm:
        return self.make(config)


def method(settings: type[SearchConfig]) -> Callable[[Callable[[RunConfig], Algorithm]], Method]:
    """Decorator that makes a method with these settings of a function, which has its name."""

    def declare(make: Callable[[RunConfig], Algorithm]) -> Method:
        summary = (make.__doc__ or "").strip().partition("\n")[0]
        return Method(make, settings, make.__name__, summary)

    return declare


def import_factory(path: str) -> Callable[[RunConfig], object]:
    """The user's function, from its module as it is now; raises ConfigError if there is none or the import fails."""
    module, _, name = path.partition(":")
    if problem := in_no_file(path):
        raise ConfigError(problem)
    try:
        factory = getattr(import_user_module(path), name, None)
    except Exception as error:  # the user's code can raise anything
        raise ConfigError(why_not_imported(module, error)) from error
    if not callable(factory):
        needed = "es_service/search/algorithms/method.py describes the function that is needed"
        raise ConfigError(f"{module} has no function {name!r}; {needed}")
    return factory


def user_method(path: str) -> Method:
    """The user's search with the settings that it declares, or with those of one that declares none.

    Raises:
        ConfigError: the function cannot be imported, or its settings are no class of settings.
    """
    factory = import_factory(path)
    made = factory if isinstance(factory, Method) else method(UndeclaredSettings)(factory)  # pyright: ignore[reportArgumentType]
    if not (isinstance(made.settings, type) and issubclass(made.settings, SearchConfig)):
        raise ConfigError(f"{path}: its settings are {made.settings!r}; they must be a class that derives from "
                          "es_service.config.search.SearchConfig or PopulationConfig")  # fmt: skip
    return replace(made, make=partial(_make, path, made), name=path)


def _make(path: str, made: Method, config: RunConfig) -> Algorithm:
    """Call the user's function for a run.

    Raises ConfigError if this fails or does not return an `Algorithm`, or if the function declares other settings than
    when the config was loaded, which has values of those.
    """
    before = type(config.search)
    if before is not made.settings:  # the module was imported anew
        if str(before.model_fields) != str(made.settings.model_fields):
            raise ConfigError(
                f"the settings of the search {path} have changed since this config was loaded; load the config again",
                field="search.algorithm",
                value=path,
            )
        config = config.model_copy(update={"search": made.settings.model_validate(config.search.model_dump())})
    try:
        algorithm = made.make(config)
    except Exception as error:  # the user's code can raise anything
        raise ConfigError(f"search.algorithm: {path} raised {raised(error, path)}") from error
    if not isinstance(algorithm, Algorithm):
        raise ConfigError(
            f"search.algorithm: {path} returned {algorithm!r}; it must return an "
            "es_service.search.algorithms.base.Algorithm"
        )
    return algorithm
