"""``--ray-address`` where no cluster is: one line within seconds. Ray itself would try for a quarter of an hour."""

import socket
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import grpc
import pytest
from ray.util import get_node_ip_address

from rmc.cli import cluster_commands, main
from rmc.deploy.ray import head

QUICK_SECONDS = 60.0
HERE = get_node_ip_address()  # Ray takes no loopback
TOKEN = "c0ffee"
COMMANDS = (
    ["list"],
    ["stop", "run"],
    ["train", "InvertedPendulum-v5", "--launcher", "ray"],
    ["sweep", "InvertedPendulum-v5", "--launcher", "ray"],
)


class Head(grpc.GenericRpcHandler):
    """Answers the question of whether it is alive, to those that have its token where there is one."""

    def __init__(self, token: str = "") -> None:
        self._token = f"Bearer {token}" if token else None

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        if handler_call_details.method != head.QUESTION:
            return None
        given = dict(handler_call_details.invocation_metadata).get("authorization")

        def answer(_: bytes, context: grpc.ServicerContext) -> bytes:
            if given != self._token:
                context.abort(grpc.StatusCode.UNAUTHENTICATED, "token")
            return b""

        return grpc.unary_unary_rpc_method_handler(answer)


@contextmanager
def served(*handlers: grpc.GenericRpcHandler) -> Iterator[str]:
    server = grpc.server(ThreadPoolExecutor(1), handlers)
    address = f"{HERE}:{server.add_insecure_port(f'{HERE}:0')}"
    server.start()
    try:
        yield address
    finally:
        server.stop(0).wait()


@pytest.fixture(autouse=True)
def without_other_clusters(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("RAY_ADDRESS", "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_USE_TLS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "token"))
    monkeypatch.setattr(head.psutil, "process_iter", lambda *_: [])
    monkeypatch.chdir(tmp_path)


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """What a command says that must end soon."""
    began = time.monotonic()
    assert main.run(list(words)) == 2
    assert time.monotonic() - began < QUICK_SECONDS
    said = capsys.readouterr().err
    assert said.count("\n") == 1, said
    return said


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_where_nothing_listens_it_is_said_at_once(
    words: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for address in ("nowhere:1", "127.0.0.1:1"):
        said = refusal(capsys, *words, "--ray-address", address)
        assert said.startswith(f"rmc: --ray-address='{address}': no Ray cluster answers at ")
        assert "give the HOST:PORT" in said
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} <= {".lock", "sweep.jsonl"}  # no run is begun


def test_auto_takes_an_address_at_which_nothing_is_any_more(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "nowhere:1")
    assert refusal(capsys, "list", "--ray-address", "auto").startswith(
        "rmc: --ray-address='auto': no Ray cluster answers at nowhere:1; "
    )


@pytest.mark.parametrize("address", ["ray://nowhere:1", "nowhere", "a:b:c"])
def test_what_is_no_address_is_refused(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert refusal(capsys, "list", "--ray-address", address).startswith(f"rmc: --ray-address='{address}': ")


@pytest.mark.parametrize("words", COMMANDS[:2], ids=" ".join)
def test_a_cluster_of_its_own_has_no_run_to_list_or_stop(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert "starts a cluster of its own, where no run is" in refusal(capsys, *words, "--ray-address", "local")


def test_a_port_that_is_silent_or_anothers(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(head, "ANSWER_SECONDS", 0.5)
    with socket.create_server((HERE, 0)) as silent:
        said = refusal(capsys, "list", "--ray-address", f"{HERE}:{silent.getsockname()[1]}")
        assert "no Ray cluster answers at " in said
    with served() as address:
        assert ", but something else; give " in refusal(capsys, "list", "--ray-address", address)


def test_from_a_machine_that_is_no_node(capsys: pytest.CaptureFixture[str]) -> None:
    with served(Head()) as address:
        said = refusal(capsys, "list", "--ray-address", address)
    assert said.endswith(": this machine is no node of the cluster; go to one, by ray attach\n")


def test_a_head_wants_its_token(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with served(Head(TOKEN)) as address:
        monkeypatch.setenv("RAY_ADDRESS", address)
        (tmp_path / "token").write_text("another")
        assert "wants its token; set RAY_AUTH_MODE=token" in refusal(capsys, "list", "--ray-address", "auto")
        (tmp_path / "token").write_text(f"{TOKEN}\n")
        assert "wants its token" in refusal(capsys, "list", "--ray-address", address)  # Ray sends none without the mode
        assert "is no node" in refusal(capsys, "list", "--ray-address", "auto")
        monkeypatch.setenv("RAY_AUTH_MODE", "token")
        assert "is no node" in refusal(capsys, "list", "--ray-address", address)


@pytest.mark.parametrize("words", COMMANDS[:2], ids=" ".join)
def test_without_ray_it_is_said_how_to_install_it(
    words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)  # as Python keeps what cannot be imported
    said = refusal(capsys, *words, "--ray-address", "auto")
    assert said.startswith("rmc: --ray-address='auto': ray is missing; pip install ")


def test_what_ray_says_is_not_among_the_json(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextmanager
    def joined(address: str) -> Iterator[None]:
        print("(raylet) Raylet is terminated.")
        yield

    monkeypatch.setattr(cluster_commands.launcher, "joined", joined)
    monkeypatch.setattr(cluster_commands.cluster_runs, "summaries", lambda: {"run": None})
    assert main.run(["list", "--ray-address", "auto", "--json"]) == 0
    said = capsys.readouterr()
    assert (said.out, said.err) == ('[{"run": "run"}]\n', "(raylet) Raylet is terminated.\n")
