"""Which code computes a run: the SHA-256 of each source file on which its bits depend, by the file's name.

Workers compute with `workers/`, `protocol/` and the modules of a user's task; the driver besides with `loop/`,
`search/`, `config/` and the modules of a user's search. Other folders of es_service never count: what they do changes
no bit. Names do not contain the place of an installation, so equal code has equal hashes everywhere. A changed comment
is a change, because only the bytes of a file are compared.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.machinery
import importlib.util
import os
import re
import socket
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from es_service.protocol.machine import architecture

Sources = Mapping[str, str]
"""Name of a source file, such as `workers/episode.py` -> the first half of its SHA-256, in hexadecimal digits; or name
of a library that defines a task or a search -> its version."""
OURS = ("es_service", "workers")
WORKERS = ("workers", "es_service.protocol")
"""Packages with which workers compute."""
DRIVER = ("es_service.loop", "es_service.search", "es_service.config")
"""Packages with which the driver computes besides."""
PATH_FOLLOWS = ("python", "function")
"""Kinds of tasks, the first word of their names, that are followed by the path of a user's code."""
SUITES = ("craftax", "gymnax", "jumanji", "kheperax", "playground")
"""Packages of environments in JAX, such as `gymnax:CartPole-v1`, by their names on the package index, which are also
those of our extras."""
VERSIONED = {**{suite: (suite,) for suite in SUITES}, "evosax": ("evosax", "optax")}
"""Kind of the names of tasks, and of searches such as `evosax:CMA_ES`, that a library defines -> packages whose
versions are recorded in the place of the hashes of their files."""
LIBRARY = "gymnasium"
"""Kind of the tasks that are environments of this library, and the library's package."""
MODELS, MODEL_FILES = "mujoco", "envs/mujoco/assets"
"""Kind of the tasks whose models are files of this library, also as the value of our tasks' option `physics`; and the
folder of its package that contains them."""
OUR_NAMESPACE, OUR_ENVIRONMENTS = "es_service", "es_service.gymnasium"
"""Gymnasium's namespace of our tasks, and the module that registers them."""
NAMED = 5
"""Names of files in a sentence."""
SHARED_FOLDERS = ("site-packages", "dist-packages")
"""Names of folders in which the packages of several projects are installed side by side."""


def task_code(environment: str, descriptor: object, options: Mapping[str, object]) -> tuple[str, ...]:
    """What a task's config says that names files that are none of ours: the task, a descriptor that is
    `module:function`, which is an option of a suite's task, and `mujoco:` if the options choose a model of MuJoCo for
    one of our tasks."""
    if environment.partition(":")[0] in SUITES:
        descriptor = options.get("descriptor")
    named = isinstance(descriptor, str) and ":" in descriptor
    modelled = ":" not in environment and options.get("physics") == MODELS
    return (environment, *((str(descriptor),) if named else ()), *((f"{MODELS}:",) if modelled else ()))


def worker_sources(*names: str) -> dict[str, str]:
    """Sources with which a worker computes.

    Those of this project are read once per process, because a process goes on with what it has imported. Those of the
    task are read anew, because new workers import them as they are now.

    Args:
        names: `task_code` of the task.
    """
    return _package_sources(*WORKERS) | user_sources(*names)


def driver_sources(algorithm: str) -> dict[str, str]:
    """Sources with which the driver computes besides those of the workers. Those of a user's search are read anew,
    because each run imports what has changed of them (`user_code.import_user_module`)."""
    return _package_sources(*DRIVER) | user_sources(algorithm)


def user_sources(*names: str) -> dict[str, str]:
    """Sources of what these names of tasks, descriptors or algorithms name, as they are now; none of ours."""
    sources: dict[str, str] = {}
    for name in names:
        if own := user_path(name):
            modules = modules_of(own)
            sources |= {module.source: module.sha256 for module in modules.user.values()}
            sources |= {source: sha256(file.read_bytes()) for source, file in modules.models.items()}
        if name.startswith(f"{LIBRARY}:"):
            with suppress(metadata.PackageNotFoundError):  # its version, in the place of the hash of its files
                sources[LIBRARY] = metadata.version(LIBRARY)
        if name.startswith(f"{MODELS}:"):
            sources |= _models()
        for package in VERSIONED.get(name.partition(":")[0], ()):
            with suppress(metadata.PackageNotFoundError):
                sources[package] = metadata.version(package)
    return sources


def _models() -> dict[str, str]:
    """Files of the models of Gymnasium's MuJoCo; a host may have another version of the package."""
    spec = importlib.util.find_spec(LIBRARY)
    folders = [Path(folder) / MODEL_FILES for folder in (spec and spec.submodule_search_locations) or ()]
    files = (file for folder in folders for file in sorted(folder.glob("*.xml")))
    return {f"{LIBRARY}/{MODEL_FILES}/{file.name}": sha256(file.read_bytes()) for file in files}


def other_files(ours: Sources, theirs: Sources) -> list[str]:
    """Names of the files that differ, or that only one side has, in alphabetical order."""
    return sorted(name for name in {*ours, *theirs} if ours.get(name) != theirs.get(name))


def in_words(files: list[str]) -> str:
    """The first NAMED of some names of files, and how many others there are."""
    return ", ".join(files[:NAMED]) + (f" and {len(files) - NAMED} others" if len(files) > NAMED else "")


class OtherCodeError(Exception):
    """This host must not work for a driver; the message names the host and the reason."""


def why_refused(expected: Sources, names: Sequence[str], platform: str = "any") -> str:
    """Why this process must not work for a driver, naming the host and what is wrong; empty if it may.

    Args:
        expected: `worker_sources` of the driver; empty if the driver does not ask for it.
        names: `task_code` of the task.
        platform: the value of `compute.platform`.
    """
    if platform not in ("any", architecture()):
        return (
            f"{socket.gethostname()} has a processor of the architecture {architecture()}, but compute.platform keeps "
            f"this run to {platform}. Set it to any if its digest may be marked mixed"
        )
    if not expected or not (other := other_files(expected, worker_sources(*names))):
        return ""
    return (
        f"{socket.gethostname()} has other code than the driver had when it started, so it must not compute for this "
        f"run: {in_words(other)}. Give every host the same files, or start the driver again if they were changed on "
        "purpose"
    )


def user_path(name: str) -> str:
    """The code of a user that a name in a config means, as `package.module:name`; empty if it means none.

    `brax:NAME`, `mujoco:ID`, `SUITE:NAME` and `evosax:NAME` are none. What is simulated by Python has the kind of the
    task before the path, as in `python:package.module:Class`. An environment of Gymnasium is the user's if it is named
    with the module that registers it, as in `gymnasium:package.module:Name-v0`, or else with a module's name as its
    namespace; ours, as in `gymnasium:es_service/AntMazeMujoco-v0`, are none.
    """
    kind, colon, rest = name.partition(":")
    if kind in ("brax", "mujoco", *VERSIONED):
        return ""
    if kind == LIBRARY:
        module, separator, environment = rest.partition(":" if ":" in rest else "/")
        return f"{module}:{environment}" if separator and module != OUR_NAMESPACE else ""
    return rest if kind in PATH_FOLLOWS and ":" in rest else name if colon else ""


def meant_environment(name: str) -> str:
    """The environment of Gymnasium that is meant by a name without its kind, or with another first word; empty if the
    name does not end in a version, as an ID does and no class can."""
    kind, _, rest = name.partition(":")
    if not re.search(r"-v\d+$", name):
        return ""
    is_kind = rest and (kind in PATH_FOLLOWS or get_close_matches(kind.lower(), ("gym", LIBRARY)))
    return f"{LIBRARY}:{rest if is_kind else name}"


@cache
def _package_sources(*packages: str) -> dict[str, str]:
    """All Python files in packages of this project, which are importable here."""
    sources: dict[str, str] = {}
    for package in packages:
        spec = importlib.util.find_spec(package)
        for folder in map(Path, (spec and spec.submodule_search_locations) or ()):
            for file in filter(Path.is_file, folder.rglob("*.py")):  # editors leave links that lead nowhere
                sources["/".join((*package.split("."), *file.relative_to(folder).parts))] = sha256(file.read_bytes())
    return sources


class UserModule(NamedTuple):
    """A module of a user, as its file is now."""

    file: Path
    source: str
    """Name of the file in `Sources`."""
    sha256: str
    needs: frozenset[str]
    """Names of the packages that contain it, and of the modules that it may import."""


class Modules(NamedTuple):
    """The modules of a user's task or search."""

    user: Mapping[str, UserModule]
    """Name of a module whose file counts as code -> the module."""
    others: frozenset[str]
    """Top packages outside the standard library that these files import from other places."""
    is_installed: bool
    """Whether they are a package that is installed beside those of other projects."""
    models: Mapping[str, Path]
    """Name in `Sources` -> file of a model of MuJoCo that a string of these modules names, or that such a model reads:
    included files, meshes, textures."""


def modules_of(path: str) -> Modules:
    """The module of `package.module:name`, its packages, and what they import from the same place, directly or not.

    Nothing is imported, so that the driver need not load what only the workers use: the modules are found by the import
    statements. The same place is the top package, and the folder that contains it, unless packages of several projects
    are installed there. Other packages count by their versions, if at all. A file of MuJoCo (MJCF) counts if a string
    in a module names it, relative to the module's folder.
    """
    name = path.partition(":")[0]
    top = _find(name.partition(".")[0], None)
    if top is None or top.name in sys.stdlib_module_names or not (place := _place(top)):
        return Modules({}, frozenset(), is_installed=False, models={})
    is_shared = os.path.basename(place) in SHARED_FOLDERS
    modules: dict[str, UserModule] = {}
    models: dict[str, Path] = {}
    others: set[str] = set()
    seen: set[str] = set()
    wanted = [name]
    while wanted:
        for spec in _chain(wanted.pop()):
            top_name = spec.name.partition(".")[0]
            if spec.name in seen or top_name in OURS:
                continue
            if (is_shared and top_name != top.name) or _place(spec) != place:
                others.add(top_name)
                continue
            seen.add(spec.name)
            if spec.origin is None:
                continue  # a package without a file of its own
            file, is_package = Path(spec.origin), spec.submodule_search_locations is not None
            source = "/".join(file.parts[-1 - spec.name.count(".") - is_package :])
            content, package = file.read_bytes(), spec.name if is_package else spec.name.rpartition(".")[0]
            needs = _imports(content, package) if file.suffix == ".py" else ()
            wanted += needs
            for model in _named_models(content, file.parent) if file.suffix == ".py" else ():
                models |= {_beside(source, os.path.relpath(read, file.parent)): read for read in model_files(model)}
            parts = spec.name.split(".")
            above = (".".join(parts[:count]) for count in range(1, len(parts)))
            modules[spec.name] = UserModule(file, source, sha256(content), frozenset((*needs, *above)))
    return Modules(modules, frozenset(others - sys.stdlib_module_names), is_shared, models)


def _chain(name: str) -> Iterator[importlib.machinery.ModuleSpec]:
    """The specs of a module and of the packages that contain it, outermost first, as far as they exist."""
    path = None
    parts = name.split(".")
    for count in range(1, len(parts) + 1):
        spec = _find(".".join(parts[:count]), path)
        if spec is None:
            return
        yield spec
        if spec.submodule_search_locations is None:
            return
        path = list(spec.submodule_search_locations)


def _find(name: str, path: list[str] | None) -> importlib.machinery.ModuleSpec | None:
    """The spec of a module, without importing it or its packages; None if there is none.

    Args:
        path: folders of the package that contains it; None for a top module, which may also be in the current folder.
    """
    for finder in sys.meta_path:
        if (spec := finder.find_spec(name, path)) is not None:
            return spec
    return importlib.machinery.PathFinder.find_spec(name, [os.getcwd()]) if path is None else None


def _place(spec: importlib.machinery.ModuleSpec) -> str:
    """Folder that contains the top package of a module; empty if the module is not in a file."""
    if spec.submodule_search_locations:
        own = next(iter(spec.submodule_search_locations))
    elif spec.has_location and spec.origin is not None:
        own = spec.origin
    else:
        return ""
    return str(Path(os.path.abspath(own)).parents[spec.name.count(".")])


def model_files(model: Path) -> list[Path]:
    """The files that MuJoCo reads for a model in MJCF: itself, what it includes, meshes, textures; those that exist.

    A file that is not read as XML names no others; MuJoCo says what is wrong with it.
    """
    found, folders = [model], {model.parent: None}
    for file in found:
        elements = _elements(file.read_bytes()) if file.suffix == ".xml" else []
        named = [element.get(f"{kind}dir") for element in elements for kind in ("mesh", "texture", "asset")]
        folders |= {model.parent / name: None for name in named if name}
        places = (Path(os.path.normpath(folder / name)) for name in _read_by(elements) for folder in folders)
        found += dict.fromkeys(place for place in places if place.is_file() and place not in found)
    return found


def files_read(xml: bytes) -> list[str]:
    """Names of the files that a model in MJCF reads: what it includes, meshes, textures."""
    return _read_by(_elements(xml))


def _elements(xml: bytes) -> list[ElementTree.Element]:
    """All elements of an XML; none if it cannot be read."""
    try:
        return list(ElementTree.fromstring(xml).iter())
    except ElementTree.ParseError:
        return []


def _read_by(elements: list[ElementTree.Element]) -> list[str]:
    return [value for element in elements for key, value in element.items() if key.startswith("file")]


def _beside(source: str, relative: str) -> str:
    """Name in `Sources` of a file relative to the folder of another; only its own name if it is outside of the place
    of the user's modules."""
    name = os.path.normpath(os.path.join(os.path.dirname(source), relative))
    return os.path.basename(name) if name.startswith((os.pardir, os.sep)) else name


def _named_models(content: bytes, folder: Path) -> list[Path]:
    """Files of MuJoCo that strings of a source file name, relative to its folder."""
    files = (Path(os.path.normpath(folder / name)) for name in _names_of_xml(content))
    return [file for file in files if file.is_file()]


@lru_cache(maxsize=1024)
def _names_of_xml(content: bytes) -> tuple[str, ...]:
    """Strings of a source file that may name a file of MuJoCo."""
    texts = (node.value for node in ast.walk(_tree(content)) if isinstance(node, ast.Constant))
    return tuple(text for text in texts if isinstance(text, str) and text.endswith(".xml") and text.isprintable())


def _tree(content: bytes) -> ast.Module:
    """The syntax tree of a source file; an empty one if it has errors, since its import is going to fail."""
    try:
        return ast.parse(content)
    except (SyntaxError, ValueError):
        return ast.Module([], [])


@lru_cache(maxsize=1024)
def _imports(content: bytes, package: str) -> tuple[str, ...]:
    """Names of the modules that a source file may import, also inside its functions."""
    names: list[str] = []
    for node in ast.walk(_tree(content)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.rsplit(".", node.level - 1)[0] if node.level > 1 else package
            base = ".".join(filter(None, (above if node.level else "", node.module)))
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return tuple(filter(None, names))


def sha256(content: bytes) -> str:
    """The hash of a source file in `Sources`."""
    return hashlib.sha256(content).hexdigest()[:32]


def is_hash(text: str) -> bool:
    """Whether a value of `Sources` is a hash; else it is a version."""
    return re.fullmatch("[0-9a-f]{32}", text) is not None
