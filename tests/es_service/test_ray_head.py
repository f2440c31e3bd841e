"""What is learnt by calling the head of a cluster, here servers that answer as Ray does."""

from __future__ import annotations

import importlib
import socket
from concurrent.futures import ThreadPoolExecutor

import pytest

from es_service.dispatch import ray_head
from es_service.dispatch.ray_head import HEAD_CALL, grpc_module, require_head, status_code
from es_service.errors import EvaluationError


@pytest.fixture
def head(request, monkeypatch):
    """A gRPC server that answers as the head of a cluster whose token is `right` (None: without tokens); returns its
    address."""
    token = getattr(request, "param", "right")
    monkeypatch.setattr(ray_head, "CALL_S", 2.0)
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_USE_TLS"):
        monkeypatch.delenv(name, raising=False)
    grpc = importlib.import_module("grpc")

    def answer(_, context):
        if token and dict(context.invocation_metadata()).get("authorization") != f"Bearer {token}":
            context.abort(grpc.StatusCode.UNAUTHENTICATED, "")
        return b""

    service, _, call = HEAD_CALL[1:].partition("/")
    server = grpc.server(ThreadPoolExecutor(1))
    methods = {call: grpc.unary_unary_rpc_method_handler(answer)}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(service, methods),))
    address = f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}"
    server.start()
    yield address
    server.stop(None).wait()


def test_a_head_that_needs_a_token_answers_nobody_without_one(head):
    assert status_code(grpc_module(), head, HEAD_CALL) is not None
    assert status_code(grpc_module(), head, HEAD_CALL, "right") is None


@pytest.mark.slow
def test_what_is_wrong_with_the_token_is_said_before_a_cluster_is_joined(head, monkeypatch, tmp_path):
    with pytest.raises(
        EvaluationError, match=r"asks for a token, and this process sends none\. Set RAY_AUTH_MODE=token"
    ):
        require_head(head)
    monkeypatch.setenv("RAY_AUTH_TOKEN", "right")
    with pytest.raises(EvaluationError, match="sends that in RAY_AUTH_TOKEN only if RAY_AUTH_MODE is token"):
        require_head(head)
    require_head(head, is_auto=True)
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    require_head(head)
    monkeypatch.setenv("RAY_AUTH_TOKEN", "wrong")
    with pytest.raises(EvaluationError, match="the token in RAY_AUTH_TOKEN is not the cluster's") as wrong:
        require_head(head)
    assert (wrong.value.field, wrong.value.value) == ("compute.address", head)
    monkeypatch.delenv("RAY_AUTH_TOKEN")
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "token"))
    with pytest.raises(EvaluationError, match=f"there is none in RAY_AUTH_TOKEN or {tmp_path / 'token'}"):
        require_head(head)
    (tmp_path / "token").write_text("right\n")
    require_head(head)
    (tmp_path / "token").write_text("wrong\n")
    with pytest.raises(EvaluationError, match=f"the token in {tmp_path / 'token'} is not the cluster's"):
        require_head(head)


@pytest.mark.parametrize("head", [None], indirect=True)
def test_a_token_that_the_cluster_does_not_ask_for_is_refused(head, monkeypatch):
    """Ray accepts such a driver, and then each of its actors dies at once."""
    require_head(head)
    monkeypatch.setenv("RAY_AUTH_TOKEN", "right")
    require_head(head)
    require_head(head, is_auto=True)
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    with pytest.raises(EvaluationError, match=r"the cluster uses no token, but RAY_AUTH_MODE=token is set here"):
        require_head(head)


def test_a_server_that_is_no_head_is_named(head, monkeypatch):
    monkeypatch.setattr(ray_head, "HEAD_CALL", "/ray.rpc.NodeManagerService/GetSystemConfig")
    with pytest.raises(
        EvaluationError, match=f"at {head}: the server there does not answer as the head .*UNIMPLEMENTED"
    ):
        require_head(head)


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("127.0.0.1", "an address is HOST:PORT, or auto"),
        ("127.0.0.1:²", "an address is HOST:PORT, or auto"),
        ("http://127.0.0.1:1", "an address is HOST:PORT, or auto"),
        ("127.0.0.1:1", r"nothing listens at that address \(Connection refused\)"),
        ("127.0.0.1:99999", "nothing listens at that address "),
    ],
)
def test_an_address_where_nothing_answers_is_named(address, reason):
    with pytest.raises(EvaluationError, match=rf"could not connect to a Ray cluster at {address}: {reason}"):
        require_head(address)


def test_a_server_that_gives_no_answer_is_named_soon(monkeypatch):
    monkeypatch.setattr(ray_head, "CALL_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(
            EvaluationError, match=r"its port is open, but gives no answer within 0\.5 s; if the cluster"
        ):
            require_head(address)
