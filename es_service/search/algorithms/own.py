"""Search algorithms of the user, named `package.module:function`.

    def function(config: RunConfig) -> Algorithm: ...

A function may declare options, numbers or texts that a config sets below `search.options`:

    @has_options(reach=Option(0.5, low=0.0))
    def function(config: RunConfig) -> Algorithm: ...    # config.search.options["reach"] is its value

`es_service.search.algorithms.base` defines `Algorithm`; `steps` has the functions that the shipped algorithms share.
Most searches of your own are a shipped one with one function replaced. A search remembers between generations only its
`SearchState`, which the run store keeps; a value kept anywhere else is lost when the process ends. The search runs in
the driver.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from es_service.config.model import RunConfig
from es_service.errors import ConfigError
from es_service.protocol.options import declared_options
from es_service.protocol.raised import raised, why_not_imported
from es_service.protocol.user_code import import_user_module, in_no_file
from es_service.search.algorithms.base import Algorithm


def import_factory(path: str) -> Callable[[RunConfig], object]:
    """The user's function, from its module as it is now; raises ConfigError if there is none or the import fails."""
    module, _, name = path.partition(":")
    if problem := in_no_file(path):
        raise ConfigError(problem)
    try:
        found = getattr(import_user_module(path), name, None)
    except Exception as error:  # the user's code can raise anything
        raise ConfigError(why_not_imported(module, error)) from error
    if not callable(found):
        needed = "es_service/search/algorithms/own.py describes the function that is needed"
        raise ConfigError(f"{module} has no function {name!r}; {needed}")
    return found


def own_factory(path: str) -> Callable[[RunConfig], Algorithm]:
    """What makes the user's search for a run, with the options that its function declares in an attribute `options`.

    Raises:
        ConfigError: the function cannot be imported, or its options are wrong.
    """
    function = import_factory(path)
    options, wrong = declared_options(function)
    if wrong:
        raise ConfigError(f"{path}: {'; '.join(wrong)}")
    factory = partial(_make, path, function)
    factory.options = options  # pyright: ignore[reportAttributeAccessIssue]
    return factory


def _make(path: str, function: Callable[[RunConfig], object], config: RunConfig) -> Algorithm:
    """Call the user's function for a run.

    Raises ConfigError if this fails or does not return an `Algorithm`, or if the function declares other options than
    when the config was loaded, which has values of those.
    """
    before, now = config.resolved_search_options, declared_options(function)[0]
    if before is not None and dict(before) != now:
        raise ConfigError(
            f"the options of the search {path} have changed since this config was loaded; load the config again",
            field="search.options",
            value=path,
        )
    try:
        made = function(config)
    except Exception as error:  # the user's code can raise anything
        raise ConfigError(f"search.algorithm: {path} raised {raised(error, path)}") from error
    if not isinstance(made, Algorithm):
        raise ConfigError(
            f"search.algorithm: {path} returned {made!r}; it must return an es_service.search.algorithms.base.Algorithm"
        )
    return made
