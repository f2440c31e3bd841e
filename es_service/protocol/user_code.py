"""Imports of a user's modules as their files are now, also if this process has imported earlier versions of them.

A module that has changed since it was imported is imported anew, and so are the modules of `sources.modules_of` that
need it; all others stay. The new modules take the places of the old ones in `sys.modules`, because functions may import
later. The old modules are not touched: classes and functions that the program took from them stay what they are.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Mapping, Sequence
from importlib.machinery import ModuleSpec, SourceFileLoader
from threading import RLock
from types import ModuleType

from es_service.protocol.sources import UserModule, modules_of, sha256
from es_service.protocol.system import process_start_s

_ONE_AT_A_TIME = RLock()


def import_user_module(path: str) -> ModuleType:
    """The module of `package.module:name`, as it and what it needs are now; it may be in the current folder.

    Raises whatever its import raises; then `sys.modules` has the old modules again.
    """
    name = path.partition(":")[0]
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # a console script does not search its working folder
    with _ONE_AT_A_TIME:
        importlib.invalidate_caches()  # a file may be newer than what Python knows of its folder
        modules = modules_of(path).user
        old = {name: sys.modules[name] for name in _outdated(modules)}
        for outdated in old:
            _remove(outdated)
        sys.meta_path.insert(0, finder := _Finder(modules))
        try:
            return importlib.import_module(name)
        except BaseException:
            for outdated, module in old.items():
                _restore(outdated, module)
            raise
        finally:
            sys.meta_path.remove(finder)


def in_no_file(path: str) -> str:
    """Why `module:name` cannot be imported elsewhere, if it is of a notebook or of the program itself; else empty."""
    module, _, name = path.partition(":")
    if module != "__main__":
        return ""
    file = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    return (
        f"{path} is defined in a notebook or in the program that runs, which other processes cannot import; put it in "
        f"a file, such as {file}.py in this folder, and name it {file}:{name}"
    )


def _remove(name: str) -> None:
    """Forget an imported module, also as an attribute of its package."""
    del sys.modules[name]
    package, _, child = name.rpartition(".")
    if package in sys.modules:
        vars(sys.modules[package]).pop(child, None)


def _restore(name: str, module: ModuleType) -> None:
    """Undo `_remove`."""
    sys.modules[name] = module
    package, _, child = name.rpartition(".")
    if package in sys.modules:
        setattr(sys.modules[package], child, module)


def _outdated(modules: Mapping[str, UserModule]) -> set[str]:
    """Names of the imported modules that have changed since, and of those that need one of them."""
    outdated = {name for name, own in modules.items() if name in sys.modules and not _is_same(sys.modules[name], own)}
    needed = {name for own in modules.values() for name in own.needs}
    outdated |= {name for name in needed & sys.modules.keys() - modules.keys() if _is_gone(sys.modules[name])}
    more = outdated
    while more:
        more = {name for name in modules.keys() & sys.modules.keys() - outdated if modules[name].needs & outdated}
        outdated |= more
    return outdated


def _is_same(module: ModuleType, own: UserModule) -> bool:
    """Whether a module was imported from its file as it is now. If the program has imported it itself, the
    version that was imported is unknown; then the file must not have changed since this process started."""
    loader = getattr(module, "__loader__", None)
    if isinstance(loader, _Loader):
        return loader.sha256 == own.sha256
    return own.file.stat().st_ctime < process_start_s()


def _is_gone(module: ModuleType) -> bool:
    """Whether a module of the user was imported from a file that does not exist any more."""
    loader = getattr(module, "__loader__", None)
    return isinstance(loader, _Loader) and not os.path.exists(loader.path)


class _Finder:
    """Finds a user's modules, and has them loaded with `_Loader`."""

    def __init__(self, modules: Mapping[str, UserModule]) -> None:
        self._files = {name: own.file for name, own in modules.items() if own.file.suffix == ".py"}

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """The spec of a module, None if it is not one of them."""
        if (file := self._files.get(name)) is None:
            return None
        return importlib.util.spec_from_file_location(name, file, loader=_Loader(name, str(file)))


class _Loader(SourceFileLoader):
    """Loader that knows the hash of what it has loaded. It does without compiled files: Python takes one for current if
    the source was edited within a second and has kept its size."""

    sha256 = ""

    def get_data(self, path: str) -> bytes:
        """The content of the source file."""
        content = super().get_data(path)
        self.sha256 = sha256(content)
        return content

    def path_stats(self, path: str) -> Mapping[str, object]:
        """Say that there is no time to compare with that of a compiled file."""
        raise OSError
