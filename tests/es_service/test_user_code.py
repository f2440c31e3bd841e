"""A user's modules are imported as their files are now; other modules of the program stay."""

from __future__ import annotations

import importlib
import os
import sys

import pytest

from es_service.protocol.sources import driver_sources, sha256, user_sources
from es_service.protocol.user_code import import_user_module

FILES = {
    "mine.py": "from helper import value\nimport others.plain\n\nclass Kind:\n    pass\n\nSAID = value()\n",
    "helper.py": "def value():\n    from later import LATE\n\n    return LATE + 0\n",
    "later.py": "LATE = 1\n",
    "others/__init__.py": "",
    "others/plain.py": "",
    "others/inside.py": "from . import plain\nfrom .plain import x\n",
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder of a user, with a module, its helper, and a package."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    for name in FILES:
        sys.modules.pop(name.removesuffix(".py").removesuffix("/__init__").replace("/", "."), None)


def test_what_has_not_changed_stays_the_same_object(folder):
    first = import_user_module("mine:Kind")
    assert import_user_module("mine:Kind") is first
    os.utime(folder / "mine.py")
    assert import_user_module("mine:Kind") is first


@pytest.mark.parametrize("edited", ["mine.py", "helper.py", "later.py"])
def test_an_edited_module_is_new_with_all_that_need_it_and_no_others(folder, edited):
    """Within a second and of the same size, so that Python takes its own compiled file for current."""
    first, names = import_user_module("mine:Kind"), ("mine", "helper", "later", "others", "others.plain")
    before = {name: sys.modules[name] for name in names}
    time = (folder / edited).stat().st_mtime_ns
    new = FILES[edited].replace("+ 0", "+ 1").replace("LATE = 1", "LATE = 2").replace("= value()", "= 2222222")
    (folder / edited).write_text(new)
    os.utime(folder / edited, ns=(time, time))
    second = import_user_module("mine:Kind")
    assert (first.SAID, second.SAID) in ((1, 2), (1, 2222222))
    assert isinstance(first.Kind(), first.Kind)
    assert second.Kind is not first.Kind
    assert sys.modules["mine"] is second
    needed_by = {"mine.py": ["mine"], "helper.py": ["mine", "helper"], "later.py": ["mine", "helper", "later"]}
    assert [name for name in names if sys.modules[name] is not before[name]] == needed_by[edited]


def test_modules_that_the_program_imported_itself_are_imported_anew_only_if_they_may_have_changed(folder):
    """Nobody knows which version that was, if the file has changed since the process started."""
    sys.path.append(str(folder))
    program = importlib.import_module("mine")
    (folder / "mine.py").write_text(f"{FILES['mine.py']}SAID = 5\n")
    assert import_user_module("mine:Kind").SAID == 5
    assert program.SAID == 1
    ours = sys.modules[__name__]
    assert import_user_module(f"{__name__}:FILES") is ours


def test_an_import_that_fails_leaves_the_old_modules_and_the_next_one_succeeds(folder):
    first = import_user_module("mine:Kind")
    (folder / "helper.py").write_text("def value(:\n")
    with pytest.raises(SyntaxError):
        import_user_module("mine:Kind")
    assert sys.modules["mine"] is first
    (folder / "helper.py").write_text("def value():\n    return 7\n")
    assert import_user_module("mine:Kind").SAID == 7


def test_a_helper_that_is_gone_is_missed(folder):
    """Workers would miss it, too."""
    import_user_module("mine:Kind")
    (folder / "later.py").unlink()
    with pytest.raises(ModuleNotFoundError, match="later"):
        import_user_module("mine:Kind")
    (folder / "later.py").write_text("LATE = 3\n")
    assert import_user_module("mine:Kind").SAID == 3


def test_submodules_and_packages_that_have_changed_are_new_for_those_that_need_them(folder):
    (folder / "others/plain.py").write_text("x = 1\n")
    first = import_user_module("others.inside:x")
    plain = sys.modules["others.plain"]
    (folder / "others/plain.py").write_text("x = 2\n")
    second = import_user_module("others.inside:x")
    assert (first.x, second.x, second.plain.x) == (1, 2, 2)
    assert sys.modules["others.plain"] is not plain
    (folder / "others/__init__.py").write_text("# new\n")
    assert import_user_module("others.inside:x") is not second


def test_the_hashes_are_those_of_what_was_imported(folder):
    for text in ("LATE = 3\n", "LATE = 4\n"):
        (folder / "later.py").write_text(text)
        import_user_module("mine:Kind")
        loaded = {sys.modules[name].__loader__.sha256 for name in ("mine", "helper", "later")}
        assert sha256(text.encode()) in loaded
        assert loaded <= set(user_sources("mine:Kind").values())
        assert user_sources("mine:Kind").items() <= driver_sources("mine:Kind").items()
