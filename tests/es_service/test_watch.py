"""The live page without a browser: what is found, read, drawn and sent, and who is refused."""

import asyncio
import json
import os
import re
import shutil
import socket
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from urllib.parse import quote

import numpy as np
import pytest
from typer.testing import CliRunner

from es_service import api
from es_service.cli.main import app as program
from es_service.errors import StoreError
from es_service.report.data import read_run
from es_service.report.page import run_sections
from es_service.report.summary import number
from es_service.report.write import python_call
from es_service.runs.certification import certify_run
from es_service.store import reader, upkeep, writer
from es_service.store.codec import text_sha256
from es_service.store.lock import acquire_lock
from es_service.watch import channels, server
from es_service.watch.pages import draw_comparison, draw_list, draw_run
from es_service.watch.runs import RunReading, Runs
from es_service.watch.server import Site
from tests.database import database, execute
from tests.es_service.test_report_page import Elements
from tests.helpers import workers_in_this_process
from tests.run_examples import write_run
from tests.system.session import SMALL
from workers.environments import SHIPPED

MARKUP = "<img src=x onerror=alert(1)>&'\""
MAPPED = SMALL | {
    "search": {"algorithm": "me_es", "pairs": 16, "evaluation_episodes": 4, "block_generations": 2},
    "budget": {"generations": 6},
}


def site(*roots):
    return Site(roots, python_call, trusted=False)


async def answer(app, path, method="GET", client=None, events=0, **headers):
    """Status, headers and body of an answer, as a server would ask for it; of a stream: its first `events` events."""
    path, _, query = path.partition("?")
    given = {"host": "localhost:8642", **{name.replace("_", "-"): value for name, value in headers.items()}}
    scope = {
        "type": "http", "asgi": {"version": "3.0", "spec_version": "2.4"}, "http_version": "1.1", "method": method,
        "scheme": "http", "path": path, "raw_path": path.encode(), "query_string": query.encode(), "root_path": "",
        "headers": [(name.encode(), value.encode()) for name, value in given.items()], "server": ("localhost", 8642),
    }  # fmt: skip
    status, found, body = 0, {}, b""
    enough = asyncio.Event()

    async def receive():
        await enough.wait()
        return {"type": "http.disconnect"}

    async def send(message):
        nonlocal status, body
        if message["type"] == "http.response.start":
            status = message["status"]
            found.update((name.decode(), value.decode()) for name, value in message["headers"])
        else:
            body += message.get("body", b"")
            if events and body.count(b"data: ") >= events:
                enough.set()
                raise OSError("the reader has gone")

    try:
        await app(scope, receive, send)
    except OSError:
        pass
    except Exception as error:  # Starlette's name for it
        if type(error).__name__ != "ClientDisconnect":
            raise
    return status, found, body.decode()


def get(app, path, **options):
    return asyncio.run(answer(app, path, **options))


def sections(app, path):
    """What the first event of a page has: title, order, and by id the HTML and the data of a section."""
    status, _, body = get(app, path, events=1)
    assert status == 200
    return json.loads(re.search("^data: (.*)$", body, re.MULTILINE)[1])


def key_of(root, name):
    return next(one.key for one in Runs([root]).find() if one.name == name)


def test_runs_are_found_at_any_depth_and_links_lead_nowhere(tmp_path):
    outside = write_run(tmp_path / "outside", generations=1)
    root = tmp_path / "root"
    for name in ("a", "deep/er/b", ".hidden/c", "a/inside"):
        shutil.copytree(outside, root / name)
    (root / "link").symlink_to(outside)
    (root / "stolen").mkdir()
    (root / "stolen/run.db").symlink_to(outside / "run.db")
    (root / "config").mkdir()
    shutil.copy(outside / "run.db", root / "config")
    (root / "config/config.yaml").symlink_to("/etc/passwd")
    found = {one.found.name: one.problem for one in Runs([root]).summaries()}
    assert sorted(found) == ["root/a", "root/config", "root/deep/er/b", "root/stolen"]
    assert found["root/a"] == found["root/deep/er/b"] == ""
    for name in ("root/config", "root/stolen"):
        assert "is a link that leads out of" in found[name]
        one = next(one for one in Runs([root]).find() if one.name == name)
        with pytest.raises(StoreError, match="leads out of"):
            RunReading(one).update()
    (tmp_path / "given").symlink_to(root)  # a folder that is given may be a link
    assert [one.problem for one in Runs([tmp_path / "given"]).summaries()][:1] == [""]


def same(a, b):
    for ours, theirs in ((a.history, b.history), (a.centres, b.centres)):
        assert ours.keys() == theirs.keys()
        for name, values in theirs.items():
            np.testing.assert_array_equal(ours[name], values)
    assert (a.best, a.problems, a.platforms) == (b.best, b.problems, b.platforms)
    assert (a.map is None) == (b.map is None)
    if b.map is not None:
        np.testing.assert_array_equal(a.map.cell_N, b.map.cell_N)
        np.testing.assert_array_equal(a.map.fitness_N, b.map.fitness_N)


@pytest.mark.usefixtures("workers_here")
def test_reading_what_is_new_equals_reading_all_also_after_a_fall_back(tmp_path, monkeypatch):
    monkeypatch.setattr("es_service.watch.runs.MOST_ROWS", 2)
    root = tmp_path / "runs"
    folder, early, seen = root / "a", tmp_path / "early", []
    reading = None

    def compare():
        while reading.update() or not reading.whole:
            pass
        same(reading.data, read_run(folder, paths=False, digest=False))

    def after(row):
        nonlocal reading
        reading = reading or RunReading(Runs([root]).find()[0])
        compare()
        seen.append(reading.data.last("generation"))
        if row["generation"] == 3:
            shutil.copytree(folder, early)

    api.run(MAPPED, folder, on_generation=after)
    assert seen == list(range(7))
    compare()
    assert reading.update() is False
    shutil.rmtree(folder)
    shutil.copytree(early, folder)  # the run has lost three generations
    compare()
    assert reading.data.last("generation") == 3
    api.resume(folder)
    compare()
    assert reading.data.last("generation") == 6
    shutil.rmtree(folder)
    api.run(MAPPED | {"seed": 5}, folder)  # another run in the same folder
    compare()
    assert reading.data.meta.config["seed"] == 5


def test_threads_that_read_a_run_at_once_read_each_generation_once(tmp_path, monkeypatch):
    monkeypatch.setattr("es_service.watch.runs.MOST_ROWS", 100)
    folder = write_run(tmp_path / "runs/a", generations=2000)
    reading = RunReading(Runs([tmp_path / "runs"]).find()[0])
    with ThreadPoolExecutor(4) as threads:
        while not reading.whole:
            list(threads.map(lambda _: reading.update(), range(4)))
    same(reading.data, read_run(folder, paths=False, digest=False))


def test_a_damaged_run_shows_what_is_left(tmp_path):
    folder = write_run(tmp_path / "runs/a", generations=40)
    [(sha256,)] = execute(folder, "SELECT sha256 FROM history WHERE generation = 20")
    content = bytearray((folder / "run.db").read_bytes())
    middle = content.index(sha256.encode())
    content[middle - 400 : middle + 40] = bytes(440)
    (folder / "run.db").write_bytes(content)
    reading = RunReading(Runs([tmp_path]).find()[0])
    whole = read_run(folder, paths=False, digest=False)
    while reading.update():
        pass
    assert whole.problems
    assert len(reading.data.history["generation"]) == len(whole.history["generation"])
    found = sections(site(tmp_path).app(None), f"/events/run/{key_of(tmp_path, f'{tmp_path.name}/runs/a')}")
    assert found["order"][:2] == ["what", "curves"]


def test_the_sections_are_those_of_the_report(tmp_path):
    folder = write_run(tmp_path / "a", generations=20)
    app = site(tmp_path).app(None)
    found = sections(app, f"/events/run/{key_of(tmp_path, f'{tmp_path.name}/a')}")
    drawn, scripts = run_sections(read_run(folder), None)
    assert found["order"] == ["what", "curves", "map", "centres", "replays", "time", "faults"]
    for name in ("curves", "map", "centres", "time", "faults"):
        assert found["sections"][name]["html"] == drawn[name]
    assert found["sections"]["map"]["data"] == {"map": json.loads(json.dumps(scripts["map"]))}


def test_a_cell_has_its_path_and_its_command(tmp_path):
    folder = write_run(tmp_path / "a", filled=0.1)
    app, data = site(tmp_path).app(None), read_run(folder)
    key, cell = key_of(tmp_path, f"{tmp_path.name}/a"), int(data.map.cell_N[7])
    status, _, body = get(app, f"/run/{key}/cell/{cell}")
    found = json.loads(body)
    assert (status, found["order"], found["points"]) == (200, [cell], 64)
    assert found["evaluate"] == python_call(folder)(data.cell_name(cell))
    empty = min(set(range(400)) - set(data.map.cell_N.tolist()))
    assert get(app, f"/run/{key}/cell/{empty}")[0] == 404
    assert get(app, f"/run/{key}/cell/{10**30}")[0] == 404


def test_what_was_seen_stays_when_a_run_is_moved_or_deleted(tmp_path):
    folder, runs = write_run(tmp_path / "a"), Runs([tmp_path])
    one = runs.find()[0]
    draw = draw_run(runs, one, RunReading(one))

    def drawn():
        picture = draw()
        assert picture is not None
        assert draw() is None  # nothing is new
        return picture.sections

    before = drawn()
    folder.rename(tmp_path / "b")
    gone = drawn()
    assert "does not exist" in gone["live"]
    assert f'<a href="/run/{key_of(tmp_path, f"{tmp_path.name}/b")}">' in gone["live"]
    assert gone["curves"] == before["curves"]
    (tmp_path / "b").rename(folder)
    assert "live" not in drawn()
    shutil.rmtree(folder)
    assert "It is now" not in drawn()["live"]


def test_runs_are_compared_and_those_of_other_tasks_are_refused(tmp_path):
    for seed in range(2):
        write_run(tmp_path / f"s{seed}", {"seed": seed})
    write_run(tmp_path / "none", generations=0)
    write_run(tmp_path / "trap", task=SHIPPED["ant_trap"])
    app = site(tmp_path).app(None)
    keys = {one.found.name.rpartition("/")[2]: one.found.key for one in Runs([tmp_path]).summaries()}
    found = sections(app, f"/events/compare?run={keys['s0']}&run={keys['s1']}")
    assert found["order"] == ["what", "curves", "final", "maps", "runs"]
    assert found["title"] == "2 runs on point_maze"
    found = sections(app, f"/events/compare?run={keys['s0']}&run={keys['trap']}")
    assert "task.environment differs" in found["sections"]["live"]["html"]
    assert "there is no run" in sections(app, "/events/compare")["sections"]["live"]["html"]
    assert get(app, "/events/compare?run=0")[0] == 404
    for cell in ("9" * 5000, "-1", "x"):
        assert get(app, f"/run/{keys['s0']}/cell/{cell}")[0] == 404
        assert get(app, f"/run/{keys['s0']}/replay/{cell}", method="POST")[0] == 404


def test_what_a_comparison_leaves_out_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(server, "MOST_COMPARED", 2)
    for seed in range(3):
        write_run(tmp_path / f"s{seed}", {"seed": seed})
    keys = "&".join(f"run={one.key}" for one in Runs([tmp_path]).find())
    found = sections(site(tmp_path).app(None), f"/events/compare?{keys}")
    assert found["title"] == "2 runs on point_maze"
    assert "Only the first 2 of 3 runs are compared here" in found["sections"]["live"]["html"]


def test_a_run_that_cannot_be_read_any_more_is_not_drawn_again_and_again(tmp_path):
    """Drawing at once, to read the rest of a long run, is free of the limit on a page's processor time."""
    for name in ("a", "b"):
        write_run(tmp_path / name, generations=2)
    draw = draw_comparison([(run, RunReading(run)) for run in Runs([tmp_path]).find()], [])
    draw()
    shutil.rmtree(tmp_path / "a")
    picture = draw()
    assert "cannot" in picture.sections["live"] or "no run" in picture.sections["live"]
    assert not picture.more


def test_markup_in_every_name_is_shown_and_not_interpreted(tmp_path):
    names = tuple(f"{MARKUP}{b}" for b in range(2))
    task = replace(
        SHIPPED["point_maze"], name=f"made:{MARKUP}", descriptor_names=names, summary=MARKUP, walls=None, goal=None
    )
    root = tmp_path / f"{MARKUP.replace('/', '')} $(id)"
    parent = {"run_id": "a" * 32, "folder": MARKUP, "generation": 1, "digest": None}
    for seed in range(2):
        write_run(root / f"{MARKUP}{seed}", {"seed": seed}, task=task, parent=parent)
    (root / "broken").mkdir()
    (root / "broken/run.db").write_text(MARKUP)
    app = site(root).app(None)
    found = Runs([root]).find()
    keys = [one.key for one in found if "broken" not in one.name]
    pages = [f"/run/{keys[0]}", "/", f"/compare?run={keys[0]}&run={quote(MARKUP)}"]
    shown = [get(app, page)[2] for page in pages]
    for page in ("list", f"run/{keys[0]}", f"compare?run={keys[0]}&run={keys[1]}", f"run/{found[-1].key}"):
        got = sections(app, f"/events/{page}")
        shown += [f"<!DOCTYPE html>{one['html']}" for one in got["sections"].values()]
    for html in shown:
        page = Elements(html)
        assert "img" not in page.names
        assert not [name for name, _ in page.attributes if name.startswith("on")]
    assert MARKUP.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")[:20] in "".join(shown)
    lines = get(app, "/metrics")[2].splitlines()
    assert all(re.fullmatch(r'(#.*)|es_service_\w+\{(\w+="([^"\\]|\\.)*",?)+\} \S+', line) for line in lines)


def test_a_stranger_without_the_token_sees_nothing(tmp_path):
    write_run(tmp_path / "secret-name", generations=1)
    app = site(tmp_path).app("right")
    key = key_of(tmp_path, f"{tmp_path.name}/secret-name")
    for path in ("/", f"/run/{key}", "/events/list", "/metrics", "/assets/page.js", "/no", "/?token=wrong", "/?token="):
        for headers in ({}, {"authorization": "Bearer wrong"}, {"cookie": "es-service-watch=wrong"}):
            status, _, body = get(app, path, **headers)
            assert (status, "secret" in body) == (401, False)
    assert get(app, f"/run/{key}/replay/best", method="POST")[0] == 401
    status, headers, _ = get(app, f"/run/{key}?a=1&token=right&b=2", host="somewhere.example")
    assert (status, headers["location"]) == (303, f"/run/{key}?a=1&b=2")
    cookie, _, rest = headers["set-cookie"].partition("; ")
    assert re.fullmatch("es-service-watch-[0-9a-f]{8}=right", cookie)
    assert rest.startswith("HttpOnly;")
    assert get(app, "/", cookie=cookie, host="somewhere.example")[0] == 200
    other = site(tmp_path).app("other")
    _, headers, _ = get(other, "/?token=other", host="somewhere.example")
    cookies = f"{cookie}; {headers['set-cookie'].partition('; ')[0]}"
    assert [get(page, "/", cookie=cookies)[0] for page in (app, other)] == [200, 200], "browsers send both to both"
    assert get(app, "/metrics", authorization="Bearer right")[0] == 200


def test_without_a_token_only_names_of_this_machine_are_answered(tmp_path):
    app = site(tmp_path).app(None)
    for host in ("localhost", "localhost:1", "127.0.0.1:8642", "[::1]:8642"):
        status, headers, _ = get(app, "/", host=host)
        assert status == 200
        assert "script-src 'self';" in headers["content-security-policy"]
    for host in (
        "evil.example",
        "evil.example:8642",
        "localhost.evil.example",
        "192.168.0.7",
        "",
        "[",
        "127.0.0.1@evil",
    ):
        assert get(app, "/", host=host)[0] == 403


def test_the_head_of_a_stream_ends(tmp_path):
    app = site(tmp_path).app(None)
    status, headers, body = get(app, "/events/list", method="HEAD")
    assert (status, headers["content-type"].partition(";")[0], body) == (200, "text/event-stream", "")
    assert get(app, "/events/run/x", method="HEAD")[0] == 404


def test_another_page_cannot_have_replays_recorded(tmp_path):
    write_run(tmp_path / "a", generations=1)
    app, key = site(tmp_path).app(None), key_of(tmp_path, f"{tmp_path.name}/a")
    path = f"/run/{key}/replay/nothing"
    assert get(app, path, method="POST", origin="http://localhost:8642", sec_fetch_site="same-origin")[0] == 404
    of_others = ("http://evil.example", "null", "http://[")
    for headers in (*({"origin": origin} for origin in of_others), {"sec_fetch_site": "cross-site"}):
        assert get(app, path, method="POST", **headers)[0] == 403
    assert get(app, f"/run/{key}/replay/best")[0] == 405  # it is no link


def test_no_request_names_a_file(tmp_path):
    write_run(tmp_path / "a", generations=1)
    app = site(tmp_path).app(None)
    for path in (
        "/assets/../page.py", "/assets/..%2fpage.py", "/assets/%2e%2e/page.py", "/assets//etc/passwd", "/run/a",
        "/run/..", f"/run/{quote(str(tmp_path / 'a'), safe='')}", "/events/run/../..", "/events/run/a", "/events/x",
    ):  # fmt: skip
        assert get(app, path)[0] == 404


def test_metrics_are_the_newest_numbers(tmp_path):
    write_run(tmp_path / "a", generations=30)
    text = get(site(tmp_path).app(None), "/metrics")[2]
    labels = f'{{run="{tmp_path.name}/a",task="point_maze",search="me_es"}}'
    newest = api.open_run(tmp_path / "a").history.iloc[-1]
    for name in ("env_steps", "steps_per_second", "best_fitness", "coverage", "workers"):
        assert f"es_service_{name}{labels} {float(newest[name])!r}\n" in text
    for name, value in (("generation", 30), ("running", 0), ("readable", 1), ("lost_workers", 1), ("retries", 2)):
        assert f"es_service_{name}{labels} {float(value)!r}\n" in text


def test_runs_below_folders_of_the_same_name_have_different_names(tmp_path):
    roots = [tmp_path / "x/runs", tmp_path / "y/runs"]
    for root in roots:
        write_run(root / "a")
    assert [run.name for run in Runs(roots).find()] == [str(root / "a") for root in roots]
    assert [run.name for run in Runs([roots[0], roots[0]]).find()] == ["runs/a"]


@pytest.mark.skipif(os.name != "posix", reason="names of files are text there")
def test_a_run_whose_path_is_no_utf8_is_shown(tmp_path):
    folder = tmp_path / os.fsdecode(b"b\xff")
    write_run(folder)
    app = site(tmp_path).app(None)
    [found] = Runs([tmp_path]).find()
    cell = int(read_run(folder).map.cell_N[0])
    assert get(app, f"/run/{found.key}/cell/{cell}")[0] == 200
    status, _, text = get(app, f"/run/{found.key}/replay/certified", method="POST")
    assert status == 409
    assert "has no certified policy" in text


def test_the_certified_fitness_is_in_the_unit_of_the_fitness_beside_it(tmp_path, workers_here):
    """With `fitness: final` it is a last reward, here a distance below 3, while the sum of 60 rewards is below -10."""
    task = SMALL["task"] | {"fitness": "final"}
    run = api.run(SMALL | {"task": task}, tmp_path / "run").run
    [certified] = certify_run(run.folder, top=0, episodes=16)
    row = certified.row()
    assert row["return_mean"] < -10.0 < row["last_reward_mean"]
    text = get(site(tmp_path).app(None), "/metrics")[2]
    [value] = re.findall(r"^es_service_certified_fitness\{.*\} (.*)$", text, re.M)
    assert float(value) == row["last_reward_mean"]
    runs = Runs([tmp_path])
    listed = str(draw_list(runs)().sections["runs"])
    shown = f"{number(row['last_reward_mean'])} (best of generation {row['generation']})"
    assert f'data-head="certified">{shown}<' in listed
    [found] = runs.find()
    page = str(draw_run(runs, found, RunReading(found))().sections["what"])
    assert f"The certified policy, best of generation {row['generation']}, has" in page
    assert f"has a mean last reward of {number(row['last_reward_mean'])} (" in page


def test_one_picture_is_drawn_for_all_viewers_and_only_what_changed_is_sent(monkeypatch):
    monkeypatch.setattr(channels, "LEAST_S", 0.01)
    monkeypatch.setattr(channels, "SHARE", 10.0)
    drawn, ended = [], []

    def draw():
        drawn.append(1)
        same_, new = channels.Markup("<p>same</p>"), channels.Markup(f"<p>{len(drawn)}</p>")
        return channels.Picture("title", {"a": same_, "b": new}, {}) if len(drawn) < 4 else None

    async def viewer(channel):
        found = []
        async for text in channel.stream():
            if text.startswith(b"data: "):
                found.append(json.loads(text[6:]))
                if found[-1]["sections"]["b"]["html"] == "<p>3</p>":
                    break
        return found

    async def watched():
        channel = channels.PageChannel(draw, lambda: ended.append(1), channels.Allowance())
        found = await asyncio.gather(*(viewer(channel) for _ in range(20)))
        monkeypatch.setattr(channels, "LINGER_S", 0.0)
        await channel._task
        return found

    for events in asyncio.run(watched()):
        assert set(events[0]["sections"]) == {"a", "b"}
        assert all(set(event["sections"]) == {"b"} and event["order"] == ["a", "b"] for event in events[1:])
    assert len(drawn) <= 8
    assert ended == [1]


def test_the_command_refuses_files_and_ports_in_use(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    result = CliRunner().invoke(program, ["watch", str(file)])
    assert "is a file" in str(result.exception)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        result = CliRunner().invoke(program, ["watch", str(tmp_path), "--port", str(taken.getsockname()[1])])
    assert "choose another port, or 0 for any" in str(result.exception)


def test_many_damaged_rows_in_a_row_end_the_reading(tmp_path, monkeypatch):
    monkeypatch.setattr("es_service.watch.runs.MOST_ROWS", 3)
    folder = write_run(tmp_path / "a", generations=20)
    execute(folder, "UPDATE history SET sha256 = '' WHERE generation BETWEEN 5 AND 9")
    reading = RunReading(Runs([tmp_path]).find()[0])
    for _ in range(30):
        reading.update()
    assert reading.whole
    assert reading.data is not None
    assert reading.data.history["generation"].tolist() == [0, 1, 2, 3, 4]
    assert "generations 5 to 20" in reading.data.problems[0]


def test_running_runs_come_first(tmp_path):
    for name in ("a", "b", "c"):
        write_run(tmp_path / name)
    app = site(tmp_path).app(None)
    lock = acquire_lock(tmp_path / "b")
    try:
        html = sections(app, "/events/list")["sections"]["runs"]["html"]
    finally:
        lock.release()
    assert "3 runs, 1 of them running." in html
    assert re.findall(r'">[^<]*/([abc])</a>', html) == ["b", "a", "c"]


@pytest.mark.parametrize(
    ("forged", "said"),
    [
        (lambda run: json.dumps(run | {"constants": {"task.environment": 3}}), "constants.seed: Field required"),
        (lambda run: "[" * 100_000, "cannot be read: maximum recursion depth"),
        (
            lambda run: json.dumps(run | {"config": json.loads("[" * 99 + "]" * 99)}),
            "has more than 32 lists and mappings",
        ),
    ],
)
def test_a_run_with_forged_data_hides_no_other(tmp_path, forged, said):
    for name in ("a", "b"):
        write_run(tmp_path / name)
    with database(tmp_path / "a/run.db") as connection:
        [text] = connection.execute("SELECT value FROM meta WHERE key = 'run'").fetchone()
        text = forged(json.loads(text))
        row = (text, text_sha256("run", text))
        connection.execute("UPDATE meta SET value = ?, sha256 = ? WHERE key = 'run'", row)
    app = site(tmp_path).app(None)
    html = sections(app, "/events/list")["sections"]["runs"]["html"]
    assert "its description of the run" in html
    assert said in html
    assert "20 of 20" in html
    assert f'run="{tmp_path.name}/b",task="point_maze"' in get(app, "/metrics")[2]
    key = key_of(tmp_path, f"{tmp_path.name}/a")
    assert "its description of the run" in sections(app, f"/events/run/{key}")["sections"]["live"]["html"]


def test_on_a_shared_file_system_the_copy_is_watched_while_a_driver_writes(tmp_path, monkeypatch):
    for module in (writer, reader):
        monkeypatch.setattr(module, "is_network_filesystem", lambda path: True)
    monkeypatch.setattr(upkeep, "NETWORK_COPY_INTERVAL_S", 0.0)
    monkeypatch.setattr(upkeep, "COPY_TIME_FRACTION", np.inf)
    read, opened, seen = [], reader.connected_to, []
    monkeypatch.setattr(reader, "connected_to", lambda file: (read.append(file.name), opened(file))[1])

    def watch(row):
        if row["generation"] < 1:
            return
        read.clear()
        [one] = Runs([tmp_path]).summaries()
        reading = RunReading(one.found)
        assert reading.update()
        assert reading.data is not None
        assert not reading.data.problems
        assert one.problem == ""
        assert set(read) == {"run.db.copy"}
        seen.append((row["generation"], int(reading.data.history["generation"][-1])))

    with workers_in_this_process():
        api.run(MAPPED, tmp_path / "run", on_generation=watch)
    assert [generation for generation, _ in seen] == [1, 2, 3, 4, 5, 6]
    assert all(generation - 1 <= shown <= generation for generation, shown in seen)
