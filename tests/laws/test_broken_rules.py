"""The list of rules that `python -m tests.broken_rules` breaks is true of the code and of the tests as they are."""

import re

import pytest

from tests.broken_rules import CASES, ROOT, Case, CopyError, broken, chosen

OF_THE_PROJECT = (
    "novelty counts the own entry",
    "an Adam moment",
    "action noise",
    "common random numbers",
    "steps after done",
    "a duplicate answer",
    "the order of requeued items",
    "the sign of a pair",
    "the tree of sums",
    "NSRA's weight",
    "a mutant's noise address",
    "an elite's fitness",
)


def test_each_mistake_has_its_place_and_is_still_python():
    for case in CASES:
        text = broken(case)
        assert text != (ROOT / case.file).read_text(), case.name
        compile(text, case.file, "exec")


def test_the_tests_that_should_notice_exist_and_are_part_of_make_test():
    for test in {test for case in CASES for test in case.tests.split()}:
        file, _, function = test.partition("::")
        assert re.match(r"tests/(es_service|laws|workers)/.*test_\w+\.py$", file), test
        text = (ROOT / file).read_text()
        assert f"\ndef {function or 'test_'}" in text, test


def test_every_rule_has_cases_whose_names_differ():
    assert {case.rule for case in CASES} >= set(OF_THE_PROJECT)
    assert len({case.name for case in CASES}) == len(CASES)
    for rule in OF_THE_PROJECT:
        assert {case.rule for case in chosen([rule])} == {rule}
    assert [case.name for case in chosen([CASES[3].name])] == [CASES[3].name]
    with pytest.raises(CopyError, match="no rule or case has the name 'gravity'"):
        chosen(["gravity"])


@pytest.mark.parametrize(("text", "times"), [("a = 2\n", 0), ("a = 1\na = 1\n", 2)])
def test_a_mistake_whose_place_has_moved_is_an_error_that_names_it(tmp_path, text, times):
    (tmp_path / "a.py").write_text(text)
    case = Case("addition", "off by one", "a.py", "a = 1", "a = 3", "")
    with pytest.raises(CopyError, match=f"^addition: off by one: the text to replace occurs {times} times in a.py"):
        broken(case, tmp_path)
