"""Strict YAML for configs: text -> plain values, with the line and column of what is wrong.

PyYAML follows YAML 1.1, in which `1e-3` is a string, `1:30` is ninety, `012` is ten and a repeated key silently
replaces the first. Here numbers are decimal, `1e-3` is a float, dates and sexagesimals are plain strings (which the
types of the config then reject) and a repeated key is a problem that names both lines.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import yaml

from es_service.errors import ConfigError, Problem

_DECIMAL = re.compile(r"[-+]?[0-9]+(_[0-9]+)*")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9][0-9_]*(\.[0-9_]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_DROPPED = {f"tag:yaml.org,2002:{kind}" for kind in ("int", "float", "timestamp", "value")}


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with the scalar rules of this module."""

    def construct_decimal(self, node: yaml.ScalarNode) -> int:
        """A whole number; PyYAML's own reads a leading 0 as octal."""
        return int(str(self.construct_scalar(node)))

    def construct_object(self, node: yaml.Node, deep: bool = False) -> object:
        """The value of a node. PyYAML's own errors say where; Python's come from text that is not what its tag says."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, KeyError, IndexError, AttributeError, TypeError, OverflowError):
            tag = node.tag.replace("tag:yaml.org,2002:", "!!")
            raise yaml.constructor.ConstructorError(None, None, f"this is no {tag}", node.start_mark) from None


class _Dumper(yaml.SafeDumper):
    """Quotes exactly those strings that `_Loader` would read as something else."""

    def ignore_aliases(self, data: object) -> bool:
        """Write a value that occurs twice in full both times: people read this."""
        return True


_Dumper.add_representer(list, lambda dumper, data: dumper.represent_sequence("tag:yaml.org,2002:seq", data, True))
for _class in (_Loader, _Dumper):
    _class.yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in rules if tag not in _DROPPED]
        for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    # The first pattern that matches wins, so whole numbers come before floats.
    _class.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(f"(?:{_DECIMAL.pattern})$"), list("-+0123456789"))
    _class.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(f"(?:{_FLOAT.pattern})$"), list("-+.0123456789"))
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_decimal)


def read_yaml_file(path: str | Path) -> tuple[Mapping[object, object], list[Problem]]:
    """Read a config file.

    Returns:
        The top-level mapping, and a problem for every repeated key (of which the last one counts).

    Raises:
        ConfigError: there is nothing to go on with: no such file, not text, not YAML, empty, not a mapping.
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
        value, problems = _parse(text)
    except ValueError as error:
        raise refused(str(error)) from None
    if value is None:
        raise refused("the file is empty; it needs at least task.environment, search.algorithm, a budget")
    if not isinstance(value, Mapping):
        raise refused(f"the top level is {show(value)}; write sections such as `task:` and `search:`")
    return value, problems


def parse_value(text: str) -> object:
    """One value as a config file would have it: "1e-3" -> 0.001, "[64, 64]" -> a list, "null" -> None.

    Raises:
        ValueError: not YAML; says where and why.
    """
    value, problems = _parse(text)
    if problems:
        raise ValueError(problems[0].sentence)
    return value


def dump_yaml(value: object) -> str:
    """Text that reads back as the same value: keys in their own order, lists on one line."""
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=120)


def in_line(value: object) -> str:
    """A value as one would type it in a config, on one line."""
    try:
        text = yaml.dump(value, Dumper=_Dumper, default_flow_style=True, width=1_000_000)
    except (yaml.YAMLError, RecursionError):  # from a Python mapping, or a list that contains itself
        text = repr(value)
    return " ".join(text.removesuffix("...\n").split())


def show(value: object) -> str:
    """`in_line`, shortened to about 60 characters."""
    text = in_line(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _parse(text: str) -> tuple[object, list[Problem]]:
    """Value and repeated keys of one document; ValueError with one readable line where it is not YAML."""
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None, []
        repeated = _repeated_keys(node, "", set())  # before construction, which writes merged keys into the nodes
        return loader.construct_document(node), repeated
    except yaml.MarkedYAMLError as error:
        raise ValueError(_explain(error, text)) from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ValueError(f"line {line}: not YAML: character code {error.character} is not allowed") from None
    except RecursionError:
        raise ValueError("not YAML that a config needs: nested too deeply") from None


def _explain(error: yaml.MarkedYAMLError, text: str) -> str:
    """Line, column and text of a syntax error. PyYAML names the place it gave up; the cause is often a line above."""
    reason = " ".join(part for part in (error.context, error.problem) if part).replace("\t", "\\t")
    mark = error.problem_mark or error.context_mark
    if mark is None:
        return f"not YAML: {reason}"
    lines = text.splitlines()
    offending = lines[mark.line].strip() if mark.line < len(lines) else "end of file"
    opened = error.context_mark
    since = f" (begun on line {opened.line + 1})" if opened and opened.line != mark.line else ""
    return f"line {mark.line + 1}, column {mark.column + 1}: not YAML: {reason}{since}: {offending}"


def _repeated_keys(node: yaml.Node, prefix: str, seen: set[int]) -> list[Problem]:
    """A problem for each key that its mapping already has; `seen` ends the walk where an alias contains itself."""
    if id(node) in seen:
        return []
    seen.add(id(node))
    problems: list[Problem] = []
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            problems += _repeated_keys(item, prefix, seen)
    elif isinstance(node, yaml.MappingNode):
        first_line: dict[str, int] = {}
        for key, value in node.value:
            name, line = f"{prefix}{key.value}", key.start_mark.line + 1
            if name in first_line:
                problems.append(
                    Problem(f"{name}: written twice, on lines {first_line[name]} and {line}; keep one", name)
                )
            first_line.setdefault(name, line)
            problems += _repeated_keys(value, f"{name}.", seen)
    return problems
