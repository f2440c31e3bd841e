"""Certified policies in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from es_service.cli.console import print_line
from es_service.errors import counted
from es_service.report.facts import number
from es_service.runs.certified import Certified, pairs_sentence, tries_sentence


def print_certified(console: Console, certified: list[Certified]) -> None:
    """Print a line for each policy of a certification, and one more for its episodes in another task."""
    for policy in certified:
        print_line(console, f"  {policy.title}: {certified_line(policy.row())}")
        if policy.elsewhere is not None:
            print_line(console, f"  {policy.title} in {policy.elsewhere.title}: {elsewhere_line(policy.row())}")


def certified_line(row: Mapping[str, Any]) -> str:
    """The values of a certified policy in words."""
    chosen = (
        f"first of {row['candidates']:,}" if row["rank"] == 0 else f"number {row['rank'] + 1} of {row['candidates']:,}"
    )
    tries = f"; {tries_sentence(row['tries'])}" if row["tries"] else ""
    episodes = counted(row["episodes"], "episode")
    return f"{', '.join(_values(row))}; {episodes}, {chosen} by {row['selected_by']}{tries}"


def elsewhere_line(row: Mapping[str, Any]) -> str:
    """The values of a certified policy in another task in words, each with its gap."""
    episodes = counted(row["elsewhere_episodes"], "episode")
    return f"{', '.join(_values(row, 'elsewhere_'))}; {episodes}, {pairs_sentence(paired=row['elsewhere_paired'])}"


def _values(row: Mapping[str, Any], prefix: str = "") -> list[str]:
    """What the columns of a row say that begin with a prefix."""
    means = {"return": "return", "last_reward": "last reward", "goal_distance": "least goal distance"}
    parts = [
        f"{what} {_interval(row, f'{prefix}{name}')}{_gap(row, name, prefix)}"
        for name, what in means.items()
        if row[f"{prefix}{name}_mean"] is not None
    ]
    if row[f"{prefix}successes"] is not None:
        low, high = (100 * row[f"{prefix}success_{end}"] for end in ("low", "high"))
        count = f"{row[f'{prefix}successes']} of {row[f'{prefix}episodes']}"
        parts.append(f"success {count} ({low:.1f} to {high:.1f} %){_gap(row, 'success', prefix, 100.0, ' %')}")
    return parts


def _gap(row: Mapping[str, Any], name: str, prefix: str, scale: float = 1.0, unit: str = "") -> str:
    if not prefix or row[f"gap_{name}_mean"] is None:
        return ""
    mean, low, high = (_signed(scale * row[f"gap_{name}_{end}"]) for end in ("mean", "low", "high"))
    return f" (gap {mean} [{low}, {high}]{unit})"


def _signed(value: float) -> str:
    return f"{'+' if value >= 0.0 else ''}{number(value)}"


def _interval(row: Mapping[str, Any], name: str) -> str:
    mean, low, high = (row[f"{name}_{end}"] for end in ("mean", "low", "high"))
    return f"{mean:,.2f} [{low:,.2f}, {high:,.2f}]"
