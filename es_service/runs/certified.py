"""Certified policies: their values in episodes that no choice has seen, as a run stores them.

Beside them are the decisions: episodes of best centres that say whether a run has reached `budget.target_certified`.
Who asks that reads only decisions, and who reports a value reads only the others.

Axes: E episodes, D policy parameters, O observation, B descriptor dimensions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from numpy.typing import NDArray
from pydantic import create_model

from es_service.config.text import show
from es_service.errors import StoreError, decimals
from es_service.loop.forms import BOOL, INTEGER, POLICY, REAL, array_problem
from es_service.protocol.content import OF_POLICY, Policy, names, policy_of
from es_service.protocol.noise import Domain, seed_for
from es_service.runs.selection import (
    RankedBy,
    StoredEpisodes,
    false_pass_share,
    gap_interval,
    interval_columns,
    share_gap_interval,
)
from es_service.runs.snapshot import sizes_of, stored_policy_spec, stored_task
from es_service.store.facts import Damaged, Form, require_form
from es_service.store.reader import read_certifications, read_meta
from es_service.store.records import CertifiedRow
from es_service.store.schema import RunMeta

EPISODES = 256
"""Certification episodes of a policy, unless a call says otherwise; and the episodes of a decision."""
SHOWN_TRIES = 10
"""Most decisions whose values a sentence shows."""
BELOW = 0.1
"""Standard deviations below a target of the policies by which it is said how easily a decision is lucky."""


@dataclass(frozen=True)
class Elsewhere:
    """The episodes of a certified policy in another task."""

    task: str
    options: Mapping[str, Any]
    """Options of the task that were set; others have its defaults."""
    descriptor: str | list[int] | None
    """Descriptor that was chosen for it, as in a config; None: that of the task."""
    rollout: str
    paired: bool
    """Whether episode e begins with the same observation in both tasks, for all e. If not, each task has drawn its own
    starts, and its episodes do not depend on those of the other."""
    episodes: StoredEpisodes

    @property
    def title(self) -> str:
        """`task_title` of the task and the options that were set."""
        return task_title(self.task, self.options)

    def gaps(self, here: StoredEpisodes) -> dict[str, float | None]:
        """How much higher each mean and the share of successes are than `here`, with intervals, by column name; None
        for what one of the tasks does not have."""
        columns: dict[str, float | None] = {}
        there = self.episodes.measures
        for name, here_E in here.measures.items():
            interval_of = share_gap_interval if name == "success" else gap_interval
            lacks = here_E is None or there[name] is None
            gap = None if lacks else interval_of(here_E, there[name], paired=self.paired)
            columns |= interval_columns(f"gap_{name}", gap)
        return columns


def task_title(task: str, options: Mapping[str, Any]) -> str:
    """A task with its options in words: "mujoco:Ant-v5 (solver_iterations = 6)"."""
    shown = ", ".join(f"{name} = {show(value)}" for name, value in options.items())
    return f"{task} ({shown})" if shown else task


@dataclass(frozen=True)
class Certified:
    """A policy with its certification episodes."""

    number: int
    """Number of the certification among those of the run, from 0; for other policies the one that was given."""
    rank: int
    """Place by the selection episodes, from 0."""
    name: str
    """Name of the candidate: "best", "centre", the place of its cell, or the number of a policy of the caller's."""
    generation: int | None
    """Generation in which the run evaluated it."""
    stored_fitness: float | None
    """Fitness that the run stored for it: selected, not certified."""
    selected_by: RankedBy
    selection_mean: float | None
    """Mean of this measure over its selection episodes; None if it was the only candidate and had none."""
    selection_episodes: int
    candidates: int
    """Number of policies from which it was chosen."""
    selection_steps: int
    """Environment steps of all selection episodes of the certification, which belong to the cost of the result."""
    decides: bool
    """Whether the episodes decided if the run has reached `budget.target_certified`."""
    tries: int
    """Number of this decision, from 1, or of those until the run was over; 0 if no decision belongs to it."""
    platform: Mapping[str, Any]
    """Packages, processor and code that computed it; see `runs.checked_config.changes_since`."""
    episodes: StoredEpisodes
    policy: Policy
    elsewhere: Elsewhere | None = None
    """The same policy in another task; None if it was not asked for."""
    env_steps: int | None = None
    """Environment steps of the run at the generation from which the candidates were taken; None if it is not known: in
    runs of versions before 0.27, and for other policies."""

    @property
    def title(self) -> str:
        """Its name and the generation of its policy, since another one may have the name by now: "4,18 of generation
        120"."""
        return self.name if self.generation is None else f"{self.name} of generation {self.generation:,}"

    def resets(self, seed: int) -> tuple[int, Domain]:
        """Seed and domain of the resets of its episodes, those of a run with this seed."""
        if self.decides:
            return seed, Domain.DECISION_RESET
        return resets_of(seed, None if self.elsewhere is None else self.elsewhere.task)

    def row(self) -> dict[str, Any]:
        """The policy as a row of a table.

        Only with episodes in another task, it has the columns `elsewhere` (the title of the task), `elsewhere_*` (its
        values there) and `gap_*` (how much higher these are than those in the run's task, with intervals).
        """
        there: dict[str, Any] = {}
        if self.elsewhere is not None:
            values = {"episodes": self.elsewhere.episodes.count, **self.elsewhere.episodes.values()}
            there = {"elsewhere": self.elsewhere.title, "elsewhere_paired": self.elsewhere.paired}
            there |= {f"elsewhere_{name}": value for name, value in values.items()}
            there |= self.elsewhere.gaps(self.episodes)
        return {
            "certification": self.number,
            "rank": self.rank,
            "policy": self.name,
            "generation": self.generation,
            "stored_fitness": self.stored_fitness,
            "candidates": self.candidates,
            "selected_by": self.selected_by,
            "selection_mean": self.selection_mean,
            "selection_episodes": self.selection_episodes,
            "selection_steps": self.selection_steps,
            "decides": self.decides,
            "tries": self.tries,
            "env_steps": self.env_steps,
            "episodes": self.episodes.count,
            **self.episodes.values(),
            **there,
        }


def resets_of(seed: int, task: str | None) -> tuple[int, Domain]:
    """Seed and domain of the resets of certification episodes of a run with this seed.

    Args:
        task: name of the other task in which the policies are certified, too: episode e has the same reset in both,
            and no other certification has it.
    """
    return (seed, Domain.CERTIFICATION_RESET) if task is None else (seed_for(seed, task), Domain.OTHER_TASK_RESET)


def all_certifications(folder: Path) -> list[Certified]:
    """All certified policies and all decisions of a run, in the order of certification and rank. Raises StoreError if
    one is damaged."""
    rows = read_certifications(folder)
    meta = read_meta(folder)
    return [_from_row(folder, row, meta) for row in rows]


def certified_policies(folder: Path) -> list[Certified]:
    """All certified policies of a run, without the decisions; otherwise as `all_certifications`."""
    return [policy for policy in all_certifications(folder) if not policy.decides]


def certified_over_time(folder: Path) -> list[dict[str, Any]]:
    """The row of the policy that each certification of a run has put first, in order. Raises StoreError if one is
    damaged."""
    return [policy.row() for policy in certified_policies(folder) if policy.rank == 0]


def newest_certified(folder: Path) -> Certified | None:
    """The policy that the newest certification of a run has put first; None if there is none, or if damage has removed
    it. No older certification is read. Raises StoreError if it is damaged."""
    rows = read_certifications(folder, newest=lambda facts: not facts.get("decides"))
    first = next((row for row in rows if row.rank == 0), None)
    return None if first is None else _from_row(folder, first, read_meta(folder))


def certified_elsewhere(folder: Path) -> dict[str, Certified]:
    """Title of another task -> the policy that the newest certification in it has put first. Raises StoreError if a
    policy that was certified in another task is damaged."""
    rows = read_certifications(folder, holding=f'"{_ELSEWHERE}"')
    meta = read_meta(folder) if rows else None
    firsts = [_from_row(folder, row, meta) for row in rows if meta is not None and row.rank == 0]
    return {one.elsewhere.title: one for one in firsts if one.elsewhere is not None}


class CertifiedValue(NamedTuple):
    """What a certified policy does in a task, that of the run or another one."""

    policy: Certified
    episodes: StoredEpisodes


def certified_by_task(folder: Path) -> dict[str, CertifiedValue]:
    """Title of a task -> the value of the policy that the newest certification in it has put first.

    The run's own task is the first, if a policy is certified; its title names the options that are not its defaults. So
    a run that was trained in a task has its value under the same title as one that was only certified there. Raises
    StoreError if one of these policies is damaged.
    """
    values: dict[str, CertifiedValue] = {}
    if (newest := newest_certified(folder)) is not None:
        meta = read_meta(folder)
        settings, declared = meta.config["task"], stored_task(meta).options
        changed = {
            name: value
            for name, value in settings["options"].items()
            if name not in declared or value != declared[name].default
        }
        values[task_title(settings["environment"], changed)] = CertifiedValue(newest, newest.episodes)
    for title, policy in certified_elsewhere(folder).items():
        if policy.elsewhere is not None:
            values.setdefault(title, CertifiedValue(policy, policy.elsewhere.episodes))
    return values


def decisions(policies: Iterable[Certified]) -> list[Certified]:
    """Those of a run's certifications whose episodes decide if it has reached `budget.target_certified`."""
    return [policy for policy in policies if policy.decides and policy.episodes.count >= EPISODES]


def passed(policies: Iterable[Certified], target: float, fitness: str) -> Certified | None:
    """The newest decision whose mean fitness reaches a target; None if none does."""
    reaching = [one for one in decisions(policies) if one.episodes.mean_fitness(fitness) >= target]
    return reaching[-1] if reaching else None


def report_of(policies: Iterable[Certified], decision: Certified) -> Certified | None:
    """The certified value of a policy that has passed a decision: of later episodes, which decide nothing. None if it
    is still missing."""
    later = (one for one in policies if one.number > decision.number and not one.decides)
    return next((one for one in later if one.episodes.count >= EPISODES and is_same_policy(one, decision)), None)


def is_same_policy(one: Certified, other: Certified) -> bool:
    """Whether two certifications are of one policy."""
    return one.policy.name == other.policy.name


def measure_of(fitness: str) -> RankedBy:
    """What `task.fitness` says of an episode."""
    return "return" if fitness == "sum" else "last_reward"


def target_reached(folder: Path, target: float | None, fitness: str) -> str:
    """Why a run is over whose `budget.target_certified` and `task.fitness` these are, in words; empty if no decision
    reaches the target, or if the certified value of the policy that does is still missing."""
    if target is None:
        return ""
    policies = all_certifications(folder)
    decision = passed(policies, target, fitness)
    report = decision and report_of(policies, decision)
    if decision is None or report is None:
        return ""
    mean, value = (one.episodes.mean_fitness(fitness) for one in (decision, report))
    what = (
        f"the target {target:g} is reached: a policy of generation {decision.generation} has {mean:.6g} in the "
        f"{decision.episodes.count} episodes that decide"
    )
    below = ", below the target" if value < target else ""
    tries = f"try {report.tries:,} so far, with any target"
    return f"{what} ({tries}), and {value:.6g} in {report.episodes.count} further certified ones{below}"


def failed_tries(policies: Iterable[Certified], target: float | None, fitness: str) -> list[float]:
    """Mean fitness of each decision of a run that has not reached a target, in order; empty without one."""
    means = [one.episodes.mean_fitness(fitness) for one in decisions(policies)]
    return [] if target is None else [mean for mean in means if not mean >= target]


def failed_sentence(means: Sequence[float]) -> str:
    """What `failed_tries` returns in words, such as "2 tries, none held: -127.03, -127.06"; empty if it is empty."""
    if not means:
        return ""
    shown = ", ".join(decimals(mean) for mean in means[-SHOWN_TRIES:])
    newest = f" (the newest {SHOWN_TRIES})" if len(means) > SHOWN_TRIES else ""
    return f"1 try, did not hold: {shown}" if len(means) == 1 else f"{len(means):,} tries, none held: {shown}{newest}"


def tries_sentence(tries: int) -> str:
    """How easily a run of so many decisions ends by luck, in words. They may have been for other targets, which are not
    stored."""
    share = 100 * false_pass_share(tries, EPISODES, BELOW)
    which = "a policy" if tries == 1 else f"at least one of {tries:,} policies"
    lucky = f"{which} {BELOW:g} standard deviations below it would pass with {share:.1f} %"
    return f"try {tries:,} of the tries so far, with any target ({lucky})"


def pairs_sentence(*, paired: bool) -> str:
    """What the gap between the episodes of a policy in two tasks compares, in words."""
    return "with the same starts in both tasks" if paired else "with starts of their own in each task"


def arrays_of(episodes: StoredEpisodes) -> dict[str, NDArray[Any]]:
    return {name: array for name, array in vars(episodes).items() if array is not None}


_NAME, _ELSEWHERE = "policy", "elsewhere"
_FACTS = [
    field.name for field in fields(Certified) if field.name not in (_NAME, _ELSEWHERE, "number", "rank", "episodes")
]
_FACTS_ELSEWHERE = [field.name for field in fields(Elsewhere) if field.name != "episodes"]


def stored(policy: Certified) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """(facts, arrays) of a certified policy, as they are stored; the arrays have the name of the policy itself."""
    facts = {name: getattr(policy, name) for name in _FACTS}
    arrays = {_NAME: names([policy.policy.name]).reshape(()), **arrays_of(policy.episodes)}
    if (there := policy.elsewhere) is not None:
        facts[_ELSEWHERE] = {name: getattr(there, name) for name in _FACTS_ELSEWHERE}
        arrays |= {f"{_ELSEWHERE}_{name}": array for name, array in arrays_of(there.episodes).items()}
    return facts, arrays


def _form(kind: type, names: Sequence[str], **more: Any) -> Any:
    hints = get_type_hints(kind)
    fields_ = {name: (hints[name], ...) for name in names if name not in more}
    return create_model(f"_{kind.__name__}", __base__=Form, **fields_, **more)


_FactsElsewhere = _form(Elsewhere, _FACTS_ELSEWHERE)
_Facts = _form(Certified, _FACTS, elsewhere=(_FactsElsewhere | None, None), env_steps=(int | None, None))
_EPISODES = {
    **dict.fromkeys(("return_E", "last_reward_E", "goal_distance_E", "descriptor_E_B"), REAL),
    "steps_E": INTEGER,
}
_NEEDED = {**POLICY, **_EPISODES}
_MORE = {"success_E": BOOL}


def _from_row(folder: Path, row: CertifiedRow, meta: RunMeta) -> Certified:
    """A certified policy of the store. Raises StoreError if it is none of this run."""
    sizes, prefix = sizes_of(meta), f"{_ELSEWHERE}_"
    arrays: dict[str, Any] = {name: array for name, array in row.arrays.items() if not name.startswith(prefix)}
    if _NAME in arrays:  # else it is of a version before 0.28, and has the policy itself
        policy = row.contents.get(arrays.pop(_NAME).tobytes(), {})
        arrays |= {name: policy[name] for name in OF_POLICY if name in policy}
    there: dict[str, Any] = {
        name.removeprefix(prefix): array for name, array in row.arrays.items() if name.startswith(prefix)
    }
    facts = dict(row.facts)
    lengths = {"D": sizes.parameters, "O": sizes.observation, "B": sizes.dimensions}
    found = array_problem(arrays, _NEEDED, _MORE, lengths)
    if not found and facts.get(_ELSEWHERE) is not None:  # its descriptor has other dimensions
        found = array_problem(there, _EPISODES, _MORE, {"E": lengths["E"]})
    elif not found and there:
        found = f"has an array {prefix + min(there)!r} of no other task"
    try:
        require_form(facts, _Facts, "its facts")
    except Damaged as error:
        found = str(error)
    if found or not lengths["E"]:
        which = f"row {row.rank} of certification {row.number}"
        raise StoreError(f"{folder} is not what es-service writes: {which} {found or 'has no episodes'}", run=folder)
    own: dict[str, Any] = {"policy": policy_of(stored_policy_spec(meta), arrays)}
    own |= {name: facts[name] for name in _FACTS if name in facts}
    of_episodes = {name: array for name, array in arrays.items() if name not in OF_POLICY}
    if (known := facts.get(_ELSEWHERE)) is not None:
        known = {name: known[name] for name in _FACTS_ELSEWHERE}
        own[_ELSEWHERE] = Elsewhere(**known, episodes=_episodes(there))
    return Certified(row.number, row.rank, **own, episodes=_episodes(of_episodes))


def _episodes(arrays: Mapping[str, Any]) -> StoredEpisodes:
    return StoredEpisodes(**{"success_E": None, **arrays})
