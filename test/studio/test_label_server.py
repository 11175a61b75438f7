"""Tests of the server of the label page, which runs in a separate process, with an HTTP client."""

from __future__ import annotations

import asyncio
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
from contextlib import asynccontextmanager
from types import SimpleNamespace

import aiohttp
import numpy as np
import pytest
from labeling_pages import run_server
from samples import WALKER
from yarl import URL

from lidar_studio.server import MAX_QUEUED_EVENTS, Server, _notify_in_loop, _send_events

BOX = [*WALKER[:6].tolist(), 0.3]
ADD = {"do": "add", "frame": 0, "class": "Pedestrian", "box": BOX}


def make_label_arguments(data, out, *options):
    """Return arguments of the label command, without automatic proposals."""
    return ["label", "--data", str(data), "--out", str(out), "--no-open", "--no-propose", *options]


def make_command_line(*arguments):
    """Return the command line that runs lidar-perception in a separate process."""
    return [sys.executable, "-m", "lidar_perception.cli.main", *arguments]


def test_page_that_reads_too_slowly_is_disconnected():
    async def overflow_queue():
        queue, sent_events = asyncio.Queue(MAX_QUEUED_EVENTS), []
        page = SimpleNamespace(pages={queue}, closed=False)

        async def send_json(event):
            sent_events.append(event)

        async def close():
            page.closed = True

        for event in range(MAX_QUEUED_EVENTS + 5):
            Server.broadcast(page, event)
        assert not page.pages
        page.send_json, page.close = send_json, close
        await asyncio.wait_for(_send_events(page, queue), 10)
        assert page.closed and sent_events == [*range(1, MAX_QUEUED_EVENTS)]

    asyncio.run(overflow_queue())


class Page:
    """HTTP client that sends the same requests as the page."""

    def __init__(self, http, base):
        self.http, self.base = http, base

    async def get(self, path, **options):
        """Return the status and body of the reply, without normalising the path."""
        async with self.http.get(URL(self.base + path, encoded=True), **options) as reply:
            return reply.status, await reply.read()

    async def get_json(self, path):
        """Return the content of a successful JSON reply."""
        status, body = await self.get(path)
        assert status == 200, body
        return json.loads(body)

    async def send_action(self, expected_status=200, page="one", **action):
        """Send an action and return the content of the reply."""
        async with self.http.post(f"{self.base}/api/do", data=json.dumps(action), headers={"X-Page": page}) as reply:
            content = await reply.json()
            assert reply.status == expected_status, content
            assert expected_status == 200 or "\n" not in content["error"]
            return content


@asynccontextmanager
async def open_page(url):
    """Open the address and yield a client that has the cookie."""
    async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as http:
        async with http.get(url) as reply:
            assert reply.status == 200 and "text/html" in reply.headers["Content-Type"]
        yield Page(http, url.partition("/?")[0])


def run_on_page(url, use_page):
    """Return the result of the coroutine use_page(page)."""

    async def run():
        async with open_page(url) as page:
            return await asyncio.wait_for(use_page(page), 600)

    return asyncio.run(run())


@pytest.fixture(scope="module")
def server_url(sample_bag, tmp_path_factory):
    """Address of a server that is shared by several tests, so its labels are arbitrary."""
    with run_server(*make_label_arguments(sample_bag, tmp_path_factory.mktemp("labels"))) as server:
        yield server.url


def test_cloud_has_all_columns_in_a_fixed_random_order(server_url, sample_bag):
    from lidar_perception.data.open import open_recording

    async def use_page(page):
        drive = await page.get_json("/api/drive")
        assert (drive["mode"], len(drive["frames"]), drive["live"]) == ("label", 3, False)
        assert {c["name"] for c in drive["classes"]} >= {"Car", "Pedestrian", "Cyclist"}
        assert all(re.fullmatch("#[0-9a-f]{6}", c["color"]) for c in drive["classes"])
        assert {"kitti", "openlabel"} <= set(drive["can_export"])
        first_body, second_body = [(await page.get("/api/cloud/1"))[1] for _ in range(2)]
        assert first_body == second_body  # the order is always the same
        return first_body

    body = run_on_page(server_url, use_page)
    frame = list(open_recording(sample_bag))[1].load()
    n = int(np.frombuffer(body, np.uint32, 1, 4)[0])
    assert body[:4] == b"LPC1" and n == len(frame)
    xyz = np.frombuffer(body, np.float32, 3 * n, 8).reshape(-1, 3)
    intensity, ground = (np.frombuffer(body, np.uint8, n, 8 + 12 * n + i * n) for i in (0, 1))
    clusters = np.frombuffer(body, np.uint32, n, len(body) - 4 * n)
    assert (len(body) - 4 * n) % 4 == 0 and len(body) - 4 * n - (8 + 14 * n) in (0, 2)
    order = np.lexsort(xyz.T)
    assert (xyz[order] == frame.xyz[np.lexsort(frame.xyz.T)]).all()
    assert (intensity[order] == (frame.intensity[np.lexsort(frame.xyz.T)] * 255).astype(int)).all()
    assert 0.5 < ground.mean() < 1 and not clusters[ground == 1].any() and clusters.max() >= 1
    assert np.abs(xyz[: n // 4].mean(axis=0) - xyz.mean(axis=0)).max() < 1  # the first points are a random sample


def test_click_creates_a_track_and_a_seed(server_url):
    async def use_page(page):
        before = await page.get_json("/api/state")
        await page.send_action(do="seed", frame=0, xyz=WALKER[:3].tolist(), **{"class": "Pedestrian"})
        state = await page.get_json("/api/state")
        (track,) = [t for t in state["tracks"] if t["id"] not in {u["id"] for u in before["tracks"]}]
        ((frame, *box, kind),) = track["boxes"]
        assert (frame, kind, track["state"]) == (0, "key", "accepted")
        assert np.hypot(box[0] - WALKER[0], box[1] - WALKER[1]) < 0.3
        assert state["seeds"][-1] == [0, track["id"]]
        silhouettes = await page.get_json(f"/api/silhouettes?frame=0&track={track['id']}")
        assert silhouettes["similarity"] == pytest.approx(1)
        assert set(silhouettes["seed"]["bits"]) == {"0", "1"} and silhouettes["seed"] == silhouettes["candidate"]
        assert (await page.get(f"/api/silhouettes?frame=1&track={track['id']}"))[0] == 404
        await page.send_action(do="snap", track=track["id"], frame=0, to="ground")
        await page.send_action(do="snap", track=track["id"], frame=0, to="cluster")
        (snapped_track,) = [t for t in (await page.get_json("/api/state"))["tracks"] if t["id"] == track["id"]]
        assert np.hypot(*(np.array(snapped_track["boxes"][0][1:3]) - WALKER[:2])) < 0.1
        reply = await page.send_action(400, do="seed", frame=0, xyz=[80, 80, 80], **{"class": "Car"})
        assert "cluster" in reply["error"]
        assert await page.get_json("/api/next?after=0") == {"track": None, "frame": 0}

    run_on_page(server_url, use_page)


def test_second_page_receives_actions_of_the_first(server_url):
    async def use_page(page):
        async with open_page(server_url) as other, other.http.ws_connect(f"{other.base}/api/events") as events:
            seq = (await page.send_action(page="first", **ADD))["seq"]
            event = await events.receive_json()
            assert (event["seq"], event["by"], event["action"]["do"]) == (seq, "first", "add")
            assert event["tracks"][0]["boxes"] == [[0, *BOX, "key"]]
            assert event["can_undo"] and event["progress"]["actions"] == seq
            await page.send_action(do="undo")
            event = await events.receive_json()
            assert event["removed"] and event["can_redo"]

    run_on_page(server_url, use_page)


@pytest.mark.parametrize(
    "action",
    [
        {"do": "fly"},
        {},
        {**ADD, "frame": 3},
        {**ADD, "frame": "0"},
        {**ADD, "box": BOX[:6]},
        {**ADD, "box": [float("nan"), *BOX[1:]]},
        {**ADD, "box": [1e9, *BOX[1:]]},
        {"do": "snap", "track": 10**6, "frame": 0, "to": "ground"},
        {"do": "poses", "poses": []},
        {"do": "import", "path": "/nowhere", "format": "kitti"},
        {"do": "import", "path": 5, "format": []},
        {"do": "seed", "frame": 0, "xyz": [0, 0], "class": "Car"},
    ],
    ids=str,
)
def test_invalid_request_is_reported_and_changes_nothing(server_url, action):
    async def use_page(page):
        before = await page.get_json("/api/state")
        await page.send_action(400, **action)
        assert await page.get_json("/api/state") == before

    run_on_page(server_url, use_page)


def test_requests_from_other_origins_are_rejected(server_url):
    base, _, token = server_url.partition("/?token=")
    port = int(base.rpartition(":")[2])

    async def send_foreign_requests():
        async with aiohttp.ClientSession() as http:
            page = Page(http, base)
            for path in (
                "/",
                "/api/drive",
                "/api/cloud/0",
                "/static/app.js",
                "/?token=",
                "/api/state?token=" + token[:-1],
                "/?token=" + "x" * len(token),
                "/?token=%C3%A4",
                "/api/events",
            ):
                status, body = await page.get(path)
                assert status == 403 and body.count(b"\n") == 1, path
            async with http.post(f"{base}/api/do", json=ADD) as reply:
                assert reply.status == 403
            for host in (f"evil.example:{port}", "evil.example", f"127.0.0.1.evil.example:{port}"):
                status, _ = await page.get(f"/api/state?token={token}", headers={"Host": host})
                assert status == 403, host
            origin = {"Origin": "http://evil.example"}
            assert (await page.get(f"/api/state?token={token}", headers=origin))[0] == 403
            async with http.post(f"{base}/api/do?token={token}", json=ADD, headers=origin) as reply:
                assert reply.status == 403
            assert (await page.get(f"/api/state?token={token}"))[0] == 200

    asyncio.run(send_foreign_requests())
    with socket.socket() as client:  # the server listens on 127.0.0.1 only
        client.settimeout(5)
        assert client.connect_ex(("127.0.0.2", port)) != 0


def test_only_files_of_the_page_are_served(server_url):
    async def use_page(page):
        for path in (
            "/static/..%2fserver.py",
            "/static/%2e%2e%2fserver.py",
            "/static/../server.py",
            "/static//etc/passwd",
            "/static/..",
            "/static/",
            "/etc/passwd",
            "/static/%2fetc%2fpasswd",
            "/static/x%00",
            "/nothing",
        ):
            status, body = await page.get(path)
            assert status in (400, 404) and b"import" not in body, path
        for path in ("/api/cloud/3", "/api/cloud/-1", "/api/cloud/a", "/api/cloud/" + "9" * 50, "/api/labels/3"):
            status, body = await page.get(path)
            assert status == 400 and "frame" in json.loads(body)["error"], path
        async with page.http.get(f"{page.base}/") as reply:
            assert "default-src 'self'" in reply.headers["Content-Security-Policy"]
        async with page.http.post(f"{page.base}/api/do", data=b"{no json") as reply:
            assert reply.status == 400 and (await reply.json())["error"]
        async with page.http.post(f"{page.base}/api/do", data=b"[]") as reply:
            assert reply.status == 400

    run_on_page(server_url, use_page)


def test_event_after_the_server_has_ended_is_ignored():
    loop = asyncio.new_event_loop()
    loop.close()
    _notify_in_loop(loop, SimpleNamespace(broadcast=None), {})


@pytest.mark.no_cover
def test_killed_server_loses_no_labels(sample_bag, tmp_path):
    async def edit(page):
        await page.send_action(**ADD)
        await page.send_action(do="box", track=1, frame=2, box=BOX)
        await page.send_action(do="undo")
        return await page.get_json("/api/state")

    with run_server(*make_label_arguments(sample_bag, tmp_path)) as server:
        before = run_on_page(server.url, edit)
        command = make_command_line(*make_label_arguments(sample_bag, tmp_path))
        second_server = subprocess.run(command, text=True, capture_output=True)
        assert second_server.returncode == 2 and "another process" in second_server.stderr
        server.process.kill()
    with open(tmp_path / "journal.jsonl", "a") as journal:
        journal.write('{"seq": 4, "do": "re')
    with run_server(*make_label_arguments(sample_bag, tmp_path)) as server:
        assert run_on_page(server.url, lambda page: page.get_json("/api/state")) == before
        assert run_on_page(server.url, lambda page: page.send_action(do="redo")) == {"seq": 4}
        os.kill(server.process.pid, signal.SIGINT)
        server.process.join(60)
        assert server.process.exitcode == 0
        assert "was incomplete" in re.sub(r"\s+", " ", server.errors.read())


def limit_file_size():
    """Limit the size of the files that this process writes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))


def test_full_disk_is_reported_and_labels_match_the_journal(sample_bag, tmp_path):
    async def fill(page):
        for _ in range(50):
            before = await page.get_json("/api/state")
            async with page.http.post(f"{page.base}/api/do", json=ADD) as reply:
                if reply.status != 200:
                    assert "cannot write" in (await reply.json())["error"]
                    assert await page.get_json("/api/state") == before
                    return before
        raise AssertionError("the disk was never full")

    with run_server(*make_label_arguments(sample_bag, tmp_path), before=limit_file_size) as server:
        before = run_on_page(server.url, fill)
    assert len(before["tracks"]) > 3
    with run_server(*make_label_arguments(sample_bag, tmp_path)) as server:
        assert run_on_page(server.url, lambda page: page.get_json("/api/state")) == before


@pytest.mark.no_cover
def test_exported_labels_are_imported_unchanged(sample_bag, tmp_path):
    async def make(page):
        await page.send_action(**ADD)
        await page.send_action(do="box", track=1, frame=2, box=BOX)
        await page.send_action(**{**ADD, "class": "Marsmobil"})
        await page.send_action(do="accept", track=2)
        export_request = {"format": "openlabel", "out": "labels.json"}
        async with page.http.post(f"{page.base}/api/export", json=export_request) as reply:
            first = await reply.json()
        async with page.http.post(f"{page.base}/api/export", json=export_request) as reply:
            assert reply.status == 400, await reply.text()  # it exists
        async with page.http.post(f"{page.base}/api/export", json={**export_request, "force": True}) as reply:
            assert await reply.json() == first
        for invalid_request in ({"format": "x", "out": "y"}, {"format": "openlabel", "out": "../y"}, {}):
            async with page.http.post(f"{page.base}/api/export", json=invalid_request) as reply:
                assert reply.status == 400 and (await reply.json())["error"]
        return first, await page.get_json("/api/state")

    with run_server(*make_label_arguments(sample_bag, tmp_path / "one")) as server:
        result, state = run_on_page(server.url, make)
    assert result["boxes"] == 4 and result["frames"] == 3
    import_options = ["--import", f"openlabel:{result['path']}"]
    with run_server(*make_label_arguments(sample_bag, tmp_path / "two", *import_options)) as server:
        imported_state = run_on_page(server.url, lambda page: page.get_json("/api/state"))
        assert {(t["class"], tuple(map(tuple, (b[:8] for b in t["boxes"])))) for t in imported_state["tracks"]} == {
            (t["class"], tuple(map(tuple, (b[:8] for b in t["boxes"])))) for t in state["tracks"]
        }
        run_on_page(server.url, lambda page: page.send_action(do="undo"))
        assert run_on_page(server.url, lambda page: page.get_json("/api/state"))["tracks"] == []


def test_labels_of_the_drive_are_shown_only_on_request(server_url, sample_bag, tmp_path):
    assert run_on_page(server_url, lambda page: page.get_json("/api/labels/0"))["labels"] == []
    with run_server(*make_label_arguments(sample_bag, tmp_path, "--show-labels")) as server:
        results = run_on_page(server.url, lambda page: page.get_json("/api/labels/0"))
        ((*box, name, _),) = results["labels"]
        assert np.allclose(box, WALKER) and name == "Pedestrian"
        assert run_on_page(server.url, lambda page: page.get_json("/api/labels/1"))["labels"] == []


def test_drive_is_surveyed_once_in_the_background(sample_bag, tmp_path):
    async def wait(page):
        async with page.http.ws_connect(f"{page.base}/api/events") as events:
            state = await page.get_json("/api/state")
            while state["progress"]["busy"] is not None:
                event = await events.receive_json()
                assert "error" not in event, event
                state["progress"] = event["progress"]
        return await page.get_json("/api/state")

    before = None
    for _ in range(2):  # the second server reads the proposals from the journal
        with subprocess.Popen(
            make_command_line(*make_label_arguments(sample_bag, tmp_path, "--propose")),
            text=True,
            stdout=subprocess.PIPE,
        ) as process:
            try:
                state = run_on_page(process.stdout.readline().strip(), wait)
            finally:
                process.kill()
        assert before is None or state == before
        before = state
    lines = [json.loads(line) for line in (tmp_path / "journal.jsonl").read_text().splitlines()]
    assert [line["do"] for line in lines[1:]].count("propose") == 1
