"""Rules of the project, each broken by hand: a test of `make test` must notice.

    python -m tests.broken_rules                            # all of them
    python -m tests.broken_rules "the sign of a pair"       # some of them, by the name of a rule or of a case

A case replaces one piece of the code by a plausible mistake, in a copy of the tracked files as they are in the working
tree, and runs there the tests that should notice it. Before, all of these tests must pass. The table has the first test
that failed, and the number of those that did. The exit code is 1 if nobody noticed a case.

No change is hidden by code that was compiled before, and none leaves compiled code behind: Python writes no bytecode
here, the key of a kernel has a hash of the compiler's files and of what the kernel computes, that of XLA's code has the
program, and the copy has its own cache of both.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
IMPORTED = "import es_service, workers; print(es_service.__file__, workers.__file__)"
IMPORTED_BY_A_WORKER = f"""
import subprocess, sys
from es_service.protocol.process_environment import child_environment
subprocess.run([sys.executable, "-c", {IMPORTED!r}], env=child_environment(), cwd="/", check=True)
"""


class Case(NamedTuple):
    """One way of breaking a rule."""

    rule: str
    how: str
    file: str
    old: str
    """Text that occurs exactly once in the file."""
    new: str
    tests: str
    """Files and node ids, separated by spaces."""

    @property
    def name(self) -> str:
        """The rule and how it is broken."""
        return f"{self.rule}: {self.how}"


class CopyError(Exception):
    """The cases cannot be tried."""


def cases(rule: str, tests: str, *ways: tuple[str, str, str, str]) -> list[Case]:
    """Cases of one rule with the same tests, from (how, file, old, new)."""
    return [Case(rule, *way, tests) for way in ways]


def broken(case: Case, root: Path = ROOT) -> str:
    """The text of the case's file with the mistake in it."""
    text = (root / case.file).read_text()
    if (count := text.count(case.old)) != 1:
        raise CopyError(
            f"{case.name}: the text to replace occurs {count} times in {case.file}, not once; "
            f"the code has moved on, so correct the case in tests/broken_rules.py: {case.old!r}"
        )
    return text.replace(case.old, case.new)


def chosen(names: Sequence[str]) -> list[Case]:
    """The cases with these names, or of the rules with these names; all if there are none."""
    known = {name for case in CASES for name in (case.rule, case.name)}
    if unknown := [name for name in names if name not in known]:
        raise CopyError(f"no rule or case has the name {unknown[0]!r}; there are:\n" + "\n".join(sorted(known)))
    return [case for case in CASES if not names or case.rule in names or case.name in names]


def copy_of_repository(folder: Path) -> Path:
    """A copy of the tracked files as they are in the working tree."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in listed.split("\0"):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def python(copy: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run this Python in the copy, so that it and all processes that it starts import the packages of the copy."""
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, check=False)


def require_copy(copy: Path) -> None:
    """Raise CopyError if a process in the copy, or a worker that it starts, imports packages from elsewhere."""
    for program in (IMPORTED, IMPORTED_BY_A_WORKER):
        done = python(copy, "-c", program)
        if done.stdout.split() != [str(copy / name / "__init__.py") for name in ("es_service", "workers")]:
            raise CopyError(f"a process in {copy} imports other packages: {done.stdout}{done.stderr}")


def failed_tests(copy: Path, tests: Sequence[str]) -> list[str]:
    """The tests that fail in the copy, in their order."""
    done = python(copy, "-m", "pytest", *tests)
    if done.returncode not in (0, 1):  # such as an error in the import of a test file
        raise CopyError(f"{' '.join(tests)} could not be run:\n{done.stdout[-4000:]}{done.stderr[-4000:]}")
    return re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)


def try_cases(cases: Sequence[Case], copy: Path) -> list[str]:
    """Print the table of these cases as it grows; returns the names of those that nobody noticed."""
    for case in cases:
        broken(case)
    require_copy(copy)
    every, started = sorted({test for case in cases for test in case.tests.split()}), time.monotonic()
    if failed := failed_tests(copy, every):
        raise CopyError("these tests fail although no rule is broken:\n" + "\n".join(failed))
    print(
        f"{len(cases)} cases; unbroken, their {len(every)} files of tests pass in {time.monotonic() - started:.0f} s\n"
    )
    print("| rule | noticed by | s |\n| --- | --- | --- |", flush=True)
    unnoticed = []
    for case in cases:
        started, file = time.monotonic(), copy / case.file
        sound = file.read_text()
        file.write_text(broken(case, copy))
        failed = failed_tests(copy, case.tests.split())
        file.write_text(sound)
        said = f"{failed[0]} and {len(failed) - 1} more" if len(failed) > 1 else "".join(failed) or "NOBODY"
        print(f"| {case.name} | {said} | {time.monotonic() - started:.0f} |", flush=True)
        unnoticed += [] if failed else [case.name]
    return unnoticed


def main(arguments: Sequence[str] | None = None) -> int:
    """Try cases and say which nobody noticed; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.broken_rules", description="Break rules, one at a time.")
    parser.add_argument("names", nargs="*", help="names of rules or of cases (default: all)")
    try:
        cases = chosen(parser.parse_args(arguments).names)
        with tempfile.TemporaryDirectory(prefix="broken-rules-") as folder:
            unnoticed = try_cases(cases, copy_of_repository(Path(folder).resolve()))
    except CopyError as error:
        print(error, file=sys.stderr)
        return 2
    for name in unnoticed:
        print(f"no test noticed: {name}", file=sys.stderr)
    return 1 if unnoticed else 0


NOVELTY, COMMON = "es_service/search/novelty.py", "es_service/search/algorithms/common.py"
NEAREST = "es_service/protocol/nearest.py"
NSRA, STARTS = "es_service/search/algorithms/nsra_es.py", "es_service/search/algorithms/common.py"
MAP_ELITES, BASE = "es_service/search/algorithms/map_elites.py", "es_service/search/algorithms/base.py"
RECIPES = "es_service/protocol/policies.py"
SENT = "es_service/protocol/sent.py"
ADAM, SHAPING = "es_service/search/steps.py", "es_service/search/shaping.py"
BEHAVIOUR_MAP, ARRAYS = "es_service/search/maps/behaviour_map.py", "es_service/loop/blocks.py"
GENERATION, TREE = "es_service/loop/generation.py", "es_service/protocol/gradient_tree.py"
SCHEDULER, CHANGES = "es_service/dispatch/scheduler.py", "es_service/dispatch/scheduler_state.py"
ENGINE, DEADLINES = "es_service/dispatch/engine.py", "es_service/dispatch/assignment.py"
EPISODE, WORKER = "workers/episode.py", "workers/worker.py"
RESULTS, POLICY = "workers/rollouts/backend.py", "workers/policy.py"
XLA, SIMD = "workers/xla.py", "workers/simd/episodes/rollout.py"
COMPILED, HIDDEN = "workers/simd/episodes/compiled.py", "workers/simd/episodes/hidden.py"
LOW_RANK = "es_service/protocol/policy_spec.py"
LOW_RANK_OF_KERNELS = "workers/simd/episodes/low_rank.py"
LOW_RANK_OF_XLA = "workers/xla.py"
NOISE_OF_KERNELS = "workers/simd/episodes/noise_kernels.py"

OF_NOVELTY, OF_NOVELTY_SEARCH = "tests/es_service/test_novelty.py", "tests/laws/test_novelty_search.py"
OF_ME_ES, OF_RULES = "tests/laws/test_me_es.py", "tests/laws/test_update_rules.py"
OF_MAP_ELITES = "tests/laws/test_map_elites.py"
KEPT, MEASURED = "es_service/search/maps/kept.py", "es_service/search/algorithms/measured.py"
OF_MEASURED = "tests/laws/test_measured_elites.py"
OF_MAPS = "tests/es_service/test_maps.py tests/es_service/test_changed_elites.py tests/es_service/test_blocks.py"
OF_ROLLOUT = "tests/workers/test_rollout.py"
OF_SCHEDULER = "tests/es_service/test_scheduler.py tests/es_service/test_scheduler_workers.py"

CASES = [
    *cases(
        "novelty counts the own entry",
        OF_NOVELTY_SEARCH,
        ("of a centre to choose", COMMON, "exclude_Q=entry_M[known_M]", "exclude_Q=None"),
    ),
    *cases(
        "novelty counts the own entry",
        f"{OF_ME_ES} tests/laws/test_me_es_blocks.py",
        ("of an elite to draw", STARTS, "exclude_Q=_entries_of_elites(map_, archive)", "exclude_Q=None"),
        (
            "of another centre of the same generation",
            STARTS,
            "entries.generation_N * centres + entries.centre_N",
            "entries.generation_N * centres",
        ),
    ),
    *cases(
        "novelty counts the own entry",
        OF_NOVELTY,
        (
            "a tree's candidate",
            NEAREST,
            "near_Q_K[candidate_Q_K == excluded_Q[:, None]]",
            "near_Q_K[candidate_Q_K < 0]",
        ),
        ("within a tree's radius", NEAREST, "near_1_K[:, within == excluded_Q[index]]", "near_1_K[:, within < 0]"),
        ("in no tree", NEAREST, "squared_Q_N[rows, excluded_Q[rows] - first]", "squared_Q_N[rows, :0]"),
        ("one of the newest", NOVELTY, "excluded_Q - (archive.size - newest), -1)", "0 * excluded_Q - 1, -1)"),
    ),
    *cases(
        "novelty where the members are is that of the driver",
        OF_NOVELTY,
        (
            "a tree over other entries",
            NEAREST,
            "before is not None and self._in_full_arrays == before._in_full_arrays else None",
            "before is not None else None",
        ),
        (
            "older entries than the newest",
            NEAREST,
            "np.concatenate(self.arrays)[self.first :]",
            "np.concatenate(self.arrays)",
        ),
    ),
    *cases(
        "phantom entries in the novelty archive",
        OF_NOVELTY,
        (
            "one in an empty archive",
            NOVELTY,
            "np.zeros((0, dimensions)), np.zeros(0, np.int64), np.zeros(0, np.int64)",
            "np.zeros((1, dimensions)), np.zeros(1, np.int64), np.zeros(1, np.int64)",
        ),
        (
            "a row of spare capacity",
            NOVELTY,
            "return NoveltyArchive(descriptor_N_B, room.generation[: room.used], room.centre[: room.used], tree, room)",
            "n = room.used + 1\n    "
            "return NoveltyArchive(room.descriptor_B[:n] * 1.0, room.generation[:n], room.centre[:n], tree, room)",
        ),
    ),
    *cases(
        "an Adam moment",
        f"{OF_RULES} tests/laws/test_es.py::test_twenty_generations_equal_the_reference",
        (
            "the first decays at the rate of the second",
            ADAM,
            '"adam_m_D"] * np.float32(BETA_1)',
            '"adam_m_D"] * np.float32(BETA_2)',
        ),
        ("the second is not of squares", ADAM, "np.square(descent_D)", "np.abs(descent_D)"),
        ("the second is not kept", ADAM, '"adam_v_D": v_D,', '"adam_v_D": state["adam_v_D"],'),
        ("both are corrected as in the first step", ADAM, 'step = int(state["adam_step"]) + 1', "step = 1"),
    ),
    *cases(
        "an Adam moment",
        OF_ME_ES,
        ("a block goes on with another's", BASE, "restarted(before.step),", "before.step,"),
    ),
    *cases(
        "Adam moments after resume",
        f"{OF_NOVELTY_SEARCH}::test_a_state_put_together_again_is_the_same_and_only_the_moved_centre_is_written"
        f" {OF_ME_ES}::test_a_search_put_together_again_inside_a_block_equals_an_uninterrupted_one",
        (
            "the first is lost",
            ARRAYS,
            "{**nodes.get(path, {}),",
            '{**{name: array * (name != "adam_m_D") for name, array in nodes.get(path, {}).items()},',
        ),
        (
            "the second is stored as the first",
            ARRAYS,
            "for name, value in _children(owner).items()\n        if value",
            'for name, value in {**_children(owner), **{"adam_v_D": dict(_children(owner)).get("adam_m_D")}}.items()\n'
            "        if value",
        ),
        (
            "the steps are lost",
            ARRAYS,
            "{**nodes.get(path, {}),",
            '{**{name: array * (name != "adam_step") for name, array in nodes.get(path, {}).items()},',
        ),
    ),
    *cases(
        "action noise",
        OF_ROLLOUT,
        (
            "in evaluations",
            EPISODE,
            "action_A = action(jnp, spec.policy.output, outputs)",
            "action_A = training_action(outputs, action_key, before.steps)",
        ),
        (
            "the same in every step",
            EPISODE,
            "action_A = training_action(outputs, action_key, before.steps)",
            "action_A = training_action(outputs, action_key, jnp.int32(0))",
        ),
        ("of another scale", EPISODE, "np.float32(spec.action_noise / NORMAL_STD)", "np.float32(spec.action_noise)"),
        (
            "from the stream of the resets",
            WORKER,
            "Domain.TRAINING_RESET, Domain.ACTION_NOISE",
            "Domain.TRAINING_RESET, Domain.TRAINING_RESET",
        ),
        (
            "from the stream of the resets, xla",
            XLA,
            "reset_keys_L if action_keys_L is None else action_keys_L",
            "reset_keys_L",
        ),
        (
            "from the stream of the resets, simd",
            COMPILED,
            "pack([action_keys_L], width)",
            "pack([reset_keys_L], width)",
        ),
    ),
    *cases(
        "common random numbers",
        OF_ROLLOUT,
        (
            "never",
            WORKER,
            "sign_S = np.zeros(2, int) if spec.common_random_numbers else np.arange(2)",
            "sign_S = np.arange(2)",
        ),
        ("always", WORKER, "np.zeros(2, int) if spec.common_random_numbers else np.arange(2)", "np.zeros(2, int)"),
        (
            "of the wrong pair, xla",
            XLA,
            "*(keys.reshape(2 * block_pairs, ",
            "*(keys.swapaxes(0, 1).reshape(2 * block_pairs, ",
        ),
        (
            "of the wrong pair, simd",
            SIMD,
            "keys_P_S.reshape(-1, KEY_WORDS)",
            "keys_P_S.swapaxes(0, 1).reshape(-1, KEY_WORDS)",
        ),
    ),
    *cases(
        "steps after done",
        f"{OF_ROLLOUT} tests/workers/test_episode_ends.py",
        ("count", EPISODE, "jax.tree.map(lambda new, old: jnp.where(alive, new, old), after, before)", "after"),
        ("revive an episode", EPISODE, "alive & ~done, carry", "~done, carry"),
        ("one too many, xla", XLA, "(step < spec.episode_steps)", "(step <= spec.episode_steps)"),
        ("one too many, simd", COMPILED, "steps = self.spec.episode_steps\n", "steps = self.spec.episode_steps + 1\n"),
    ),
    *cases(
        "a duplicate answer",
        f"{OF_SCHEDULER} tests/es_service/test_engine.py",
        (
            "is delivered",
            SCHEDULER,
            "if delivered := drop_item(s, item_id):",
            "drop_item(s, item_id)\n    if delivered := True:",
        ),
        (
            "of an earlier call is taken for one of this",
            ENGINE,
            "WorkItemId(self._phase, first,",
            "WorkItemId(0, first,",
        ),
    ),
    *cases(
        "the order of requeued items",
        OF_SCHEDULER,
        ("is reversed", SCHEDULER, "for slot in reversed(slots):", "for slot in slots:"),
        ("puts them last", CHANGES, "s.places[0][0] - 1 if s.places else 0", "s.places[-1][0] + 1 if s.places else 0"),
    ),
    *cases(
        "a deadline follows progress",
        OF_SCHEDULER,
        ("not at all", DEADLINES, "deadline_s=max(record.allowed_s, until_s)", "deadline_s=record.allowed_s"),
        ("for ever", DEADLINES, "deadline_s=max(record.allowed_s, until_s)", "deadline_s=math.inf"),
        ("attempts are alike", DEADLINES, "2 ** min(worker.slots[0].attempt - 1, MOST_DOUBLINGS)", "1"),
    ),
    *cases(
        "the item that loses workers is charged where items overlap",
        "tests/es_service/test_scheduler.py",
        (
            "an item is behind another one after a loss",
            "es_service/dispatch/assignment.py",
            "1 if s.limits.items_at_once > 1 and s.losses_in_a_row else s.limits.in_flight",
            "s.limits.in_flight",
        ),
    ),
    *cases(
        "the order of arrival",
        "tests/es_service/test_engine.py",
        (
            "is that of the results",
            ENGINE,
            "[result for item_id, _ in parts for result in self._results.pop(item_id)]",
            "[result for results in self._results.values() for result in results]",
        ),
    ),
    *cases(
        "the sign of a pair",
        OF_RULES,
        ("in its weight", SHAPING, "utility_P_S[:, 0] - utility_P_S[:, 1]", "utility_P_S[:, 1] - utility_P_S[:, 0]"),
        (
            "in the shaping by signs",
            SHAPING,
            "np.stack([half_P, -half_P], axis=1)\n\n\ndef standardised",
            "np.stack([-half_P, half_P], axis=1)\n\n\ndef standardised",
        ),
        ("of the step", ADAM, "- gradient_D\n        m_D", "+ gradient_D\n        m_D"),
    ),
    *cases(
        "the sign of a pair",
        OF_ROLLOUT,
        ("in a member's noise, xla", XLA, "signs_S[None, :, None]", "signs_S[None, ::-1, None]"),
        (
            "in a member's hidden layers, simd",
            HIDDEN,
            """(plus, builder.value(f"fsub {floats} {doubled}, {plus}")) for""",
            """(builder.value(f"fsub {floats} {doubled}, {plus}"), plus) for""",
        ),
        ("in a member's last layer, simd", NOISE_OF_KERNELS, "-1.0 if lane % 2 else 1.0", "1.0 if lane % 2 else -1.0"),
    ),
    *cases(
        "noise of low rank",
        "tests/workers/test_low_rank.py",
        ("is not divided by the root of its rank", LOW_RANK, "NORMAL_STD * math.sqrt(rank)", "NORMAL_STD"),
        ("uses the numbers of A for B", LOW_RANK, "drawn[..., right]", "drawn[..., right - right.min()]"),
        ("of both members has one sign, xla", LOW_RANK_OF_XLA, "step_S = unit * SIGNS_S", "step_S = unit * SIGNS_S**2"),
        (
            "forgets the sign of a member's biases, simd",
            LOW_RANK_OF_KERNELS,
            'builder.value("fneg float %unit")',
            '"%unit"',
        ),
        (
            "of a gradient takes another input's number, simd",
            "workers/simd/episodes/low_rank.py",
            "(left, 1), (at_left, 1), (i, 1)",
            "(left, 1), (at_left, 1), (j, 1)",
        ),
    ),
    *cases(
        "the tree of sums",
        f"tests/es_service/test_gradient_tree.py {OF_RULES}",
        (
            "adds one block after the other",
            TREE,
            "total = _node(known, 0, size, covered)",
            "total = sum(known.values())",
        ),
        ("adds neighbours that are no node", TREE, " or work[left][1].chunk_id % (2 * sums.blocks):", ":"),
        (
            "adds populations",
            TREE,
            "(chunk.generation, chunk.ask) == (later.generation, later.ask)",
            "chunk.generation == later.generation",
        ),
        ("accepts overlapping sums", TREE, "if first != covered or first % blocks", "if first % blocks"),
    ),
    *cases(
        "NSRA's weight",
        OF_NOVELTY_SEARCH,
        (
            "rises at the record",
            NSRA,
            "evaluation.fitness > weight.record + gain",
            "evaluation.fitness >= weight.record + gain",
        ),
        ("forgets the record", NSRA, "evaluation.fitness, 0)", "weight.record, 0)"),
        ("waits a generation too long", NSRA, "weight.stagnant + 1 < search", "weight.stagnant + 1 <= search"),
        (
            "goes on counting after a fall",
            NSRA,
            "search.fitness_weight_step), stagnant=0)",
            "search.fitness_weight_step))",
        ),
        (
            "rises above 1",
            NSRA,
            "min(1.0, weight.value + search.fitness_weight_step)",
            "weight.value + search.fitness_weight_step",
        ),
        (
            "is that of novelty",
            "es_service/search/shaping.py",
            "+= weight * shaped(shaping, values(objective, results))",
            "+= (1.0 - weight) * shaped(shaping, values(objective, results))",
        ),
    ),
    *cases(
        "a mutant's noise address",
        OF_MAP_ELITES,
        (
            "is that of the whole batch",
            MAP_ELITES,
            "Domain.VARIATION, generation, np.arange(search.batch)",
            "Domain.VARIATION, generation, np.zeros(search.batch, np.int64)",
        ),
        (
            "is that of every generation",
            MAP_ELITES,
            "Domain.VARIATION, generation, np.arange(search.batch)",
            "Domain.VARIATION, 0, np.arange(search.batch)",
        ),
        (
            "is that of a pair",
            MAP_ELITES,
            "Domain.VARIATION, generation, np.arange(search.batch)",
            "Domain.PARAMETER_NOISE, generation, np.arange(search.batch)",
        ),
        ("has a line for each parameter", RECIPES, "noise[..., -1:]", "noise[..., 1:]"),
    ),
    *cases(
        "a policy that is measured again",
        f"tests/es_service/test_kept.py {OF_MEASURED}",
        ("counts its new sample as much as all before", KEPT, "fitness_was_R) / (count_R + 1)", "fitness_was_R) / 2"),
        (
            "falls behind younger ones that are as fit",
            KEPT,
            "both.serial_K, -both.fitness_K",
            "-both.serial_K, -both.fitness_K",
        ),
        ("is drawn whatever its rank", KEPT, "np.exp(-rank_K)", "np.ones(kept.size)"),
        ("stays if its sample is invalid", MEASURED, "stays_K[rows_R[~is_valid_R]] = False", "pass"),
        ("stays in its cell", MEASURED, "comes_K[rows_R[is_valid_R]] = True", "pass"),
        (
            "keeps only its first sample of the median",
            MEASURED,
            "return fitness_S[-MOST_SAMPLES:]",
            "return fitness_S[:1]",
        ),
        ("gives no score to its elite", MEASURED, "score_K[at] = score", "pass"),
    ),
    *cases(
        "corrected values",
        OF_MEASURED,
        ("count no steps", "es_service/loop/finished.py", " + correction.env_steps", ""),
        (
            "have the stored places",
            "es_service/loop/evaluated.py",
            "doubles(results.descriptor).mean(axis=1)[valid_N]",
            "map_.descriptor_N_B[rows][valid_N]",
        ),
    ),
    *cases(
        "a worker's parents of policies",
        "tests/laws/test_recipes.py",
        (
            "are made with their own parents exchanged",
            RECIPES,
            "Origin(self.rule, self.names[x], self.names[y], key_4.copy())",
            "Origin(self.rule, self.names[y], self.names[x], key_4.copy())",
        ),
        (
            "are forgotten while they are needed",
            SENT,
            "self.forget_oldest(self._most_bytes, spared=names)",
            "self.forget_oldest(self._most_bytes)",
        ),
        ("are made before what they are made of", SENT, "return dict(reversed(steps.items()))", "return steps"),
    ),
    *cases(
        "an elite's fitness",
        f"{OF_MAPS} {OF_MAP_ELITES} {OF_ME_ES}::test_thirty_generations_equal_the_reference",
        (
            "is replaced by an equal one",
            BEHAVIOUR_MAP,
            'enters = entry["fitness_N"] > map_.fitness_N[row]',
            'enters = entry["fitness_N"] >= map_.fitness_N[row]',
        ),
        ("is replaced by any", BEHAVIOUR_MAP, 'enters = entry["fitness_N"] > map_.fitness_N[row]', "enters = True"),
        (
            "remains that of the one before",
            BEHAVIOUR_MAP,
            "(_with(map_, row, entry) if enters",
            '(_with(map_, row, {**entry, "fitness_N": map_.fitness_N[row]}) if enters',
        ),
        (
            "is not stored when it changes",
            ARRAYS,
            "then[name]) for name in now])",
            'then[name]) for name in now if name != "fitness_N"])',
        ),
        (
            "is stored as its score",
            ARRAYS,
            "for name, value in _children(owner).items()\n        if value",
            'for name, value in {**_children(owner), "fitness_N": getattr(owner, "score_N", None)}.items()\n'
            "        if value",
        ),
        (
            "is read from its score",
            ARRAYS,
            '_or_none(hints[name], nodes, f"{path}/{name}")',
            '_or_none(hints[name], nodes, f"{path}/{name}".replace("fitness_N", "score_N"))',
        ),
        (
            "is that of its best episode",
            "es_service/loop/evaluated.py",
            "doubles(episodes.fitness).mean(axis=1)",
            "doubles(episodes.fitness).max(axis=1)",
        ),
        (
            "is its score",
            COMMON,
            "changed(map_, centre.cell, score=evaluation.population_max)",
            "changed(map_, centre.cell, score=evaluation.fitness)",
        ),
    ),
    *cases(
        "one key for all",
        "tests/workers/test_policy_kinds.py",
        (
            "layers",
            POLICY,
            "        norm = output_norm if",
            "        weights[:] = normals(key, weights.size).reshape(weights.shape)\n        norm = output_norm if",
        ),
        ("initial centres", POLICY, "Domain.INITIALISATION, 0, centre)", "Domain.INITIALISATION, 0, 0)"),
    ),
    *cases(
        "one seed for all",
        f"{OF_ROLLOUT} tests/laws/test_asks.py",
        ("workers", WORKER, "chunk.chunk_id * size + np.arange(size)", "np.arange(size)"),
        ("populations", WORKER, "return (chunk.ask,) if chunk.ask else ()", "return ()"),
        (
            "runs",
            WORKER,
            "stream_keys(spec.seed, domains, generation, *ids)",
            "stream_keys(0, domains, generation, *ids)",
        ),
    ),
    *cases(
        "arrays that alias the simulator's memory",
        OF_ROLLOUT,
        ("descriptors of members", RESULTS, "x_P_S_E[:, :, 0].copy()", "x_P_S_E[:, :, 0]"),
        ("descriptors of episodes", RESULTS, "host = episodes.map(np.array)", "host = episodes.map(np.asarray)"),
        ("traces", RESULTS, "np.asarray(episodes.trace_T_B)[first].copy()", "np.asarray(episodes.trace_T_B)[first]"),
    ),
    *cases(
        "an environment of another library",
        "tests/es_service/test_xla_environments.py",
        (
            "is another one in the second process",
            "workers/lanes/blocks.py",
            "requests.append((child, (kind, lane_M[low:high] - start, given_M[low:high])))",
            "requests.append((child, (kind, lane_M[low:high] - start - (start > 0), given_M[low:high])))",
        ),
    ),
    *cases(
        "an environment of another library",
        "tests/es_service/test_environments.py::test_many_are_as_many_single_ones_in_each_mode",
        (
            "counts its episodes for all",
            "workers/lanes/__init__.py",
            "self.episode_N[lane_M] += 1",
            "self.episode_N += 1",
        ),
    ),
    *cases(
        "an environment of another library",
        "tests/es_service/test_environments.py::test_observations_are_new_arrays_unless_one_is_asked_for_that_is_reused",
        (
            "returns an array that it goes on writing",
            "es_service/environments/vector.py",
            "return self._observation_N_O.copy() if self._copies else self._observation_N_O",
            "return self._observation_N_O",
        ),
    ),
    *cases(
        "an environment of another library",
        "tests/es_service/test_environments.py::test_pictures_show_where_an_environment_is_and_the_way_of_its_episode",
        (
            "draws the way of earlier episodes",
            "es_service/environments/drawing.py",
            "self._ways[lane] = [place.copy()]",
            "self._ways[lane].append(place.copy())",
        ),
    ),
    *cases(
        "an environment of another library",
        "tests/es_service/test_brax_env.py::test_each_episode_has_a_start_of_its_own_that_depends_on_the_key_alone",
        (
            "begins where it began before",
            "workers/brax_view.py",
            "begun = (start.pipeline_state, start.obs, later)",
            "begun = (start.pipeline_state, start.obs, keys)",
        ),
    ),
    *cases(
        "an environment of another library",
        "tests/es_service/test_baselines.py",
        (
            "is certified in other episodes",
            "tests/benchmarks/baselines/episodes.py",
            "seed, OTHER_PROGRAMS + number, np.arange(count), 0, 0,",
            "seed, OTHER_PROGRAMS + number, np.arange(count), 1, 0,",
        ),
        (
            "forgets the CPU time of its earlier sessions",
            "tests/benchmarks/baselines/run.py",
            "self._before += float((kept / CPU_SECONDS).read_text())",
            "pass",
        ),
    ),
    *cases(
        "a certified value",
        "tests/es_service/test_targets.py",
        (
            "is that of the episodes that decided",
            "es_service/runs/sessions.py",
            "episodes=episodes_of(decision.policy, number, Domain.CERTIFICATION_RESET),",
            "episodes=decision.episodes,",
        ),
        (
            "decides whether a run is over",
            "es_service/runs/certified.py",
            "if policy.decides and policy.episodes.count",
            "if policy.episodes.count",
        ),
    ),
]

if __name__ == "__main__":
    sys.exit(main())
