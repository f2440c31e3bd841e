"""Export of a run: tables (csv, parquet), arrays (npz), models (onnx), a pyribs archive (ribs), TensorBoard files."""

from __future__ import annotations

import hashlib
import math
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from es_service.config.text import unknown_name
from es_service.errors import ConfigError, NotInRunError, StoreError, WayOut
from es_service.protocol.options import ParameterSpec
from es_service.runs.certified import newest_certified
from es_service.runs.onnx import about, model_card, onnx_model
from es_service.runs.snapshot import Policy, Snapshot, map_places
from es_service.runs.tracking import TensorBoard, check_trackers, fill
from es_service.runs.view import Run, named_best, named_by_all
from es_service.search.maps.behaviour_map import BehaviourMap, Elite
from es_service.search.maps.geometry import Grid
from es_service.store.folder import leads_out

if TYPE_CHECKING:
    import pandas as pd


RIBS_MARGIN = 2e-6
"""Least distance of exported descriptors from a cell's edge: pyribs adds 1e-6 to a measure before finding its cell."""


SUMS = "SHA256SUMS"
"""File with the SHA-256 of each exported file, in the format of `sha256sum`: `sha256sum -c` finds damaged ones."""


def export(run: Run, to: str, folder: Path) -> list[Path]:
    """Write a run into `folder`, which is created if needed, and return the files written. Older files are replaced.
    Of other formats than that of TensorBoard, the last file, `SHA256SUMS`, has the SHA-256 of the others. No link in
    the folder of a run is followed: that of a stranger might lead to other files of the user's.

    Args:
        to: a key of FORMATS.

    Raises:
        ConfigError: the format is unknown, or needs a package that is not installed. NotInRunError: the run has no
            finished generation, or not the map that the format needs. StoreError: the folder cannot be written, or is
            inside the run's and leads out of it.
    """
    if to not in FORMATS:
        raise unknown_name("format", to, FORMATS, "to")
    if run.generation is None:
        way_out = WayOut("resume", "continue it", str(run.folder))
        raise NotInRunError(f"{run.folder} has no finished generation yet", run=run.folder, ways_out=[way_out])
    if folder.absolute().is_relative_to(run.folder.absolute()) and leads_out(folder, run.folder):
        what = f"{folder} is a link that leads out of {run.folder}; name the folder to write into"
        raise StoreError(what, field="out", value=str(folder), run=run.folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        files = FORMATS[to](run, folder)
        # Events of TensorBoard have checksums of their own.
        return files if to == "tensorboard" else [*files, _write_sums(folder, files)]
    except OSError as error:
        raise StoreError(f"cannot write into {folder}: {error.strerror or error}; choose another folder") from error


def tables(run: Run) -> Iterator[tuple[str, pd.DataFrame]]:
    """Names and content of history, evaluated centres, novelty archive and, where there are any, the map, the
    parameters of a function that is the task, the certified policies, and the decisions on `budget.target_certified`;
    all but the last two as of one generation. They come one by one, because the first two may be large.

    The parameters are those of the best centre, of the newest one (if the generation evaluated one) and of the elites:
    `which` is best, centre or the place of a cell, such as 3,17; then each parameter in the units of the function."""
    snapshot = run.at(named=(lambda snapshot: ()) if run.task.parameters is None else named_by_all)
    yield "history", run.history_until(snapshot.generation).reset_index()
    yield "evaluations", run.evaluations_until(snapshot.generation)
    yield "novelty", snapshot.novelty
    if run.constants["map.enabled"]:
        yield "map", snapshot.map
    if run.task.parameters is not None:
        yield "parameters", _parameters(snapshot, run.task.parameters, has_map=run.constants["map.enabled"])
    if not (certified := run.certified).empty:
        yield "certified", certified
    if not (decisions := run.decisions).empty:
        yield "decisions", decisions


def arrays(run: Run) -> dict[str, np.ndarray]:
    """All policies of a run after one generation, with their observation statistics: the best centre, the newest
    centre (none if the generation evaluated only policies, as those of map_elites do) and every elite of the map; and
    the certified policy, if there is one.

    Names: `widths` of the layers, `activation`, `output`, `bias` and `memory` (0: none) as in the config,
    `observation_clip` (NaN: none); for the best, the newest and the certified one `best_parameters` [D], `best_mean`
    [O], `best_std` [O], `centre_parameters`, ..., `certified_parameters`, ...; for N elites `cell` [N, dimensions of
    the map], `fitness` [N], `descriptor` [N, B], `generation` [N], `samples` [N] (where they are counted), `parameters`
    [N, D], `mean` [N, O], `std` [N, O], `trace` [N, T, B]. A layer's weights [inputs, outputs] come before its biases,
    layer after layer; those of a memory are of its gates and its candidate (`workers/policy.py`). If actions of -1 and
    1 stand for other values of the environment, these are `action_low` [A] and `action_high` [A]. If the task is a
    function, `parameter_names` [D], and in its units `best_values` [D], `centre_values` [D] and `values` [N, D].
    """
    snapshot = run.at(named=named_by_all)
    clip, spec = run.constants["policy.observation_clip"], run.policy_spec
    exported: dict[str, Any] = {
        "widths": np.array(spec.widths),
        "activation": np.array(spec.activation),
        "output": np.array(spec.output),
        "bias": np.array(spec.bias),
        "memory": np.array(spec.memory),
        "observation_clip": np.array(math.nan if clip is None else clip),
    }
    if bounds := run.task.action_bounds:
        exported["action_low"], exported["action_high"] = np.array(bounds).T
    policies = {"best": snapshot.policy("best")}
    if snapshot.newest_centre is not None:
        policies["centre"] = snapshot.policy("centre")
    if newest_certified(run.folder) is not None:
        policies["certified"] = run.policy("certified")
    for which, policy in policies.items():
        exported |= {
            f"{which}_parameters": policy.parameters_D,
            f"{which}_mean": policy.observation_mean_O,
            f"{which}_std": policy.observation_std_O,
        }
    if run.constants["map.enabled"]:
        map_, elites = snapshot.elites()
        exported |= _map_arrays(run, map_, elites)
    if (named := run.task.parameters) is not None:
        exported["parameter_names"] = np.array(named.names)
        of = [name.removesuffix("parameters") for name in exported if name.endswith("parameters")]
        exported |= {f"{prefix}values": named.values(exported[f"{prefix}parameters"]) for prefix in of}
    return exported


def ribs_archive(run: Run) -> Any:
    """The map as a `ribs.archives.GridArchive`: solutions are parameters, measures descriptors, objectives fitness.

    Extra fields: `generation`, `observation_mean`, `observation_std`. pyribs rounds differently, so descriptors nearer
    than 2e-6 to an edge of their cell, or outside the bounds, are moved to 2e-6 inside their cell.

    Raises:
        ConfigError: pyribs is not installed. NotInRunError: the run has no map, or it is empty, not a grid, or has
            cells that are too small for pyribs.
    """
    try:
        from ribs.archives import GridArchive
    except ImportError as error:
        raise ConfigError(
            "a pyribs archive needs pyribs", field="to", value="ribs", ways_out=[_install("ribs")]
        ) from error
    map_, elites = run.elites()
    if not isinstance(map_.geometry, Grid):
        raise NotInRunError(
            f"the map of {run.folder} is of kind {run.constants['map.kind']}, but a GridArchive needs a grid; export "
            "to npz instead",
            run=run.folder,
        )
    if not map_.size:
        raise NotInRunError(f"the map of {run.folder} is empty", run=run.folder)
    columns = _map_arrays(run, map_, elites)
    size = columns["mean"].shape[1]
    archive = GridArchive(
        solution_dim=columns["parameters"].shape[1],
        dims=map_.geometry.shape,
        ranges=map_.geometry.bounds,
        qd_score_offset=run.constants["map.qd_offset"],
        extra_fields={
            "generation": ((), np.int64),
            "observation_mean": ((size,), np.float32),
            "observation_std": ((size,), np.float32),
        },
    )
    edges = list(zip(map_.geometry.edges, columns["cell"].T, strict=True))
    low_N_B, high_N_B = (np.stack([of[cell + up] for of, cell in edges], axis=1) for up in (0, 1))
    margin_N_B = np.minimum(RIBS_MARGIN, (high_N_B - low_N_B) / 4)
    archive.add(
        solution=columns["parameters"],
        objective=columns["fitness"],
        measures=np.clip(columns["descriptor"], low_N_B + margin_N_B, high_N_B - margin_N_B),
        generation=columns["generation"],
        observation_mean=columns["mean"],
        observation_std=columns["std"],
    )
    if archive.stats.num_elites != map_.size:
        raise NotInRunError(
            f"the cells of {run.folder} are too small for pyribs, which puts the {map_.size} elites into "
            f"{archive.stats.num_elites} cells; export to npz instead",
            run=run.folder,
        )
    return archive


def _map_arrays(run: Run, map_: BehaviourMap, elites: dict[int, Elite]) -> dict[str, np.ndarray]:
    fields = {
        "parameters": "parameters_D",
        "mean": "observation_mean_O",
        "std": "observation_std_O",
        "trace": "trace_T_B",
    }
    sizes = {"parameters": (run.policy_spec.parameters,), "trace": (0, len(map_.geometry.bounds))}
    none = run.policy_spec.widths[:1]
    return {
        "cell": map_places(map_),
        "fitness": map_.fitness_N,
        "descriptor": map_.descriptor_N_B,
        "generation": map_.generation_N,
        **({} if map_.samples_N is None else {"samples": map_.samples_N}),
        **{
            name: np.array([getattr(elite, field) for elite in elites.values()], np.float32)
            if elites
            else np.zeros((0, *sizes.get(name, none)), np.float32)
            for name, field in fields.items()
        },
    }


def _parameters(snapshot: Snapshot, spec: ParameterSpec, *, has_map: bool) -> pd.DataFrame:
    """The table of parameters; see `tables`."""
    import pandas as pd

    rows = {"best": snapshot.policy("best").parameters_D}
    if snapshot.newest_centre is not None:
        rows["centre"] = snapshot.policy("centre").parameters_D
    if has_map:
        map_, elites = snapshot.elites()
        places = [",".join(map(str, place)) for place in map_places(map_).reshape(map_.size, -1).tolist()]
        rows |= zip(places, (elite.parameters_D for elite in elites.values()), strict=True)
    table = pd.DataFrame(spec.values(np.stack(list(rows.values()))), columns=pd.Index(spec.names))
    table.insert(0, "which", list(rows), allow_duplicates=True)
    return table


def _new(folder: Path, name: str) -> Path:
    """A path to write to; what is there is removed unless it is a file, since writing to a link changes what it leads
    to."""
    path = folder / name
    if path.is_symlink() or not path.is_file():
        path.unlink(missing_ok=True)
    return path


def _csv(run: Run, folder: Path) -> list[Path]:
    written = []
    for name, table in tables(run):
        written.append(_new(folder, f"{name}.csv"))
        table.to_csv(written[-1], index=False, lineterminator="\n")
    return written


def _parquet(run: Run, folder: Path) -> list[Path]:
    written = []
    for name, table in tables(run):
        written.append(_new(folder, f"{name}.parquet"))
        try:
            table.to_parquet(written[-1], index=False)
        except ImportError as error:
            ways_out = [_install("parquet")]
            raise ConfigError("parquet needs pyarrow", field="to", value="parquet", ways_out=ways_out) from error
    return written


def _write_sums(folder: Path, files: list[Path]) -> Path:
    """Write the SHA-256 of new files into SHA256SUMS, beside those of other files that are still there."""
    sums, digests = _new(folder, SUMS), {}
    if sums.exists():
        lines = (line.partition("  ") for line in sums.read_text(encoding="utf-8", errors="replace").splitlines())
        there = {path.name for path in folder.iterdir()}
        digests = {name: sha256 for sha256, _, name in lines if name in there}
    for file in files:
        with file.open("rb") as stream:
            digests[file.name] = hashlib.file_digest(stream, "sha256").hexdigest()
    sums.write_text("".join(f"{sha256}  {name}\n" for name, sha256 in sorted(digests.items())), encoding="utf-8")
    return sums


def _install(extra: str) -> WayOut:
    return WayOut("install", "install it", extra=extra)


def _npz(run: Run, folder: Path) -> list[Path]:
    file = _new(folder, "policies.npz")
    np.savez(file, allow_pickle=False, **arrays(run))
    return [file]


def _onnx(run: Run, folder: Path) -> list[Path]:
    if run.task.parameters is not None:
        what = f"{run.folder} has no policies, since its task is a function; csv and npz have its parameters"
        raise NotInRunError(what, run=run.folder)
    certified, snapshot = newest_certified(run.folder), run.at(named=named_best)
    policies: dict[str, Policy] = {} if certified is None else {"certified": run.policy("certified")}
    policies["best"] = snapshot.policy("best")
    if snapshot.newest_centre is not None:
        policies["centre"] = snapshot.policy("centre")
    written = []
    for name, policy in policies.items():
        model = onnx_model(policy, about(run, certified if name == "certified" else None))
        written.append(_new(folder, f"{name}.onnx"))
        written[-1].write_bytes(model.SerializeToString())
    card = _new(folder, "model_card.md")
    card.write_text(model_card(run, [file.name for file in written], certified), encoding="utf-8")
    return [*written, card]


def _ribs(run: Run, folder: Path) -> list[Path]:
    file = _new(folder, "archive.pickle")
    archive = ribs_archive(run)
    with file.open("wb") as stream:
        pickle.dump(archive, stream)
    return [file]


def _tensorboard(run: Run, folder: Path) -> list[Path]:
    check_trackers(["tensorboard"])
    tracker = TensorBoard(run, folder)
    for file in tracker.files():
        file.unlink()
    fill(tracker, run, -1)
    tracker.close()
    return tracker.files()


FORMATS: dict[str, Callable[[Run, Path], list[Path]]] = {
    "csv": _csv,
    "parquet": _parquet,
    "npz": _npz,
    "onnx": _onnx,
    "ribs": _ribs,
    "tensorboard": _tensorboard,
}
