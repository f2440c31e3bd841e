"""A small run of ME-ES, whose map is full enough to ask things of."""

from __future__ import annotations

from pathlib import Path

from es_service import api

CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 60, "options": {"start": "corner"}},
    "policy": {"hidden": [8]},
    "search": {
        "algorithm": "me_es",
        "pairs": 16,
        "sigma": 0.2,
        "step": {"learning_rate": 0.3, "l2": 0.0},
        "evaluation_episodes": 4,
        "block_generations": 4,
    },
    "map": {"cells": [16, 16]},
    "budget": {"generations": 40},
    "compute": {"engine": "inline", "workers": 1, "chunk_pairs": 4, "gradient_block_pairs": 8},
}


def run(folder: Path, *overrides: str, config=CONFIG, **callbacks):
    return api.run(api.load_config(config, overrides), folder, **callbacks).run
