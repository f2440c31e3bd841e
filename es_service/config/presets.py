"""Presets: values of the keys on which the sources differ, which fill in what a config leaves out.

Each row stands in the class of settings that it is about: `config/search.py` has those of all methods, and a method's
file its own. A key written in the config wins, and the run's own `config.yaml` records every value, so a later change
of a row changes no existing run.

Sources named in rows: ES-starter is OpenAI's evolution-strategies-starter (Salimans et al. 2017, arXiv:1703.03864); DNE
is Uber's deep-neuroevolution (Conti et al. 2018, arXiv:1712.06560); ME-ES is Uber's Map-Elites-Evolutionary (Colas et
al. 2020, arXiv:2003.01825); MEMES is adaptive-intelligent-robotics/MEMES (Flageat et al. 2024, arXiv:2303.06137). All
values are from their code, not from the papers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

PRESETS = MappingProxyType(
    {
        "literature": "values of independent implementations; our own choice where they specify none",
        "uber": "values of the authors' released ME-ES code",
    }
)
"""Preset name -> its meaning. Each name is also a column of the table."""


@dataclass(frozen=True)
class PresetRow:
    """One config key on which the presets differ, or in which a method differs from the others."""

    key: str
    """Dotted name in the config, such as `search.pairs`."""
    literature: object
    uber: object
    source: str
    """Where both values come from, and what is our own choice."""
    method: str | None = None
    """The only `search.algorithm` that the row is for, though others have the key too; None: all that have the key."""


def same(key: str, value: object, source: str) -> PresetRow:
    """A row with one value for both presets, in which a method differs from the others."""
    return PresetRow(key, value, value, f"literature: {source}. uber: the same.")


def preset_rows(settings: type[Any]) -> list[PresetRow]:
    """Rows for a method with these settings: those of the classes above it first, its own last."""
    return [row for above in reversed(settings.__mro__) for row in vars(above).get("presets", ())]


def preset_values(preset: str, settings: type[Any]) -> dict[str, object]:
    """Values of one preset for a method with these settings: dotted key -> value. Raises KeyError if it is unknown."""
    if preset not in PRESETS:
        raise KeyError(preset)
    return {row.key: getattr(row, preset) for row in preset_rows(settings)}


def preset_table(algorithms: Mapping[str, Any]) -> list[PresetRow]:
    """Rows of all methods, for documentation: those for several methods first."""
    rows: dict[int, PresetRow] = {}
    for name, method in algorithms.items():
        settings = method.settings
        added_keys = {f"search.{key}" for key in settings.model_fields.keys() - settings.__base__.model_fields.keys()}
        added_rows = vars(settings).get("presets", ())
        rows |= {
            id(row): replace(row, method=name) if row in added_rows and row.key not in added_keys else row
            for row in preset_rows(settings)
        }
    return sorted(rows.values(), key=lambda row: row.method is not None)
