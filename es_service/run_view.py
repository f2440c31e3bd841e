"""A run as its reader sees it: history as a DataFrame, policies as NumPy functions. Reading never changes a run."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from es_service import digest as run_digest
from es_service.algorithms.base import member_from_arrays, member_part
from es_service.novelty import archive_from_parts
from es_service.protocol import FloatArray, PolicyShape
from es_service.run_state import best_from_arrays, moments_from_arrays
from es_service.statistics import normalisation
from es_service.store import reader
from es_service.store.schema import RunMeta
from workers.policy import act, normalise, split_layers

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Policy:
    """A trained controller, NumPy only: observation [O] or [..., O] -> action [..., A] in [-1, 1].

    It carries the observation statistics it runs with, so it needs nothing else.
    """

    shape: PolicyShape
    parameters_D: FloatArray
    observation_mean_O: FloatArray
    observation_std_O: FloatArray
    observation_clip: float | None

    def __call__(self, observation: Any) -> FloatArray:
        """Action for a raw (not normalised) observation; no action noise. Raises ValueError for another size."""
        observation = np.asarray(observation, np.float32)
        size = self.shape.widths[0]
        if observation.shape[-1:] != (size,):
            raise ValueError(
                f"this policy takes observations of {size} numbers, [..., {size}]; got {observation.shape}"
            )
        x = normalise(np, observation, self.observation_mean_O, self.observation_std_O, self.observation_clip)
        return act(np, split_layers(self.shape, self.parameters_D), x)


@dataclass(frozen=True)
class Run:
    """A run folder, opened for reading. Every access reads what is committed now, also while a driver is writing."""

    folder: Path

    @cached_property
    def meta(self) -> RunMeta:
        """What was fixed when the run was created."""
        return reader.read_meta(self.folder)

    @property
    def run_id(self) -> str:
        """Name of the run for ever, wherever its folder is moved."""
        return self.meta.run_id

    @property
    def config(self) -> dict[str, Any]:
        """The resolved config the run was created with."""
        return self.meta.config

    @property
    def constants(self) -> dict[str, Any]:
        """What cannot change in this run: dotted key -> value."""
        return self.meta.constants

    @property
    def history(self) -> pd.DataFrame:
        """One row per generation, indexed by generation; columns are documented in `es_service.history`."""
        import pandas as pd  # a quarter of a second that starting a run need not spend

        columns = [column.name for column in self.meta.columns]
        return pd.DataFrame(self.history_rows(), columns=pd.Index(columns)).set_index("generation")

    def history_rows(self, since_generation: int | None = None) -> list[dict[str, Any]]:
        """History as dictionaries, oldest first; only from `since_generation` on if given."""
        return reader.read_history(self.folder, since_generation)

    def parts(self, generation: int | None = None) -> tuple[int, dict[str, dict[str, np.ndarray]]]:
        """(generation, state parts), verified; the newest, or one of the last two generations."""
        return reader.read_parts(self.folder, generation)

    @property
    def novelty(self) -> pd.DataFrame:
        """The novelty archive, one row per evaluated valid centre in order: generation, member, descriptor."""
        import pandas as pd

        names = self.meta.task["descriptor_names"]
        archive = archive_from_parts(self.parts()[1], len(names))
        columns = {"generation": archive.generation_N, "member": archive.member_N}
        return pd.DataFrame(columns | dict(zip(names, archive.descriptor_N_B.T, strict=True)))

    @property
    def generation(self) -> int | None:
        """Newest committed generation; None before the first."""
        return reader.read_generation(self.folder)

    def digest(self) -> str:
        """SHA-256 over everything deterministic in the run."""
        return run_digest.digest(self.folder)

    @property
    def policy_shape(self) -> PolicyShape:
        """Layer widths of this run's policies."""
        task = self.meta.task
        return PolicyShape((task["observation_size"], *self.constants["policy.hidden"], task["action_size"]))

    def policy(self, which: Literal["best", "centre"] = "best") -> Policy:
        """The best centre so far with the statistics it was evaluated with, or the newest centre with the newest."""
        at, parts = self.parts()
        clip = self.constants["policy.observation_clip"]
        if which == "best":
            best = best_from_arrays(parts["best"])
            return Policy(self.policy_shape, best.centre_D, best.observation_mean_O, best.observation_std_O, clip)
        if which != "centre":
            raise ValueError(f"policy({which!r}): choose 'best' or 'centre'")
        enabled = self.constants["policy.observation_normalization"]
        mean_O, std_O = normalisation(moments_from_arrays(parts["observations"]), enabled)
        return Policy(self.policy_shape, self.newest_centre(at, parts), mean_O, std_O, clip)

    def newest_centre(self, generation: int, parts: Mapping[str, Mapping[str, np.ndarray]]) -> FloatArray:
        """The centre that the history row of `generation` is about, `parts` being the state of that generation."""
        member = int(self.history_rows(generation)[0]["member"])
        return member_from_arrays(parts[member_part(member)]).centre_D


def open_run(folder: str | os.PathLike[str]) -> Run:
    """Open a run folder for reading.

    Raises:
        StoreError: not a run folder, or written by a newer version.
    """
    run = Run(Path(folder))
    _ = run.meta  # fail here, not at the first access
    return run
