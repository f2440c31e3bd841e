"""Imports of a user's modules as their files are now, and what they raise, in words.

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
import sysconfig
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from threading import RLock
from types import ModuleType

from es_service.protocol.machine import process_start_s
from es_service.protocol.sources import OURS, SHARED_FOLDERS, UserModule, modules_of, sha256, user_path

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


# Exceptions in words: what a user's code raised, and where in the user's own files.
#
# The frames of this project and of libraries tell a user nothing; they are kept apart, for a log at level debug.

_PROJECT = Path(__file__).parents[2]
_HIDDEN = (*(f"{_PROJECT / package}/" for package in OURS), f"{sysconfig.get_path('stdlib')}/", "<")
"""Beginnings of the names of files that are not the user's. Names of no file begin with "<"."""
_ADVICE_OF_JAX = "JAX_TRACEBACK_FILTERING"
"""In a note that JAX adds to exceptions; the frames that it is about are not shown in any case."""


class RaisedError(Exception):
    """An exception as texts, which can be sent to another process."""

    def __init__(self, message: str, traceback: str) -> None:
        super().__init__(message, traceback)
        self.message = message
        """For the user: of an exception in the user's code what it is, and on further lines its frames there."""
        self.traceback = traceback
        """The whole traceback."""

    def __str__(self) -> str:
        return self.message


def raised(error: BaseException, *names: str) -> RaisedError:
    """An exception as texts. The message of a bug of this project or of a library is the whole traceback.

    Args:
        names: names `package.module:name` of the user's code, for a package that is installed beside the libraries.
            What is named and raises without a frame, as a function in C or a call with wrong arguments, is the user's.
    """
    if isinstance(error, RaisedError):
        return error
    whole = "".join(traceback.format_exception(error)).rstrip()
    if any(names) and error.__traceback__ is not None and error.__traceback__.tb_next is None:
        return RaisedError("\n".join([_sentence(error), *_notes(error)]), whole)
    return RaisedError(
        users_error(error, *names) or ("\n".join([str(error), *_notes(error)]) if _is_ours(error) else whole), whole
    )


@contextmanager
def sendable(*names: str) -> Iterator[None]:
    """Context manager in which any exception becomes a RaisedError; see `raised`."""
    try:
        yield
    except Exception as error:
        raise raised(error, *names) from None


def why_not_imported(module: str, error: Exception) -> str:
    """Why a user's module cannot be imported: there is none, or what it raised."""
    if users := users_error(error, f"{module}:"):
        return f"importing {module} raised {users}"
    return f"cannot import {module} ({error}); start in the folder that contains it, or install it"


def users_error(error: BaseException, *names: str) -> str:
    """What the user's code raised, with its frames in the user's files; empty if it was not the user's code."""
    packages = {path.partition(":")[0].partition(".")[0] for path in map(user_path, names) if path}
    texts, is_users, exception = [], False, error
    while exception is not None:
        frames = _frames(exception, packages)
        is_users |= bool(frames)
        if frames or exception is error:
            text = "\n".join([_sentence(exception), *frames, *_notes(exception)])
            texts.append(text if exception is error else f"caused by {text}")
        exception = exception.__cause__ or (None if exception.__suppress_context__ else exception.__context__)
    return "\n".join(texts) if is_users else ""


def _sentence(error: BaseException) -> str:
    """The class and the text of an exception; without the class if it is of this project."""
    text = error.msg if isinstance(error, SyntaxError) else str(error)
    return text if _is_ours(error) else f"{type(error).__qualname__}: {text}" if text else type(error).__qualname__


def _notes(error: BaseException) -> list[str]:
    return [note for note in getattr(error, "__notes__", ()) if _ADVICE_OF_JAX not in note]


def _is_ours(error: BaseException) -> bool:
    """Whether an exception is of a class of this project, whose text is a sentence for users."""
    return type(error).__module__.partition(".")[0] in OURS


def _frames(error: BaseException, packages: set[str]) -> list[str]:
    """The frames of an exception in the user's files, as lines; of a syntax error, its place in such a file."""
    chosen = (
        (frame, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
        if str(frame.f_globals.get("__name__")).partition(".")[0] in packages or is_users_file(frame.f_code.co_filename)
    )
    lines = "".join(traceback.StackSummary.extract(chosen).format()).splitlines()
    if isinstance(error, SyntaxError) and error.filename and not str(error.filename).startswith(_HIDDEN):
        *place, _ = traceback.format_exception_only(error)
        lines += "".join(place).splitlines()
    return lines


def is_users_file(file: str) -> bool:
    """Whether a file is neither of this project nor of a library, by its name."""
    return not file.startswith(_HIDDEN) and not set(Path(file).parts) & set(SHARED_FOLDERS)
