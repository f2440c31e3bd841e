"""What `doctor --cluster` learns by calling the ports of a cluster, here of servers that answer as Ray does."""

from __future__ import annotations

import importlib
import socket
from concurrent.futures import ThreadPoolExecutor

import pytest

from es_service.dispatch import ray_ports
from es_service.dispatch.ray_ports import open_ports, require_head
from es_service.errors import EvaluationError


@pytest.fixture
def head(monkeypatch):
    """A gRPC server that answers as the head of a cluster whose token is `right`; returns its address."""
    monkeypatch.setattr(ray_ports, "CALL_S", 2.0)
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_USE_TLS"):
        monkeypatch.delenv(name, raising=False)
    grpc = importlib.import_module("grpc")

    def answer(_, context):
        if dict(context.invocation_metadata()).get("authorization") != "Bearer right":
            context.abort(grpc.StatusCode.UNAUTHENTICATED, "")
        return b""

    service, _, call = ray_ports.HEAD_CALL[1:].partition("/")
    server = grpc.server(ThreadPoolExecutor(1))
    methods = {call: grpc.unary_unary_rpc_method_handler(answer)}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(service, methods),))
    address = f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}"
    server.start()
    yield address
    server.stop(None).wait()


def test_a_port_that_needs_a_token_is_not_open(head):
    assert open_ports([(head, ray_ports.HEAD_CALL), (head, ray_ports.NODE_CALL)]) == [False, False]


def test_the_token_of_this_host_is_tried_before_a_cluster_is_joined(head, monkeypatch, tmp_path):
    with pytest.raises(EvaluationError, match=r"needs a token, and this host has none\. Set RAY_AUTH_MODE=token"):
        require_head(head)
    monkeypatch.setenv("RAY_AUTH_TOKEN", "right")
    with pytest.raises(EvaluationError, match="needs a token, and this host has none"):
        require_head(head)
    require_head(head, is_auto=True)
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    require_head(head)
    monkeypatch.setenv("RAY_AUTH_TOKEN", "wrong")
    with pytest.raises(EvaluationError, match="refuses the token of this host"):
        require_head(head)
    monkeypatch.delenv("RAY_AUTH_TOKEN")
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "token"))
    with pytest.raises(EvaluationError, match="this host has none"):
        require_head(head)
    (tmp_path / "token").write_text("right\n")
    require_head(head)


def test_a_server_that_is_no_head_is_named(head, monkeypatch):
    monkeypatch.setattr(ray_ports, "HEAD_CALL", ray_ports.NODE_CALL)
    with pytest.raises(EvaluationError, match=f"the server at {head} does not answer as the head .*UNIMPLEMENTED"):
        require_head(head)


@pytest.mark.parametrize(
    ("address", "reason"), [("127.0.0.1", "'127.0.0.1' is neither HOST:PORT nor auto"), ("127.0.0.1:1", "refused")]
)
def test_an_address_where_nothing_answers_is_named(address, reason):
    with pytest.raises(EvaluationError, match=rf"no Ray cluster answers at {address} \(.*{reason}\). Give"):
        require_head(address)


def test_a_server_that_gives_no_answer_is_named_soon(monkeypatch):
    monkeypatch.setattr(ray_ports, "CALL_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(EvaluationError, match=r"is open, but gives no answer within 0\.5 s; if the cluster"):
            require_head(address)
