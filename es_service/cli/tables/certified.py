"""Certified policies in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from es_service.cli.console import print_line
from es_service.errors import counted
from es_service.runs.certified import Certified, tries_sentence


def print_certified(console: Console, certified: list[Certified]) -> None:
    """Print a line for each policy of a certification."""
    for policy in certified:
        print_line(console, f"  {policy.title}: {certified_line(policy.row())}")


def certified_line(row: Mapping[str, Any]) -> str:
    """The values of a certified policy in words."""
    parts = [_mean("return", row, "return"), _mean("last reward", row, "last_reward")]
    if row["goal_distance_mean"] is not None:
        parts.append(_mean("least goal distance", row, "goal_distance"))
    if row["successes"] is not None:
        low, high = 100 * row["success_low"], 100 * row["success_high"]
        parts.append(f"success {row['successes']} of {row['episodes']} ({low:.1f} to {high:.1f} %)")
    chosen = (
        f"first of {row['candidates']:,}" if row["rank"] == 0 else f"number {row['rank'] + 1} of {row['candidates']:,}"
    )
    tries = f"; {tries_sentence(row['tries'])}" if row["tries"] else ""
    return f"{', '.join(parts)}; {counted(row['episodes'], 'episode')}, {chosen} by {row['selected_by']}{tries}"


def _mean(what: str, row: Mapping[str, Any], name: str) -> str:
    mean, low, high = (row[f"{name}_{end}"] for end in ("mean", "low", "high"))
    return f"{what} {mean:,.2f} [{low:,.2f}, {high:,.2f}]"
