"""Settings that several methods share, and how a method reads its own."""

from __future__ import annotations

from typing import Literal, TypeVar

from pydantic import Field

from es_service.config.model import RunConfig
from es_service.config.parts import CountAtOnce, ElitesOfCentres, Objectives, Once, outputs_of
from es_service.config.search import PopulationConfig, SearchConfig
from es_service.errors import ConfigError

Settings = TypeVar("Settings", bound=SearchConfig)
ELITES = (
    "How the elites of the map are measured. `once`: when they enter it, and never again. The other kinds keep several "
    "policies in each cell and measure some of them again in each generation. What was luck then falls, moves to "
    "another cell or leaves. `eme`: Extract-ME. `archive_sampling`: all of them, in every generation. `me_sampling`: "
    "new policies many times, and none again. `deep_grid`: each policy once; it replaces any. Only a method that makes "
    "single policies has the last two."
)


def settings_of(config: RunConfig, kind: type[Settings]) -> Settings:
    """The section `search` of a config, which has the keys of `kind`.

    Raises:
        ConfigError: it has not, because a search of the user that calls one of ours has declared other settings.
    """
    if isinstance(config.search, kind):
        return config.search
    raise ConfigError(
        f"the search {config.search.algorithm} has settings of the class {type(config.search).__name__}, but what it "
        f"calls needs {kind.__name__}; declare a class that derives from it, with the decorator `method`",
        field="search.algorithm",
        value=config.search.algorithm,
    )


class CentresSettings(PopulationConfig):
    """Keys of methods with several centres, of which a generation updates one or all.

    Five centres are the meta-population of Conti et al. 2018; source: deep-neuroevolution's Humanoid settings and the
    released ME-ES code.
    """

    update: Literal["one", "all"] = Field(
        "one",
        description="How many of the centres a generation updates. `one`: that of `search.centre_choice`. `all`: "
        "every centre, with `search.pairs` pairs each.",
    )
    centre_choice: Literal["novelty", "round_robin", "uniform"] = Field(
        "novelty",
        description="How the centre to update is chosen. `novelty`: with probability proportional to its novelty. "
        "`round_robin`: in turn. `uniform`: all with the same probability.",
    )

    first_centres = 5
    family = "several centres"

    def populations(self) -> int:
        """One, or one for each centre."""
        return self.centres if self.update == "all" else 1

    def spread_keys(self) -> tuple[str, ...]:
        """The key that makes more populations."""
        return ("search.centres",) if self.update == "all" else ("search.update",)


class UndeclaredSettings(CentresSettings):
    """Keys of a search of the user that declares none. It may ask for a population around each centre."""

    first_centres = 1
    family = ""

    def populations(self) -> int:
        """One for each centre, since it is not known for how many it asks."""
        return self.centres

    def spread_keys(self) -> tuple[str, ...]:
        """None, since it is not known what it asks for."""
        return ()


class EmittersSettings(PopulationConfig):
    """Keys of methods with one centre for each of several emitters, which start from elites of the map."""

    emitters: CountAtOnce = Field(
        1,
        description="Number of evolution strategies side by side, with `search.pairs` pairs each in every generation.",
    )
    mode: Literal["explore_exploit", "explore", "exploit"] = Field(
        "explore_exploit",
        description="What an emitter, or a block, maximises. `explore`: novelty. `exploit`: fitness. "
        "`explore_exploit`: one of the two, by turns unless `search.alternation` says otherwise.",
    )
    objectives: Objectives | None = Field(
        None,
        description="What blocks, or emitters, maximise in turn, as a list of objectives, such as `[{kind: novelty}, "
        "{kind: target, descriptor: [35, -25], radius: 5}]`; `null`: what `search.mode` says, which is ignored "
        "otherwise.",
    )
    parent_statistics: Literal["global", "elite"] = Field(
        "global",
        description="Observation statistics that a block uses. `global`: those of the whole run. `elite`: those with "
        "which the elite at its start was evaluated. With `elite`, all elites descend from the first centre and keep "
        "its statistics, so observations are not normalised unless the run started from a policy of another run.",
    )

    elites: ElitesOfCentres = Field(Once(), discriminator="kind", description=ELITES)

    only_centres = "search.emitters"

    def populations(self) -> int:
        """One for each emitter."""
        return self.emitters

    def spread_keys(self) -> tuple[str, ...]:
        """The key that makes more populations."""
        return ("search.emitters",)

    def outputs(self) -> tuple[str, ...]:
        return outputs_of(self.objectives or ())
