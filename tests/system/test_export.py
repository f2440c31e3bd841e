"""`export`: what other programs read holds what the run holds."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from es_service.runs.export import ribs_archive
from es_service.runs.snapshot import map_places
from es_service.search.maps.geometry import Grid
from tests.system.command_line import command


def test_elites_at_the_edges_of_cells_keep_their_cells_in_pyribs(monkeypatch, mapped):
    map_, elites = mapped.elites()
    geometry = map_.geometry
    assert isinstance(geometry, Grid)
    low_N_2 = np.stack([edges[place] for edges, place in zip(geometry.edges, map_places(map_).T, strict=True)], axis=1)
    for shifted in (low_N_2, np.nextafter(low_N_2 + 1 / 8, -9)):
        moved = replace(map_, descriptor_N_B=shifted)
        np.testing.assert_array_equal(geometry.cells_of(shifted), map_.cell_N)
        monkeypatch.setattr(type(mapped), "elites", lambda self, moved=moved: (moved, elites))
        archive = ribs_archive(mapped)
        assert archive.stats.num_elites == map_.size


def test_exports_hold_what_the_run_holds(tmp_path, mapped):
    for to in ("csv", "parquet", "npz", "ribs"):
        result = command("export", mapped.folder, "--to", to, "--out", tmp_path)
        assert result.returncode == 0, result.stderr
    for read, ending in ((pd.read_csv, "csv"), (pd.read_parquet, "parquet")):
        pd.testing.assert_frame_equal(read(tmp_path / f"map.{ending}"), mapped.map)
        history = read(tmp_path / f"history.{ending}").set_index("generation")
        pd.testing.assert_frame_equal(history, mapped.history, check_dtype=False)
    with np.load(tmp_path / "policies.npz") as arrays:
        assert arrays["widths"].tolist() == [2, 8, 2]
        assert arrays["cell"].tolist() == mapped.map[["cell_x", "cell_y"]].to_numpy().tolist()
        np.testing.assert_array_equal(arrays["fitness"], mapped.map["fitness"])
        np.testing.assert_array_equal(arrays["best_parameters"], mapped.policy("best").parameters_D)
        elite = mapped.elite(arrays["cell"][3])
        np.testing.assert_array_equal(arrays["parameters"][3], elite.parameters_D)
        np.testing.assert_array_equal(arrays["trace"][3], elite.trace_T_B)
    result = command("export", mapped.folder, "--to", "pdf")
    assert result.returncode == 2
    assert "must be csv, parquet, npz, onnx, ribs or tensorboard" in result.stderr


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_ribs_archive_opens_and_plots(tmp_path, mapped):
    import matplotlib
    from ribs import visualize

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    assert command("export", mapped.folder, "--to", "ribs", "--out", tmp_path).returncode == 0
    with (tmp_path / "archive.pickle").open("rb") as file:
        archive = pickle.load(file)
    assert archive.stats.num_elites == len(mapped.map)
    assert archive.stats.obj_max == pytest.approx(mapped.map["fitness"].max())
    assert archive.stats.qd_score == pytest.approx(mapped.history["qd_score"].iloc[-1])
    visualize.grid_archive_heatmap(archive)
    plt.savefig(tmp_path / "heatmap.png")
    plt.close()
    assert (tmp_path / "heatmap.png").stat().st_size > 1000
