"""Options of the command line stand for keys of the config."""

from __future__ import annotations

import pytest

from es_service.cli import common as cli_options
from es_service.errors import ConfigError
from tests.es_service.config_examples import MINIMAL, load


def test_options_win_over_the_file_and_over_set():
    file = MINIMAL | {"compute": {"engine": "ray", "address": "head:6379", "worker_resources": {"gpu": 0.5}}}
    compute = load(file, *cli_options.overrides(["compute.workers=3"], seed=4, workers=2, engine="inline")).compute
    assert (compute.engine, compute.address, compute.worker_resources.gpu, compute.workers) == ("inline", None, 0.5, 2)
    compute = load(MINIMAL | {"compute": {"engine": "inline"}}, *cli_options.overrides(None, address="auto")).compute
    assert (compute.engine, compute.address) == ("ray", "auto")
    threads = MINIMAL | {"compute": {"engine": "inline", "inline_workers": "threads"}}
    for options in ({"engine": "ray"}, {"address": "auto"}, {"engine": "ray", "address": "auto"}):
        compute = load(threads, *cli_options.overrides(None, **options)).compute
        assert (compute.engine, compute.inline_workers) == ("ray", "processes")


def test_what_options_imply_does_not_silence_set():
    for wanted, problem in (
        (
            cli_options.overrides(["compute.address=h:1"], engine="inline"),
            "compute.address: h:1 needs compute.engine = ray",
        ),
        (cli_options.overrides(["compute.worker_resources.cpu=4"], engine="inline"), "worker_resources.cpu: 4 needs"),
        (
            cli_options.overrides(["compute.engine=inline"], address="h:1"),
            "compute.address: h:1 needs compute.engine = ray",
        ),
    ):
        with pytest.raises(ConfigError, match=problem):
            load(MINIMAL, *wanted)
