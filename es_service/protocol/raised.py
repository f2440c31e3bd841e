"""Exceptions in words: what a user's code raised, and where in the user's own files.

The frames of this project and of libraries tell a user nothing; they are kept apart, for a log at level debug.
"""

from __future__ import annotations

import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from es_service.protocol.sources import OURS, SHARED_FOLDERS, user_path

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
    chosen = (place for place in traceback.walk_tb(error.__traceback__) if _is_users(place[0], packages))
    lines = "".join(traceback.StackSummary.extract(chosen).format()).splitlines()
    if isinstance(error, SyntaxError) and error.filename and not str(error.filename).startswith(_HIDDEN):
        *place, _ = traceback.format_exception_only(error)
        lines += "".join(place).splitlines()
    return lines


def is_users_file(file: str) -> bool:
    """Whether a file is neither of this project nor of a library, by its name."""
    return not file.startswith(_HIDDEN) and not set(Path(file).parts) & set(SHARED_FOLDERS)


def _is_users(frame: FrameType, packages: set[str]) -> bool:
    if str(frame.f_globals.get("__name__")).partition(".")[0] in packages:
        return True
    return is_users_file(frame.f_code.co_filename)
