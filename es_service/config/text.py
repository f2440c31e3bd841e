"""YAML 1.2 for configs: text -> plain values, with the line and column of what is wrong.

Numbers, booleans and repeated keys follow YAML 1.2: `1e-3` is a float, `012` is twelve, `1:30` and `on` are strings
(which the types of the config then reject), and a repeated key is an error. Dates are plain strings.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.constructor import ConstructorError, DuplicateKeyError, SafeConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import Node, ScalarNode
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.representer import SafeRepresenter

from es_service.errors import ConfigError, Problem
from es_service.protocol.sources import meant_environment

_TAG = "tag:yaml.org,2002:"


class _Constructor(SafeConstructor):
    """Plain values from nodes; text that does not fit its explicit tag is a problem with a position."""

    def construct_object(self, node: Node, deep: bool = False) -> Any:
        """The value of a node. Raises ConstructorError."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, KeyError, IndexError, AttributeError, TypeError, OverflowError):
            tag = str(node.tag).replace(_TAG, "!!")
            raise ConstructorError(None, None, f"this is no {tag}", node.start_mark) from None

    def construct_text(self, node: ScalarNode) -> str:
        return str(self.construct_scalar(node))


class _Representer(SafeRepresenter):
    """Text for people and for other readers: lists on one line, no aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        """Never write an alias."""
        return True

    def represent_list(self, data: Any) -> Any:
        return self.represent_sequence(f"{_TAG}seq", data, flow_style=True)

    def represent_number(self, data: float) -> Any:
        """A float that readers of YAML 1.1, such as PyYAML, take for one too: `1.0e-05`, not `1e-05`."""
        node = self.represent_float(data)
        if "." not in node.value:
            node.value = node.value.replace("e", ".0e")
        return node


for _name in ("timestamp", "value"):  # YAML 1.2 has neither
    _Constructor.add_constructor(f"{_TAG}{_name}", _Constructor.construct_text)
_Representer.add_representer(list, _Representer.represent_list)
_Representer.add_representer(float, _Representer.represent_number)


def read_yaml_file(path: str | Path) -> Mapping[object, object]:
    """The top-level mapping of a config file.

    Raises:
        ConfigError: no such file, not text, not YAML, empty, not a mapping.
    """
    path = Path(path)

    def refused(problem: str) -> ConfigError:
        return ConfigError.listing(f"{path}: 1 problem", [Problem(problem)])

    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise refused("no such file") from None
    except IsADirectoryError:
        raise refused("this is a directory; name a YAML file") from None
    except UnicodeDecodeError as error:
        raise refused(f"not a text file: byte {error.start} is not UTF-8") from None
    except OSError as error:
        raise refused(f"cannot be read: {error.strerror}") from None
    try:
        value = parse_value(text)
    except ValueError as error:
        raise refused(str(error)) from None
    if value is None:
        raise refused("the file is empty; it needs at least task.environment, search.algorithm, a budget")
    if not isinstance(value, Mapping):
        raise refused(f"the top level is {show(value)}; write sections such as `task:` and `search:`")
    return value


def parse_value(text: str) -> object:
    """One value as a config file would have it: "1e-3" -> 0.001, "[64, 64]" -> a list, "null" -> None.

    Raises:
        ValueError: not YAML; one line says where and why.
    """
    try:
        return _yaml().load(text)
    except DuplicateKeyError as error:
        raise ValueError(_explain(error, text, f"{error.problem}; keep one")) from None
    except MarkedYAMLError as error:
        reason = " ".join(part for part in (error.context, error.problem) if part).replace("\t", "\\t")
        raise ValueError(_explain(error, text, f"not YAML: {reason}")) from None
    except ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ValueError(f"line {line}: not YAML: character code {error.character} is not allowed") from None
    except RecursionError:
        raise ValueError("not YAML that a config needs: nested too deeply") from None


def split_values(text: str) -> list[str]:
    """Texts of values between commas: "0.05,0.1" -> ["0.05", "0.1"], "[8, 8],[16]" -> ["[8, 8]", "[16]"].

    Raises:
        ValueError: one of them is empty, or not YAML.
    """
    inside = f"[{text}]"
    try:
        values = _yaml().compose(inside).value
    except (YAMLError, RecursionError):
        raise ValueError(f"{text} is no list of values between commas") from None
    return [inside[value.start_mark.index : value.end_mark.index] for value in values]


def dump_yaml(value: object) -> str:
    """Text that reads back as the same value: keys in their own order, lists on one line."""
    return _dump(value, flow=False, width=120)


def plain(value: Any) -> Any:
    """A value with Python's numbers and lists in place of those of NumPy, which a grid of settings often has."""
    if isinstance(value, list) and any(isinstance(item, np.generic) for item in value):
        return [item.tolist() if isinstance(item, np.generic) else item for item in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def in_line(value: object) -> str:
    """A value as one would type it in a config, on one line."""
    try:
        return _dump(value, flow=True, width=1_000_000).removesuffix("...\n").removesuffix("\n")
    except (YAMLError, RecursionError):  # from a Python mapping, or a list that contains itself
        return " ".join(repr(value).split())


def show(value: object) -> str:
    """`in_line`, shortened to about 60 characters."""
    text = in_line(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _yaml() -> YAML:
    """A new reader and writer, because ruamel's keep state from one text to the next."""
    yaml = YAML(typ="safe", pure=True)
    yaml.Constructor, yaml.Representer = _Constructor, _Representer
    yaml.sort_base_mapping_type_on_output = False  # pyright: ignore[reportAttributeAccessIssue]
    return yaml


def _dump(value: object, *, flow: bool, width: int) -> str:
    yaml = _yaml()
    yaml.default_flow_style, yaml.width = flow, width
    text = io.StringIO()
    yaml.dump(value, text)
    return text.getvalue()


def _explain(error: MarkedYAMLError, text: str, reason: str) -> str:
    """Line, column and text of an error. ruamel names the place where it gave up; the cause is often a line above."""
    mark = error.problem_mark or error.context_mark
    if mark is None:
        return reason
    lines = text.splitlines()
    offending = lines[mark.line].strip() if mark.line < len(lines) else "end of file"
    opened = error.context_mark
    since = f" (begun on line {opened.line + 1})" if opened and opened.line != mark.line else ""
    return f"line {mark.line + 1}, column {mark.column + 1}: {reason}{since}: {offending}"


def nearest(name: object, candidates: Collection[str]) -> str | None:
    """The candidate most similar to a name, in capitals or not; None if none is similar."""
    small = {candidate.lower(): candidate for candidate in candidates}
    near = get_close_matches(str(name).lower(), small, n=1)
    return small[near[0]] if near else None


def meant_task(name: str, known: Collection[str]) -> str | None:
    """The task that a name may mean: a similar one that is known, or an environment of Gymnasium; else None."""
    return nearest(name, known) or meant_environment(name) or None


def did_you_mean_task(name: str, known: Collection[str]) -> str:
    """`did_you_mean` for the name of a task."""
    meant = meant_task(name, known)
    return f"; did you mean {meant}?" if meant else ""


def did_you_mean(name: object, candidates: Collection[str]) -> str:
    """A hint to append to a message: "; did you mean X?", or "" if no candidate is similar."""
    near = nearest(name, candidates)
    return f"; did you mean {near}?" if near else ""


def one_of(names: Collection[str], word: str = "or") -> str:
    """Join names for a sentence: "a", "a or b", "a, b or c"; or with another word."""
    *first, last = map(str, names)
    return f"{', '.join(first)} {word} {last}" if first else last


def not_allowed(
    field: str, value: Any, allowed: str, *, why: str = "", hint: str = "", suggestion: Any = None
) -> Problem:
    """The problem of an invalid value: "search.pairs: 0 is not allowed; must be a whole number, at least 1".

    Args:
        why: words after "is not allowed", with the space before them.
        hint: the end of the line, instead of "; did you mean `suggestion`?".
    """
    ending = hint or (f"; did you mean {suggestion if isinstance(suggestion, str) else show(suggestion)}?"
                      if suggestion is not None else "")  # fmt: skip
    return Problem(
        f"{field}: {show(value)} is not allowed{why}; must be {allowed}{ending}", field, value, allowed, suggestion
    )


def wrong_value(field: str, value: Any, allowed: str, choices: Collection[Any] = ()) -> Problem:
    """The problem of a value that is invalid by itself, with how to write what was probably meant.

    Args:
        choices: the allowed values, if they are few.
    """
    hint, meant = "", None
    if value is None:
        hint = "; leave the key out to use its default"
    elif isinstance(value, str) and "number" in allowed and _is_number(value):
        hint, meant = f"; remove the quotes around {value}", parse_value(value)
    elif isinstance(value, float) and "whole number" in allowed and value.is_integer() and 1 <= value < 2**53:
        hint, meant = f"; write {int(value)}", int(value)
    elif isinstance(value, bool | int | float) and allowed == "text":
        hint = "; write it in quotes"
    elif isinstance(value, str):
        meant = nearest(value, [choice for choice in choices if isinstance(choice, str)])
    return not_allowed(field, value, allowed, hint=hint, suggestion=meant)


def _is_number(text: str) -> bool:
    try:
        return type(parse_value(text)) in (int, float)
    except ValueError:
        return False


def problem_of(field: str, value: Any, what: str, *, suggestion: Any = None, allowed: str | None = None) -> Problem:
    """The problem of a value that does not fit another one; `what` is the whole text after "field: "."""
    return Problem(f"{field}: {what}", field, value, allowed, suggestion)


def unknown_name(kind: str, name: str, known: Collection[str], field: str) -> ConfigError:
    """The error for a name that is not among those of its kind: "the format cvs is unknown; must be ..."."""
    allowed = one_of(known) if known else "left out, since there is none"
    return ConfigError(
        f"the {kind} {name} is unknown; must be {allowed}{did_you_mean(name, known)}",
        field=field,
        value=name,
        allowed=allowed,
        suggestion=nearest(name, known),
    )
