"""When a request is sent again, and when not: against a server that answers as scripted."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from served import SAMPLE

from uniground import AsyncClient, Client, Scene, UnigroundError

# What a scripted server does with a request.
Reply = Callable[[BaseHTTPRequestHandler], None]
BUSY = {"type": "about:blank", "title": "Too Many Requests", "status": 429, "detail": "too many at once", "code": "overloaded"}
ID = "01a204e5-ec2d-7755-9640-869af6cd5b99"
JOB = {"id": "j", "kind": "parse", "subject": "s", "progress": 0.5, "attempts": 1, "created_at": "now"}
SCENE = {"id": "s", "name": "n", "status": "parsing", "content_hash": "h", "parse_version": 0, "created_at": "now", "updated_at": "now"}


class Scripted(ThreadingHTTPServer):
    """Answers requests by turns; keeps what it was asked."""

    def __init__(self, *replies: Reply) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.replies = list(replies)
        self.requests: list[tuple[str, dict[str, str], bytes]] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class Handler(BaseHTTPRequestHandler):
    server: Scripted

    def log_message(self, *_: Any) -> None:
        pass

    def do_GET(self) -> None:
        reply = self.server.replies.pop(0)
        body = b"" if reply is refuses_unread else self.rfile.read(int(self.headers.get("content-length", 0)))
        self.server.requests.append((f"{self.command} {self.path}", dict(self.headers), body))
        reply(self)

    do_POST = do_DELETE = do_PATCH = do_GET


def says(status: int, body: Any, headers: Any = None) -> Reply:
    def reply(handler: BaseHTTPRequestHandler) -> None:
        content = body if isinstance(body, bytes) else json.dumps(body).encode()
        handler.send_response(status)
        for name, value in {"content-type": "application/json", "content-length": str(len(content)), **(headers or {})}.items():
            handler.send_header(name, value)
        handler.end_headers()
        handler.wfile.write(content)

    return reply


def breaks_off(handler: BaseHTTPRequestHandler) -> None:
    handler.close_connection = True
    handler.connection.close()


def sends_then_breaks_off(content: bytes) -> Reply:
    def reply(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("content-length", str(len(content) + 1))
        handler.end_headers()
        handler.wfile.write(content)
        handler.close_connection = True

    return reply


def refuses_unread(handler: BaseHTTPRequestHandler) -> None:
    says(413, {**BUSY, "status": 413, "code": "upload_too_large"}, {"connection": "close"})(handler)
    handler.close_connection = True


def stays_silent(handler: BaseHTTPRequestHandler) -> None:
    time.sleep(1.5)
    breaks_off(handler)


@pytest.fixture
def scripted() -> Iterator[Callable[..., Scripted]]:
    started: list[Scripted] = []

    def start(*replies: Reply) -> Scripted:
        started.append(Scripted(*replies))
        threading.Thread(target=started[-1].serve_forever, args=[0.01], daemon=True).start()
        return started[-1]

    yield start
    for server in started:
        server.shutdown()
        server.server_close()


def test_what_is_refused_for_now_is_sent_again(scripted: Callable[..., Scripted]) -> None:
    server = scripted(says(429, BUSY, {"retry-after": "0"}), says(503, BUSY, {"retry-after": "0"}), says(200, {"fine": True}))
    assert Client(server.url).call("POST", "/v1/anything", body={}) == {"fine": True}
    assert len(server.requests) == 3


def test_what_is_refused_too_often_or_too_long_is_told(scripted: Callable[..., Scripted]) -> None:
    server = scripted(*[says(429, BUSY, {"retry-after": "0"})] * 3)
    with pytest.raises(UnigroundError) as busy:
        Client(server.url, retries=2).call("GET", "/v1/anything")
    assert (busy.value.code, busy.value.status, busy.value.retry_after, len(server.requests)) == ("overloaded", 429, 0, 3)
    server = scripted(says(429, BUSY, {"retry-after": "3600"}))
    with pytest.raises(UnigroundError) as later:
        Client(server.url).call("GET", "/v1/anything")
    assert (later.value.retry_after, len(server.requests)) == (3600, 1)


def test_what_may_have_been_done_is_not_done_again(scripted: Callable[..., Scripted]) -> None:
    server = scripted(breaks_off, says(200, {}))
    with pytest.raises(UnigroundError) as broken:
        Client(server.url).call("POST", "/v1/scenes/s/ground", body={"query": "the mug"})
    assert (broken.value.code, broken.value.status, broken.value.is_passing) == ("unreachable", None, True)
    assert len(server.requests) == 1


def test_a_question_is_repeated_under_one_key(scripted: Callable[..., Scripted], scene: Scene) -> None:
    answer = dataclasses.asdict(scene.ask("the mug on the coffee table"))
    server = scripted(says(200, SCENE), breaks_off, says(503, BUSY, {"retry-after": "0"}), says(200, answer), says(200, answer))
    asked = Client(server.url).scene(ID)
    for _ in range(2):
        assert dataclasses.asdict(asked.ask("the mug", top_k=2)) == answer
    sent = [(request, body, headers["idempotency-key"]) for request, headers, body in server.requests[1:]]
    assert sent[0] == sent[1] == sent[2] == ("POST /v1/scenes/s/ground", b'{"query": "the mug", "top_k": 2}', sent[0][2])
    assert sent[3][2] != sent[0][2], "the next question is another one"


def test_looking_is_repeated(scripted: Callable[..., Scripted]) -> None:
    server = scripted(breaks_off, says(200, {"fine": True}))
    assert Client(server.url).call("GET", "/v1/stats") == {"fine": True}


def test_an_upload_is_repeated_whole_under_one_key(scripted: Callable[..., Scripted]) -> None:
    server = scripted(breaks_off, says(202, {"scene": SCENE, "job": None}))
    assert Client(server.url).upload(SAMPLE).id == "s"
    (_, first, one), (_, second, two) = server.requests
    assert one == two == SAMPLE.read_bytes()
    assert first["idempotency-key"] == second["idempotency-key"]


def test_a_refusal_is_heard_while_the_scan_is_still_being_sent(scripted: Callable[..., Scripted], tmp_path: Path) -> None:
    large = tmp_path / "large.zip"
    large.write_bytes(bytes(30_000_000))
    server = scripted(refuses_unread, refuses_unread)
    with pytest.raises(UnigroundError) as waiting:
        Client(server.url).upload(large)
    with pytest.raises(UnigroundError) as asynchronous:
        asyncio.run(AsyncClient(server.url).upload(large))
    assert (waiting.value.code, asynchronous.value.code, len(server.requests)) == ("upload_too_large", "upload_too_large", 2)


def test_nobody_there_is_told(scripted: Callable[..., Scripted]) -> None:
    server = scripted()
    url = server.url
    server.shutdown()
    server.server_close()
    with pytest.raises(UnigroundError, match="could not be reached") as nobody:
        Client(url, retries=0).call("GET", "/healthz")
    assert nobody.value.code == "unreachable"


def test_silence_is_told(scripted: Callable[..., Scripted]) -> None:
    server = scripted(stays_silent)
    with pytest.raises(UnigroundError) as silent:
        Client(server.url, timeout_s=0.2, retries=0).call("GET", "/healthz")
    assert silent.value.code == "timed_out"


def test_a_reply_of_something_else_is_told(scripted: Callable[..., Scripted]) -> None:
    server = scripted(says(502, b"<html>Bad Gateway</html>"), says(200, [1]))
    with pytest.raises(UnigroundError, match="answered 502: <html>") as proxy:
        Client(server.url).call("GET", "/healthz")
    assert (proxy.value.code, proxy.value.status) == ("no_problem_document", 502)
    with pytest.raises(UnigroundError) as other:
        Client(server.url).job("j")
    assert other.value.code == "unreadable_reply"


def event(state: str) -> bytes:
    return f"event: progress\ndata: {json.dumps({**JOB, 'state': state})}\n\n".encode()


def test_a_job_is_followed_where_events_break_off_or_do_not_come_through(scripted: Callable[..., Scripted]) -> None:
    done = says(200, {**JOB, "state": "succeeded"})
    for stream in (sends_then_breaks_off(event("running")), breaks_off, says(429, BUSY, {"retry-after": "1"})):
        server = scripted(stream, says(200, {**JOB, "state": "running"}), done)
        states: list[str] = []
        assert Client(server.url).follow("j", lambda job, states=states: states.append(job.state)).state == "succeeded"  # type: ignore[misc]
        # What is the same as before is not told again.
        assert states == ["running", "succeeded"]


def test_waiting_ends_when_it_should(scripted: Callable[..., Scripted]) -> None:
    server = scripted(stays_silent, *[says(200, {**JOB, "state": "running"})] * 3)
    began = time.monotonic()
    with pytest.raises(UnigroundError) as late:
        Client(server.url).follow("j", timeout_s=0.3)
    assert late.value.code == "wait_timed_out"
    assert time.monotonic() - began < 1.4


def test_results_go_on_behind_the_last_one(scripted: Callable[..., Scripted]) -> None:
    def line(item: int) -> bytes:
        return (
            json.dumps({"item": item, "scene_id": "s", "query": "q", "status": "failed", "answer_id": "a", "answer": None}).encode() + b"\n"
        )

    batch = {"id": "b", "state": "running", "items": 3, "done": 1, "by_status": {}, "cost_usd": 0.0, "created_at": "now"}
    server = scripted(
        says(200, batch),
        sends_then_breaks_off(line(0) + line(1)[:20]),
        says(200, batch),
        says(200, line(1) + line(2)),
        says(200, {**batch, "state": "succeeded", "done": 3}),
    )
    assert [result.item for result in Client(server.url).batch(ID).results()] == [0, 1, 2]
    assert server.requests[3][0] == "GET /v1/batches/b/results?from=1&follow=true"


def test_a_list_that_is_paused_says_why(scripted: Callable[..., Scripted]) -> None:
    batch = {
        "id": "b",
        "state": "paused",
        "reason": "budget_spent",
        "items": 3,
        "done": 0,
        "by_status": {},
        "cost_usd": 1.0,
        "created_at": "now",
    }
    server = scripted(says(200, batch), says(200, b""), says(200, batch))
    with pytest.raises(UnigroundError, match="budget_spent") as paused:
        list(Client(server.url).batch(ID).results())
    assert paused.value.code == "batch_paused"
