"""What `doctor --cluster` says of the facts of a cluster, and how a node finds its facts; without Ray."""

from __future__ import annotations

import http.server
import importlib
import json
import pickle
import socket
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from es_service.dispatch import cluster_facts as module
from es_service.dispatch import node_probe
from es_service.dispatch.cluster_facts import ClusterFacts, NodeFacts, cluster_facts, public_sockets
from es_service.dispatch.cluster_findings import findings
from es_service.errors import ConfigError, EvaluationError
from es_service.protocol.machine import VERSION

VERSIONS = {"ray": "2.60.0", "python": "3.11.2", "es-service": "0.8.0", "jax": "0.10.2", "cpu": "A 1/1 avx2"}
CODE = {"workers/worker.py": "a", "workers/policies/policy.py": "b"}
HERE = NodeFacts("this host", VERSIONS, CODE)
SOUND = ClusterFacts(
    HERE,
    (
        replace(HERE, name="one 10.0.0.1", called=("head 6379", "raylet 7")),
        replace(HERE, name="two 10.0.0.2", called=("raylet 8",)),
    ),
    silent={},
    encrypted=True,
)


def bad(facts):
    """What is found, but for what is in order."""
    return [one for one in findings(facts) if one.level != "ok"]


def with_second(**facts):
    """The sound cluster, but for these facts about its second node."""
    return replace(SOUND, nodes=(SOUND.nodes[0], replace(SOUND.nodes[1], **facts)))


def test_nothing_is_found_where_nothing_is_wrong():
    """And what was checked is said."""
    assert [one.text for one in findings(replace(SOUND, shared="/runs"))] == [
        "2 of 2 nodes answer: one 10.0.0.1, two 10.0.0.2",
        "none of these servers of Ray answers without a token: 1 head, 2 raylets",
        "Ray listens on no public address of these nodes",
        "these nodes have ray 2.60.0, python 3.11.2, es-service 0.8.0 and the packages of this host",
        "these nodes have the code of this host",
        "these nodes share /runs with this host",
    ]
    assert bad(replace(SOUND, shared="/runs")) == []


def test_nothing_is_in_order_if_no_node_answers():
    facts = replace(SOUND, nodes=(), silent={"one 10.0.0.1": "it ended", "two 10.0.0.2": "it ended"})
    [found] = findings(facts)
    assert (found.level, found.where) == ("FAIL", "one 10.0.0.1, two 10.0.0.2")


@pytest.mark.parametrize(
    ("facts", "level", "words"),
    [
        (
            with_second(open_ports=("raylet 7", "dashboard 8")),
            "FAIL",
            ("(raylet 7, dashboard 8): Ray answers without",),
        ),
        (with_second(public=("9.9.9.9:7",)), "FAIL", ("(9.9.9.9:7): Ray listens on a public address", "firewall")),
        (
            with_second(versions=VERSIONS | {"ray": "2.59.0", "jax": "0.9.0"}),
            "FAIL",
            ("other versions: jax 0.9.0 (here 0.10.2), ray 2.59.0 (here 2.60.0); ", "constraints.txt"),
        ),
        (
            with_second(sources=CODE | {"workers/policies/policy.py": "c"}),
            "FAIL",
            ("other code than here in workers/policies/policy.py;",),
        ),
        (
            with_second(sources={"workers/worker.py": "a"}),
            "FAIL",
            ("other code than here in workers/policies/policy.py;",),
        ),
        (
            with_second(sources={}, problem="ModuleNotFoundError: No module named 'es_service'"),
            "FAIL",
            ("es-service cannot be used (ModuleNotFoundError: No module named 'es_service');",),
        ),
        (
            replace(with_second(not_shared="No such file or directory"), shared="/runs"),
            "FAIL",
            ("/runs is not shared (No such file or directory);", "mount the same disk"),
        ),
        (
            replace(SOUND, nodes=SOUND.nodes[:1], silent={"two 10.0.0.2": "nothing within 60 s"}),
            "FAIL",
            ("does not answer a task (nothing within 60 s)", "session_latest/logs"),
        ),
        (
            with_second(versions=VERSIONS | {"cpu": "B 2/2 avx512f"}),
            "note",
            ("B 2/2 avx512f, here A 1/1 avx2", "mixed"),
        ),
    ],
)
def test_each_problem_is_one_line_that_names_the_node_and_what_to_do(facts, level, words):
    (found,) = bad(facts)
    assert found.level == level
    assert found.where.split(" (")[0] == "two 10.0.0.2"
    assert found.text.startswith(f"{found.where}: ")
    assert "\n" not in found.text
    assert found.meaning
    assert found.way_out
    for word in words:
        assert word in found.text


def test_nodes_with_the_same_problem_are_named_together():
    wrong = {**CODE, "workers/policies/policy.py": "c"}
    facts = replace(SOUND, nodes=tuple(replace(node, sources=wrong) for node in SOUND.nodes))
    (found,) = bad(facts)
    assert found.where == "one 10.0.0.1, two 10.0.0.2"


def test_a_cluster_of_several_hosts_without_tls_has_a_note():
    (found,) = bad(replace(SOUND, encrypted=False))
    assert (found.level, "TLS" in found.way_out) == ("note", True)
    assert bad(replace(SOUND, nodes=SOUND.nodes[:1], encrypted=False)) == []


@pytest.mark.parametrize(
    ("bound", "public"),
    [
        ("127.0.0.1", ()),
        ("10.0.0.1", ()),
        ("8.8.8.8", ("8.8.8.8:7",)),
        ("::ffff:8.8.8.8", ("8.8.8.8:7",)),
        ("0.0.0.0", ("8.8.8.8:7",)),
        ("::", ("[2a00::1]:7", "8.8.8.8:7")),
        ("2a00::1", ("[2a00::1]:7",)),
        ("::1", ()),
    ],
)
def test_a_socket_is_public_where_it_listens_on_a_public_address_of_its_host(bound, public):
    own = ["127.0.0.1", "10.0.0.1", "8.8.8.8", "::1", "fe80::1", "2a00::1"]
    assert public_sockets([(bound, 7)], own) == public
    assert public_sockets([(bound, 7)], own[:2]) == (public if bound not in ("0.0.0.0", "::") else ())


def test_a_node_finds_the_sockets_that_listen_and_its_addresses():
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as client,
    ):
        port, other = server.getsockname()[1], client.getsockname()[1]
        assert node_probe.listening([port, other]) == [("127.0.0.1", port)]
    assert "127.0.0.1" in node_probe.addresses()


@pytest.mark.parametrize(("status", "is_open"), [(200, True), (404, True), (401, False), (403, False)])
def test_a_server_is_open_if_it_answers_without_a_token(status, is_open):
    class Server(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            assert "Authorization" not in self.headers
            self.send_response(status)
            self.end_headers()

        def log_message(self, *_):
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Server) as server:
        threading.Thread(target=server.handle_request, daemon=True).start()
        assert node_probe.is_open("127.0.0.1", server.server_port) is is_open
        gone = server.server_port
    assert node_probe.is_open("127.0.0.1", gone) is False


def test_a_file_is_shared_if_it_has_the_content_that_was_written(tmp_path):
    file = tmp_path / "file"
    assert node_probe.why_not_shared(str(file), "a") == "No such file or directory"
    file.write_text("a")
    assert node_probe.why_not_shared(str(file), "a") == ""
    assert node_probe.why_not_shared(str(file), "b") == "another file is there"


def test_the_probe_runs_where_es_service_is_another_one(tmp_path):
    """Ray sends the functions themselves, so that no module of ours has to be there."""
    cloudpickle = importlib.import_module("ray.cloudpickle")
    cloudpickle.register_pickle_by_value(node_probe)
    try:
        sent = cloudpickle.dumps(node_probe.facts)
    finally:
        cloudpickle.unregister_pickle_by_value(node_probe)
    for file in ("es_service/__init__.py", "es_service/protocol/__init__.py", "es_service/protocol/machine.py"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text("")
    (tmp_path / "sent").write_bytes(sent)
    code = (
        "import json, pickle, ray; facts = pickle.load(open('sent', 'rb'))([], [], None); "
        "print(json.dumps(facts['software']))"
    )
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
        cluster_facts("127.0.0.1:1")
    assert error.value.way_out is not None
    assert (error.value.way_out.action, error.value.way_out.extra) == ("install", "cluster")


@pytest.mark.parametrize("folder", ["missing", "file"])
def test_a_shared_folder_must_be_one_in_which_this_host_writes(tmp_path, folder):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=f"the shared folder .*{folder} must exist") as caught:
        cluster_facts("127.0.0.1:1", Path(tmp_path / folder))
    assert caught.value.field == "shared"
