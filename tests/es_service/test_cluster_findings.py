"""What `doctor --cluster` says of a cluster, and what a node says of its software; without Ray."""

from __future__ import annotations

import http.server
import importlib
import json
import pickle
import subprocess
import sys
import threading

import pytest

from es_service.dispatch import cluster_findings as module
from es_service.dispatch import node_probe
from es_service.dispatch.cluster_findings import (
    access_findings,
    answers_anyone,
    cluster_findings,
    node_findings,
    node_names,
)
from es_service.errors import EvaluationError
from es_service.protocol.machine import VERSION

VERSIONS = {"ray": "2.60.0", "python": "3.11.2", "es-service": "0.8.0", "jax": "0.10.2", "cpu": "A 1/1 avx2"}
CODE = {"workers/worker.py": "a", "workers/policy.py": "b"}
OURS = "ray 2.60.0, python 3.11.2, es-service 0.8.0"
HERE = {"versions": VERSIONS, "sources": CODE, "problem": ""}


def said(*, first=HERE, second=HERE, silent=None):
    """What is found of two nodes, but for their number."""
    answers = {"one 10.0.0.1": first, **({} if silent else {"two 10.0.0.2": second})}
    return list(node_findings(answers, {"two 10.0.0.2": silent} if silent else {}, HERE))[1:]


def test_nodes_that_share_a_host_are_several():
    def node(name, host, *, port=1, alive=True):
        return {
            "NodeID": name, "NodeManagerHostname": host, "NodeManagerAddress": "10.0.0.1", "NodeManagerPort": port,
            "Alive": alive,
        }  # fmt: skip

    nodes = [node("a", "one", port=7), node("b", "one", port=8), node("c", "two"), node("d", "two", alive=False)]
    assert node_names(nodes) == {"a": "one 10.0.0.1:7", "b": "one 10.0.0.1:8", "c": "two 10.0.0.1"}


def test_what_was_checked_is_said_where_nothing_is_wrong():
    answers = {"one 10.0.0.1": HERE, "two 10.0.0.2": HERE}
    assert [*node_findings(answers, {}, HERE), *access_findings({"head a:6379": False}, 2, encrypted=True)] == [
        ("ok", "2 of 2 nodes answer: one 10.0.0.1, two 10.0.0.2"),
        ("ok", f"these nodes have {OURS}, and the packages and the code of this host"),
        ("ok", "none of these servers of Ray answers without a token: head a:6379"),
        ("ok", "Ray's processes use TLS"),
    ]


def test_nothing_is_in_order_if_no_node_answers():
    [(level, text)] = node_findings({}, {"one 10.0.0.1": "it ended", "two 10.0.0.2": "it ended"}, HERE)
    assert (level, text.startswith("one 10.0.0.1, two 10.0.0.2: the node does not answer")) == ("FAIL", True)


@pytest.mark.parametrize(
    ("found", "level", "words"),
    [
        (
            said(second=HERE | {"versions": VERSIONS | {"ray": "2.59.0", "jax": "0.9.0"}}),
            "FAIL",
            ("other versions: jax 0.9.0 (here 0.10.2), ray 2.59.0 (here 2.60.0); ", "constraints.txt"),
        ),
        (
            said(second=HERE | {"sources": CODE | {"workers/policy.py": "c"}}),
            "FAIL",
            ("other code than here in workers/policy.py;",),
        ),
        (
            said(second=HERE | {"sources": {"workers/worker.py": "a"}}),
            "FAIL",
            ("other code than here in workers/policy.py;",),
        ),
        (
            said(second=HERE | {"sources": {}, "problem": "ModuleNotFoundError: No module named 'es_service'"}),
            "FAIL",
            ("es-service cannot be used (ModuleNotFoundError: No module named 'es_service');",),
        ),
        (
            said(silent="nothing within 60 s"),
            "FAIL",
            ("does not answer a task (nothing within 60 s)", "session_latest/logs"),
        ),
        (
            said(second=HERE | {"versions": VERSIONS | {"cpu": "B 2/2 avx512f"}})[1:],
            "note",
            ("B 2/2 avx512f, here A 1/1 avx2", "mixed"),
        ),
    ],
)
def test_each_problem_is_one_line_that_names_the_node_and_what_to_do(found, level, words):
    [(its_level, text)] = found
    assert its_level == level
    assert text.startswith("two 10.0.0.2: ")
    assert "\n" not in text
    assert text.count("; ") >= 2
    for word in words:
        assert word in text


def test_nodes_with_the_same_problem_are_named_together():
    wrong = HERE | {"sources": {**CODE, "workers/policy.py": "c"}}
    [(_, text)] = said(first=wrong, second=wrong)
    assert text.startswith("one 10.0.0.1, two 10.0.0.2: other code")


def test_servers_that_need_no_token_are_named_and_several_hosts_without_tls_have_a_note():
    is_open = {"head a:6379": True, "dashboard a:8265": False}
    (level, text), note = access_findings(is_open, 2, encrypted=False)
    assert (level, text.startswith("head a:6379: Ray answers without a token; ")) == ("FAIL", True)
    assert (note[0], "TLS" in note[1]) == ("note", True)
    assert len(list(access_findings(is_open, 1, encrypted=False))) == 1


@pytest.mark.parametrize(("status", "is_open"), [(200, True), (404, True), (401, False), (403, False)])
def test_a_dashboard_is_open_if_it_answers_without_a_token(status, is_open):
    class Server(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            assert "Authorization" not in self.headers
            self.send_response(status)
            self.end_headers()

        def log_message(self, *_):
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Server) as server:
        threading.Thread(target=server.handle_request, daemon=True).start()
        address = f"127.0.0.1:{server.server_port}"
        assert answers_anyone(address) is is_open
    assert answers_anyone(address) is False, "nothing listens there any more"


@pytest.mark.slow
def test_the_probe_runs_where_es_service_is_another_one(tmp_path):
    """Ray sends the function itself, so that no module of ours has to be there."""
    cloudpickle = importlib.import_module("ray.cloudpickle")
    cloudpickle.register_pickle_by_value(node_probe)
    try:
        sent = cloudpickle.dumps(node_probe.software)
    finally:
        cloudpickle.unregister_pickle_by_value(node_probe)
    for file in ("es_service/__init__.py", "es_service/protocol/__init__.py", "es_service/protocol/machine.py"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text("")
    (tmp_path / "sent").write_bytes(sent)
    code = "import json, pickle, ray; print(json.dumps(pickle.load(open('sent', 'rb'))()))"
    environment = {"PYTHONPATH": str(tmp_path)}
    answer = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, check=True
    )
    software = json.loads(answer.stdout)
    assert software["problem"].startswith("ImportError: cannot import name 'platform_info'")
    assert software["versions"] == {name: node_probe.software()["versions"][name] for name in ("ray", "python")}


def test_this_host_knows_its_own_software():
    software = node_probe.software()
    assert software["problem"] == ""
    assert software["versions"]["es-service"] == VERSION
    assert "workers/worker.py" in software["sources"]
    assert pickle.loads(pickle.dumps(software)) == software


def test_without_the_extra_it_is_named_before_anything_is_joined(monkeypatch):
    monkeypatch.setitem(sys.modules, "grpc", None)
    monkeypatch.setattr(module, "connect", lambda *_, **__: pytest.fail("it was joined"))
    monkeypatch.setattr(module, "require_node", lambda address: None)
    with pytest.raises(EvaluationError, match="checks of a cluster need the extra `cluster`") as error:
        cluster_findings("127.0.0.1:1")
    assert error.value.way_out is not None
    assert (error.value.way_out.action, error.value.way_out.extra) == ("install", "cluster")
