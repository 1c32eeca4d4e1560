"""rmc watch: a real browser and raw sockets at a real server, of runs whose lines the tests write."""

import asyncio
import dataclasses
import http.client
import json
import os
import selectors
import shutil
import signal
import socket
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
from imageio_ffmpeg import write_frames
from matplotlib.image import imsave

from rmc.analysis import live_run, watch_server
from rmc.analysis.live_run import POINTS, Curve, LiveRun
from rmc.cli.main import run
from rmc.common.env.config import EnvConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.presets import debug
from rmc.deploy.run.starts import note_start
from tests.analysis.browser import opened
from tests.command import COMMAND, complaint
from tests.hiding import hide
from tests.runs import RESULT, untrained
from tests.waiting import wait_until

PAGES, STREAM_SECONDS = 100, 4.0
CONFIG = dataclasses.replace(debug(EnvConfig("InvertedPendulum-v5")), total_steps=2000)
Serve = Callable[..., tuple[str, psutil.Process]]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Starts rmc watch and gives its URL and process. Ctrl-C ends it, with status 0 and without a word."""
    servers = []

    def start(*words: str, port: int = 0) -> tuple[str, psutil.Process]:
        command = [*COMMAND, "watch", *words, "--port", str(port)]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        servers.append(server)
        assert server.stdout is not None
        return server.stdout.readline().strip(), psutil.Process(server.pid)

    yield start
    for server in servers:
        server.send_signal(signal.SIGINT)
        _, errors = server.communicate(timeout=10)
        assert (server.returncode, errors) == (0, "")


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[RunFolder]:
    """A run that begins to train: nothing is written yet."""
    begun = open_run(CONFIG, LaunchOptions(tmp_path / "<b>run", "fail"))
    yield begun
    begun.lock.release()


def say(folder: RunFolder, role: str, **metrics: Any) -> None:
    with folder.metrics.open("a") as file:
        file.write(json.dumps({"role": role, "time": time.time(), **metrics}) + "\n")


def get(url: str, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes]:
    """Status and body; of a path that is sent as it is."""
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(url).port, timeout=10)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    body = answer.read() if answer.headers["content-type"] != "text/event-stream; charset=utf-8" else b""
    connection.close()
    return answer.status, body


def test_a_browser_shows_each_new_line_the_end_and_a_resume(serve: Serve, folder: RunFolder, tmp_path: Path) -> None:
    url, _ = serve(str(folder.path))
    with opened(url, tmp_path) as page:

        def shows(*words: str) -> None:
            for one in words:
                page.seconds_until(f"document.body.innerText.includes({json.dumps(one)})")

        shows("training")
        assert "0 of 2,000, – /s" in page.js("document.body.innerText")
        shares = {"busy_share": 0.08, "waiting_share": 0.92}
        say(folder, "actor-0", **shares, waiting_for="credit", refused_weights=2)
        say(folder, "learner", env_steps=700, updates_per_s=77.25, model_loss=0.5, busy_share=1.0, waiting_share=0.0)
        shows("77.25 /s")
        assert page.js("document.querySelector('[data-wait]').dataset.wait") == "actor learner"
        shows("busy 8 %, waits 92 %", "model loss")
        say(folder, "evaluator", eval_return_mean=123.5, eval_return_std=4.0, eval_update=5, eval_env_steps=600)
        shows("123.5 ± 4 at step 600")
        say(folder, "launcher", restarts=1, restarts_learner=1, wall_s=5.0)
        shows("learner started again")
        shows("actor-0: refused weights, 2 times")
        folder.write_result(RESULT)
        folder.lock.release(0)
        shows("finished", "11.5 ± 0.5")
        again = open_run(dataclasses.replace(CONFIG, total_steps=9000), LaunchOptions(folder.path))
        say(folder, "learner", env_steps=1600, updates_per_s=88.5)
        shows("88.5 /s", "1,600 of 9,000", "training")
        shows("start 2 from step 700 --total-steps 2000 to 9000")
        assert page.js("document.documentElement.scrollWidth - document.documentElement.clientWidth") == 0
        assert page.js("document.querySelectorAll('b').length") == 0
        again.lock.release(130)
        shows("stopped")


def test_a_page_whose_connection_dies_without_a_word_says_so_and_finds_it_again(
    serve: Serve, folder: RunFolder, tmp_path: Path
) -> None:
    url, server = serve(str(folder.path))
    with opened(url, tmp_path) as page:
        page.seconds_until("document.body.innerText.includes('training')")
        assert page.js("document.getElementById('lost').hidden")
        server.suspend()
        page.js("quietSeconds = 2")
        page.seconds_until("!document.getElementById('lost').hidden")
        server.resume()
        say(folder, "learner", env_steps=700, updates_per_s=77.25)
        page.seconds_until("document.getElementById('lost').hidden")
        page.js("quietSeconds = 40")
        page.seconds_until("document.body.innerText.includes('77.25 /s')")


def test_a_page_of_other_runs_than_before_shows_nothing_of_those(
    serve: Serve, folder: RunFolder, tmp_path: Path
) -> None:
    """Another rmc watch at the same port."""
    other = open_run(CONFIG, LaunchOptions(tmp_path / "other", "fail"))
    say(folder, "learner", env_steps=700, updates_per_s=77.25, model_loss=0.5)
    url, server = serve(str(folder.path), str(other.path))
    with opened(url, tmp_path) as page:
        page.seconds_until("document.body.innerText.includes('77.25 /s')")
        server.send_signal(signal.SIGINT)
        server.wait(10)
        say(other, "learner", env_steps=30, updates_per_s=9.25)
        serve(str(other.path), port=urlsplit(url).port or 0)
        page.seconds_until("document.body.innerText.includes('9.25 /s')")
        assert "model loss" not in page.js("document.body.innerText")
        assert page.js("document.querySelectorAll('section').length") == 1
    other.lock.release()


def test_a_run_made_anew_in_its_folder_shows_nothing_of_the_old_one(folder: RunFolder) -> None:
    live = LiveRun("run", folder.path)
    say(folder, "learner", env_steps=1700, updates_per_s=5.0, model_loss=1.0)
    say(folder, "evaluator", eval_return_mean=999.0, eval_return_std=0.0, eval_update=9, eval_env_steps=1700)
    assert (live.look() or {})["best_evaluation"] is not None
    folder.lock.release()
    shutil.rmtree(folder.path)
    anew = open_run(dataclasses.replace(CONFIG, seed=7), LaunchOptions(folder.path, "fail"))
    say(anew, "learner", env_steps=10, updates_per_s=9.0)
    found = live.look() or {}
    anew.lock.release()
    assert (found["whole"], found["seed"], found["best_evaluation"]) == (True, 7, None)
    assert found["curves"] == {"updates_per_s": (0, [(10, 9.0)])}
    say(anew, "learner", env_steps=20, updates_per_s=9.0)
    assert "whole" not in (live.look() or {})
    assert b'"whole":true' in watch_server.EventStream([live])._everything()  # a page may have missed it


def test_rates_are_the_newest_ones_of_a_long_run_too(folder: RunFolder) -> None:
    """A point of a long run's curve is a mean over minutes."""
    live = LiveRun("run", folder.path)
    for step in range(3 * POINTS + 2):
        say(folder, "learner", env_steps=step, updates_per_s=50.0)
    say(folder, "learner", env_steps=3 * POINTS, updates_per_s=2.0)
    found = live.look() or {}
    assert found["updates_per_s"] == 2.0
    assert found["env_steps_per_s"] is None
    assert found["curves"]["updates_per_s"][1][-1][1] > 10.0


def test_a_page_without_news_is_told_that_its_server_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch_server, "PING_SECONDS", 0.01)

    async def first(count: int) -> list[bytes]:
        stream = watch_server.EventStream([]).stream()
        return [await anext(stream) for _ in range(count)]

    assert asyncio.run(first(3)) == [b"", watch_server.PING, watch_server.PING]


def test_runs_stand_side_by_side_with_their_newest_picture_and_video(serve: Serve, tmp_path: Path) -> None:
    for name in ("one", "two"):
        untrained(tmp_path / "runs" / name, CONFIG, status=130)
    one = tmp_path / "runs" / "one"
    (one / "videos").mkdir()
    imsave(one / "inspect.png", np.zeros((8, 12)))
    video = write_frames(str(one / "videos" / "000000005.mp4"), (32, 32), macro_block_size=1)
    video.send(None)
    for _ in range(10):
        video.send(bytes(32 * 32 * 3))
    video.close()
    (one / "video.mp4").write_bytes(b"older")
    os.utime(one / "video.mp4", (1e9, 1e9))
    (one / "videos" / ".000000009.mp4").write_bytes(b"being filmed")
    url, _ = serve(str(tmp_path / "runs"), "--host", "0.0.0.0")
    address = urlsplit(url)
    with opened(f"http://127.0.0.1:{address.port}/?{address.query}", tmp_path) as page:
        page.seconds_until("document.images.length && document.images[0].naturalWidth === 12")
        page.seconds_until("document.querySelector('video').readyState >= 1")
        page.seconds_until("document.querySelectorAll('section svg').length === 4")
        assert page.js("new Set([...document.querySelectorAll('section')].map(one => one.offsetTop)).size") == 1


def test_no_token_no_answer(serve: Serve, folder: RunFolder) -> None:
    url, _ = serve(str(folder.path), "--host", "0.0.0.0")
    right = urlsplit(url).query
    assert len(right) > 40
    wrong = ("", "?token=", "?token=wrong", f"?{right}x", f"?{right[:-1]}", "?token=%ff", "?token=%C3%A9")
    for path in [place + query for place in ("/", "/events", "/media/0/picture", "/nowhere") for query in wrong]:
        assert get(url, path)[0] == 401, path
    assert [get(url, f"{path}?{right}")[0] for path in ("/", "/events", "/nowhere")] == [200, 200, 404]


def test_only_this_machine_reads_and_nobody_writes(serve: Serve, folder: RunFolder) -> None:
    url, _ = serve(str(folder.path))
    port = urlsplit(url).port
    assert url == f"http://127.0.0.1:{port}/"
    for host, status in {"localhost": 200, "[::1]": 200, "rebound.example": 400}.items():
        assert get(url, "/", Host=f"{host}:{port}")[0] == status
    for method in ("POST", "PUT", "PATCH", "DELETE"):
        assert [get(url, path, method)[0] for path in ("/", "/events", "/media/0/picture")] == [405] * 3


def test_a_name_of_this_machine_that_leads_to_itself_is_answered(serve: Serve, folder: RunFolder) -> None:
    """On Debian a machine's own name is 127.0.1.1."""
    url, _ = serve(str(folder.path), "--host", "127.0.1.1")
    with urllib.request.urlopen(url, timeout=10) as answer:
        assert answer.status == 200
    connection = http.client.HTTPConnection("127.0.1.1", urlsplit(url).port, timeout=10)
    connection.request("GET", "/", headers={"Host": "rebound.example"})
    assert connection.getresponse().status == 400
    connection.close()


def test_a_picture_that_goes_as_it_is_looked_at_is_no_end(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    live, gone = LiveRun("run", folder.path), folder.path / "picture.png"
    monkeypatch.setattr(live_run, "newest_media", lambda _: {"picture": gone})
    found = live.look()
    assert found is not None
    assert str(gone) in found["fault"]


def test_nothing_else_of_the_folder_is_served(serve: Serve, folder: RunFolder) -> None:
    secret = folder.secret()
    (folder.path / "picture.png").symlink_to(folder.secret_file)
    url, _ = serve(str(folder.path))
    folders = ("", "/media/0", "/media/0/picture", "/media", "/events", "/.")
    names = ["secret", "config.json", "metrics.jsonl", "picture", "%00", f"{folder.path}/secret"]
    names += [
        "../secret",
        "../../secret",
        "%2e%2e/secret",
        "..%2fsecret",
        "..%2f..%2fsecret",
        "....//secret",
        "..\\secret",
    ]
    others = ["/media/-1/picture", "/media/1/picture", "/media/0x0/picture", "//etc/passwd"]
    others += [f"/media/{number}/picture" for number in (10**30, "9" * 5000)]
    for path in [*(f"{place}/{name}" for place in folders for name in names), *others]:
        status, body = get(url, path)
        assert status == 404, path
        assert secret not in body


def test_headers_without_end_are_refused(serve: Serve, folder: RunFolder) -> None:
    """Before the token is checked: a stranger would fill the memory."""
    url, _ = serve(str(folder.path), "--host", "0.0.0.0")
    with socket.create_connection(("127.0.0.1", urlsplit(url).port or 0), 10) as stranger:
        stranger.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ")
        with pytest.raises(OSError, match=r"Broken pipe|reset by peer"):
            stranger.sendall(b"a" * (64 << 20))


def test_neither_garbage_nor_a_page_that_does_not_read_keeps_it_from_a_clean_end(
    serve: Serve, folder: RunFolder
) -> None:
    with (folder.path / "video.mp4").open("wb") as video:
        video.truncate(64 << 20)  # more than sockets hold
    url, server = serve(str(folder.path))
    address = ("127.0.0.1", urlsplit(url).port or 0)
    with socket.create_connection(address, 10) as stranger, socket.create_connection(address, 10) as slow:
        stranger.sendall(b"\0garbage\r\n\r\n")
        assert b"400 Bad Request" in stranger.recv(1 << 10)
        wait_until(lambda: get(url, "/media/0/video", "HEAD")[0] == 200, 10.0)
        slow.sendall(b"GET /media/0/video HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert slow.recv(1) == b"H"
        server.send_signal(signal.SIGINT)
        server.wait(8)


def test_a_hundred_pages_cost_little(serve: Serve, folder: RunFolder) -> None:
    """Records as a real run has them, four a second; each stream has all."""
    url, server = serve(str(folder.path))
    losses = {f"{name}_loss": 0.5 for name in "abcdef"}
    say(folder, "learner", env_steps=1, **losses)
    address, ready = ("127.0.0.1", urlsplit(url).port or 0), selectors.DefaultSelector()
    received = {socket.create_connection(address, 10): bytearray() for _ in range(PAGES)}
    for one in received:
        one.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        ready.register(one, selectors.EVENT_READ)

    def receive(until: float) -> None:
        while (left := until - time.monotonic()) > 0:
            for key, _ in ready.select(left):
                received[key.fileobj] += key.fileobj.recv(1 << 16)  # type: ignore[index, union-attr]

    receive(time.monotonic() + 1.5)
    assert all(b"a_loss" in text for text in received.values())
    before, began = sum(server.cpu_times()[:2]), time.monotonic()
    for number in range(int(4 * STREAM_SECONDS)):
        say(folder, "learner", env_steps=number, updates_per_s=number + 0.25, **losses)
        receive(began + (number + 1) / 4)
    cpu, seconds = sum(server.cpu_times()[:2]) - before, time.monotonic() - began
    receive(time.monotonic() + 1.0)
    last = f",{number + 0.25}]".encode()
    assert all(last in text for text in received.values())
    print(f"{PAGES} streams: {cpu:.2f} s of CPU in {seconds:.1f} s, {sum(map(len, received.values())):,} bytes")
    assert cpu < 0.5 * seconds
    server.send_signal(signal.SIGINT)
    for one in received:  # Ctrl-C ends each
        while one.recv(1 << 16):
            pass
        one.close()


def test_a_curve_is_short_whole_and_the_same_at_every_page() -> None:
    curve, page = Curve(), list[Any]()
    assert curve.news() is None
    for at in range(5 * POINTS + 3):  # the last is a multiple of 7
        curve.add(at, float(at))
        if at % 7 == 0 and (news := curve.news()) is not None:
            page[news[0] :] = news[1]
    assert page == curve.since(0)[1]
    assert len(page) <= POINTS
    assert page[0] == (4, 3.5)  # the mean of eight, steps rounded
    assert page[-1][1] >= 5 * POINTS - 8
    assert curve.news() is None


def test_roles_of_an_earlier_start_are_not_counted(folder: RunFolder) -> None:
    for index in range(3):
        say(folder, f"actor-{index}", time=time.time() - 1_000, busy_share=0.5)
    say(folder, "launcher", start_s=1.0, wall_s=100.0)
    say(folder, "actor-0", busy_share=0.5)
    roles = (LiveRun("run", folder.path).look() or {})["roles"]
    assert [one["count"] for one in roles if one["kind"] == "actor"] == [1]


def test_the_past_is_drawn_where_it_was_and_nobody_is_silent_meanwhile(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    note_start(folder, {}, LaunchOptions(folder.path), None)
    lines = folder.history_file.read_text().splitlines()
    resumed = json.dumps(json.loads(lines[-1]) | {"env_steps": 50_000, "time": time.time() - 2_000})
    folder.history_file.write_text("\n".join([*lines[:-1], resumed, ""]))
    for second in range(1_500):
        when = time.time() - 1_500 + second
        say(folder, "replay", time=when, env_steps=50 * second)
        say(folder, "learner", time=when, updates_per_s=10.0, env_steps=50 * second)
    monkeypatch.setattr(live_run, "LOOK_BYTES", 1 << 14)
    monkeypatch.setattr("rmc.deploy.monitor.run_status.SILENT_SECONDS", 600.0)
    watched, notices, states, looks = LiveRun("run", folder.path), [], [], 0
    while news := watched.look():
        notices.append(news.get("notices", {}))
        states += [news["state"]] if "state" in news else []
        looks += 1
    assert states == ["reading", "training"]
    assert looks > 5
    assert not any("silent" in one for one in notices)
    points = watched.everything()["curves"]["updates_per_s"][1]
    assert points[0][0] < 1_000
    assert len({steps for steps, _ in points}) > 100


def test_counters_make_events_that_do_not_repeat(folder: RunFolder) -> None:
    watched = LiveRun("run", folder.path)
    assert (watched.look() or {})["state"] == "training"

    def events() -> list[tuple[str, str, int]]:
        return [(one["kind"], one["what"], one["count"]) for one in (watched.look() or {})["events"]]

    say(folder, "launcher", restarts=1, restarts_replay=1)
    say(folder, "replay", dead_letters=3, dead_letters_crc=3, env_steps=50)
    say(folder, "replay", dead_letters=5, dead_letters_crc=5, env_steps=50)
    say(folder, "replay", dead_letters=1, dead_letters_crc=1, env_steps=50)  # it was started again
    expected = [
        ("start", "start 1", 1),
        ("restart", "replay started again", 1),
        ("refusal", "replay: dead letters crc", 6),
    ]
    assert events() == expected
    say(folder, "replay", dead_letters=1, dead_letters_crc=1, env_steps=60)
    assert "events" not in (watched.look() or {})
    (folder.path / "config.json").rename(folder.path / "moved")
    assert "no config.json there" in (watched.look() or {})["fault"]
    (folder.path / "moved").rename(folder.path / "config.json")
    assert (watched.look() or {})["fault"] == ""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "RUNS='': give folders of runs"),
        (["nowhere"], "is not there; give the folder of a run"),
        (["RUN", "--port", "70000"], "--port=70000: take a port from 0 to 65535"),
        (["RUN", "--port", "TAKEN"], "Address already in use on 127.0.0.1; take another, or 0 for a free one"),
        (["RUN", "--host", "no host"], "--host='no host': "),
        (["RUN", "--host", ".."], "--host='..': is no address"),
        (["RUN", "--host", "203.0.113.1"], "--host='203.0.113.1': is no address"),
    ],
)
def test_what_it_cannot_do_is_one_line(
    words: list[str], message: str, folder: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        values = {"RUN": str(folder.path), "TAKEN": str(taken.getsockname()[1])}
        assert message in complaint(["watch", *(values.get(word, word) for word in words)], capsys)


def test_what_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    hide("uvicorn", monkeypatch)
    assert "uvicorn is missing; pip install -e '.[watch]'" in complaint(["watch", "nowhere"], capsys)


def test_a_run_that_cannot_be_read_is_told_and_the_others_are_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    untrained(tmp_path / "runs" / "good", CONFIG, status=130)
    (tmp_path / "runs" / "newer" / "checkpoints").mkdir(parents=True)
    (tmp_path / "runs" / "newer" / "config.json").write_text('{"format": 999}')
    shown: list[LiveRun] = []
    monkeypatch.setattr("rmc.analysis.watch_server.serve", lambda runs, *_: shown.extend(runs))
    assert run(["watch", str(tmp_path / "runs"), "--port", "0"]) == 0
    assert len(shown) == 1
    assert "(left out)" in caplog.text
    assert run(["watch", str(tmp_path / "runs" / "newer"), "--port", "0"]) == 2
