"""Each thing has one form: the classes that hold results of episodes, or a policy with its statistics, are these."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RESULTS = {
    "es_service.protocol.messages.EpisodesResult": "the record, from a worker to the history",
    "workers.rollouts.backend.Episodes": "what a rollout computes inside of a worker: sums of observations, all lanes",
    "es_service.search.algorithms.base.CentreEvaluation": "means over them, which a search is told",
    "es_service.search.algorithms.base.CentreEvaluations": "the same in columns",
    "es_service.runs.evaluator.PolicyEvaluations": "public: what `evaluator` returns",
    "es_service.runs.selection.StoredEpisodes": "as stored with a certification, in float64",
    "es_service.runs.evaluation.Fresh": "moments over any number of them",
    "es_service.protocol.recordings.Recording": "one episode with its poses, for replays",
}
"""Classes with a fitness or return and a descriptor for each of some episodes, and why they are not the record."""
NO_RESULTS = {
    "es_service.config.sections.TaskConfig",
    "es_service.protocol.messages.WorkerSpec",
    "es_service.search.maps.behaviour_map.BehaviourMap",
    "es_service.search.maps.kept.KeptPolicies",
    "workers.host.episodes.Watched",
}
"""Classes that only have the words: settings, entries of maps, and what watches an episode."""
POLICIES = {
    "es_service.protocol.content.Policy": "the form, from a search's map to an export",
    "es_service.protocol.messages.Centre": "as sent to workers, with the noise around it",
    "es_service.protocol.policies.Policies": "as sent to workers, several side by side",
    "es_service.loop.contents.PolicyWork": "what is asked for, and the messages that it became",
    "es_service.search.algorithms.base.PolicyAsk": "several that a search asks for",
    "es_service.search.algorithms.base.CentreState": "a centre of a search, with the state of its step",
    "workers.asked_rows.Rows": "a row for each episode that a caller computes",
}
"""Classes with parameters, and with means and standard deviations of observations."""


def classes_with(pattern: str) -> Iterator[str]:
    """Classes of ours in whose fields each of the words of a pattern occurs."""
    for package in ("es_service", "workers"):
        for file in sorted((ROOT / package).rglob("*.py")):
            module = ".".join(file.relative_to(ROOT).with_suffix("").parts)
            yield from (f"{module}.{name}" for name in classes_in(file.read_text(), pattern))


def classes_in(text: str, pattern: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ClassDef):
            fields = [
                each.target.id
                for each in node.body
                if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
            ]
            if all(re.search(word, " ".join(fields)) for word in pattern.split()):
                yield node.name


def test_results_of_episodes_have_one_form():
    found = set(classes_with(r"(\bfitness|\breturn) \bdescriptor"))
    assert found - NO_RESULTS == RESULTS.keys(), "use EpisodesResult, or argue here why it cannot be"
    assert found >= NO_RESULTS


def test_a_policy_with_its_statistics_has_few_forms():
    found = set(classes_with(r"(\bparameters|\bcentre_D) mean_ std_"))
    assert found == POLICIES.keys(), "use Policy, or argue here why it cannot be"


@pytest.mark.parametrize(
    ("fields", "is_one"),
    [("fitness_E: int\n    descriptor_E_B: int", True), ("returns: int\n    name: str", False)],
    ids=["results", "something else"],
)
def test_a_further_class_would_be_found(fields, is_one):
    text = f"class Another:\n    {fields}\n"
    assert list(classes_in(text, r"(\bfitness|\breturn) \bdescriptor")) == ["Another"] * is_one
