"""The asynchronous client. The other one, `_sync.py`, is made of this file by scripts/python-client.py."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import time
import uuid
import warnings
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Callable, Optional, TypeVar, Union

import httpx

from uniground import _notebook, models
from uniground._local import PathLike, Server, serve
from uniground._scan import Cloud, Source, packed, read_ply
from uniground._sync import Client  # async only
from uniground._wire import (
    Progress,
    UnigroundError,
    chunks,
    decode,
    given,
    is_id,
    matching,
    pause_before,
    problem_of,
    scene_problem,
    settings,
    suggest,
    to_json,
    transport_problem,
    whole_lines,
    written,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

T = TypeVar("T")
OnJob = Callable[[models.Job], object]

# A stream that says nothing for longer than this is held back by something on the way: the server sends a sign of life every 15 s.
SILENCE_S = 30.0
POLL_S = 1.0
FINAL = ("succeeded", "failed", "cancelled")


class AsyncClient:
    """A uniground server, and how to talk to it.

    Address and key come from the arguments, else from `UNIGROUND_SERVER` and `UNIGROUND_API_KEY`, as for the command line.
    `timeout_s` bounds silence on the wire; a question's own `timeout_s` bounds the question. What was refused for now, or did not reach the
    server, is tried again up to `retries` times, but never where that could upload or pay twice.
    """

    def __init__(
        self,
        server: Optional[str] = None,
        api_key: Optional[str] = None,
        *,
        timeout_s: float = 300.0,
        retries: int = 4,
    ) -> None:
        self.server, headers = settings(server, api_key)
        self._retries = retries
        self._local: Optional[Server] = None
        self._waiting = Client(server, api_key, timeout_s=timeout_s, retries=retries)  # async only
        timeout = httpx.Timeout(timeout_s, connect=min(10.0, timeout_s))
        self._http = httpx.AsyncClient(base_url=self.server, headers=headers, timeout=timeout)

    @classmethod
    async def local(
        cls,
        data_dir: Optional[PathLike] = None,
        models: PathLike = "builtin",
        *,
        program: Optional[PathLike] = None,
        options: Sequence[str] = (),
        timeout_s: float = 300.0,
        retries: int = 4,
    ) -> AsyncClient:
        """A client with a private server of its own, which stops when the client is closed and when Python ends.

        Without `data_dir` its scenes are gone then. `uniground.serve` describes the arguments.
        """
        server = await asyncio.to_thread(serve, data_dir, models, program=program, options=options)
        client = cls(server.url, server.api_key, timeout_s=timeout_s, retries=retries)
        client._local = server
        return client

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        self._waiting.close()  # async only
        await self._http.aclose()
        if self._local is not None:
            await asyncio.to_thread(self._local.stop)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.server!r})"

    async def upload(
        self,
        scan: Source,
        *,
        name: Optional[str] = None,
        up: Optional[models.UpAxis] = None,
        preset: Optional[models.ParsePreset] = None,
        parse: bool = True,
        idempotency_key: Optional[str] = None,
        on_progress: Optional[Progress] = None,
    ) -> AsyncScene:
        """Uploads a scan and has it parsed; `wait` on what comes back waits for that.

        `scan` is a folder, an archive (.zip, .tar, .tar.zst), a .ply file or a `Scan` of arrays. `on_progress(sent, total)` is told bytes;
        the asynchronous client calls it from a thread. With an `idempotency_key` of yours the scene that it made before comes back,
        however often the program is run.
        """
        params = {"name": name, "up": up, "preset": preset, "parse": parse}
        created = await self._upload("/v1/scenes", scan, params, idempotency_key, on_progress)
        return AsyncScene(self, created.scene)

    async def scene(self, scene_id: str) -> AsyncScene:
        """A scene by its id or its name. The beginning of either will do, if no other scene's begins so."""
        if is_id(scene_id):
            return AsyncScene(self, decode(models.Scene, await self.call("GET", f"/v1/scenes/{scene_id.lower()}")))
        known = [info async for info in self._pages("/v1/scenes", models.Scene, "scenes")]
        found = matching(known, scene_id)
        if len(found) != 1:
            raise scene_problem(scene_id, found, known)
        return AsyncScene(self, found[0])

    async def scenes(self, labels: Optional[Mapping[str, str]] = None) -> AsyncIterator[AsyncScene]:
        """All scenes, or those that have these labels, newest first."""
        params = {"labels": ",".join(f"{name}={value}" for name, value in labels.items())} if labels else {}
        async for info in self._pages("/v1/scenes", models.Scene, "scenes", params):
            yield AsyncScene(self, info)

    async def find(self, query: str, **options: Unpack[models.ManyGroundOptions]) -> models.ManyAnswers:
        """In which of many scenes something is, the likeliest first. `options` are the fields of the API's request: `labels` or `scenes`
        say where to look, `top_k` how many scenes are answered in full."""
        many = decode(models.ManyAnswers, await self.call("POST", "/v1/ground", body={"query": query, **options}))
        for one in many.answers:
            one.answer._http = self._waiting._http
        return many

    async def answer(self, answer_id: str) -> models.Answer:
        """An answer that was given before."""
        return self._answer(await self.call("GET", f"/v1/answers/{answer_id}"))

    async def answers(self, **params: str) -> AsyncIterator[models.Answer]:
        """Answers that were given, newest first: of a `scene_id`, `batch_id` or `status`, `since` or `until` a time."""
        async for answer in self._pages("/v1/answers", models.Answer, "answers", params):
            answer._http = self._waiting._http
            yield answer

    async def job(self, job_id: str) -> models.Job:
        return decode(models.Job, await self.call("GET", f"/v1/jobs/{job_id}"))

    async def cancel(self, job_id: str) -> models.Job:
        """Asks a job to stop."""
        return decode(models.Job, await self.call("DELETE", f"/v1/jobs/{job_id}"))

    async def follow(self, job_id: str, on_progress: Optional[OnJob] = None, timeout_s: Optional[float] = None) -> models.Job:
        """Waits for a job to end, however it does; `on_progress` sees every state on the way.

        Follows the server's events; where they do not come through, asks every second.
        """
        end = time.monotonic() + (timeout_s if timeout_s is not None else float("inf"))
        job = None

        def told(now: models.Job) -> models.Job:
            if on_progress and now != job:
                on_progress(now)
            return now

        try:
            silence_s = max(0.01, min(SILENCE_S, end - time.monotonic()))
            async for line in self._lines(f"/v1/jobs/{job_id}/events", silence_s=silence_s):
                if line.startswith("data:"):
                    job = told(decode(models.Job, json.loads(line[5:])))
                if time.monotonic() > end:
                    break
        except UnigroundError as error:
            if not error.is_passing:
                raise
        while True:
            job = told(await self.job(job_id))
            if job.state in FINAL:
                return job
            if time.monotonic() > end:
                raise UnigroundError("wait_timed_out", f"job {job_id} is not done after {timeout_s} s", job_id=job_id)
            await asyncio.sleep(max(0.0, min(POLL_S, end - time.monotonic())))

    async def batch(
        self,
        questions: Union[str, Iterable[Union[str, Mapping[str, Any]]]],
        *,
        scene: Union[AsyncScene, str, None] = None,
        defaults: Optional[models.GroundOptions] = None,
        label: Optional[str] = None,
        concurrency: Optional[int] = None,
        max_cost_usd: Optional[float] = None,
        idempotency_key: Optional[str] = None,
    ) -> AsyncBatch:
        """Has the server ask a list of questions in the background: words, or dictionaries with `query`, `scene_id` and what else
        a question may have. `batch(id)` is a batch that was made before.

        The same questions under the same options, about the same parse of a scene, are the same batch: a program that was stopped goes on
        with it when it is run again, also where it was paused. Another `label`, or an `idempotency_key` of yours, asks anew.
        """
        if isinstance(questions, str):
            if not is_id(questions):
                raise ValueError(f"batch takes the id of a batch or a list of questions, not {questions!r}: scene.ask() asks one question")
            return await self._batch(questions)
        if isinstance(scene, str) and not is_id(scene):
            scene = await self.scene(scene)
        scene_id, version = (scene.id, scene.info.parse_version) if isinstance(scene, AsyncScene) else (scene, None)
        lines: list[Mapping[str, Any]] = [{"defaults": given({**(defaults or {}), "scene_id": scene_id})}]
        lines += [{"query": question} if isinstance(question, str) else question for question in questions]
        body = b"\n".join(to_json(line) for line in lines)
        params = {"label": label, "concurrency": concurrency, "max_cost_usd": max_cost_usd}
        digest = hashlib.sha256(to_json([params, version]) + body).hexdigest()
        reply = await self._send(
            "POST",
            "/v1/batches",
            params=params,
            headers={"content-type": "application/jsonl"},
            content=lambda: body,
            idempotency_key=idempotency_key or digest,
        )
        batch = AsyncBatch(self, decode(models.Batch, reply.json()))
        return await batch.resume() if batch.info.state == "paused" else batch

    async def get_batch(self, batch_id: str) -> AsyncBatch:
        """Deprecated: `batch(batch_id)` does the same."""
        warnings.warn("get_batch(id) is deprecated: use batch(id)", DeprecationWarning, stacklevel=2)
        return await self._batch(batch_id)

    async def batches(self) -> AsyncIterator[AsyncBatch]:
        """All batches, newest first."""
        async for info in self._pages("/v1/batches", models.Batch, "batches"):
            yield AsyncBatch(self, info)

    async def call(self, method: str, path: str, *, params: Optional[Mapping[str, Any]] = None, body: Any = None) -> Any:
        """Any request of the HTTP API, JSON in and out: for what has no method here, like `call("GET", "/v1/stats")`."""
        content = None if body is None else to_json(body)
        headers = {} if body is None else {"content-type": "application/json"}
        reply = await self._send(method, path, params=params, headers=headers, content=lambda: content)
        return reply.json() if reply.content else None

    async def download(self, path: str, params: Optional[Mapping[str, Any]] = None) -> bytes:
        """A file of the server, such as a picture: `path` as an answer gives it."""
        return (await self._send("GET", path, params=params)).content

    async def _batch(self, batch_id: str) -> AsyncBatch:
        return AsyncBatch(self, decode(models.Batch, await self.call("GET", f"/v1/batches/{batch_id}")))

    def _answer(self, value: Any) -> models.Answer:
        """An answer that finds its picture when a notebook shows it."""
        answer = decode(models.Answer, value)
        answer._http = self._waiting._http
        return answer

    def _result(self, line: str) -> models.BatchResult:
        result = decode(models.BatchResult, json.loads(line))
        if result.answer is not None:
            result.answer._http = self._waiting._http
        if result.error is not None:
            result.error.detail = suggest(result.error.detail)
        return result

    async def _upload(
        self, path: str, scan: Source, params: Mapping[str, Any], key: Optional[str], on_progress: Optional[Progress]
    ) -> models.Created:
        archive = await asyncio.to_thread(packed, scan)
        with archive.file:
            # Not on the event loop: asyncio loses a refusal that comes while the scan is still being sent.  # async only
            reply = await asyncio.to_thread(
                self._waiting._send,
                "POST",
                path,
                params=params,
                headers={"content-type": archive.media_type, "content-length": str(archive.size)},
                content=lambda: chunks(archive.file, archive.size, on_progress),
                idempotency_key=key or str(uuid.uuid4()),
            )
        return decode(models.Created, reply.json())

    async def _send(
        self,
        method: str,
        path: str,
        *,
        params: Optional[Mapping[str, Any]] = None,
        headers: Optional[Mapping[str, str]] = None,
        content: Callable[[], Any] = lambda: None,
        idempotency_key: Optional[str] = None,
    ) -> httpx.Response:
        """A request, tried again where that can not do anything twice. `content` makes the body, anew each time."""
        headers = {**(headers or {}), **({"idempotency-key": idempotency_key} if idempotency_key else {})}
        repeatable = method in ("GET", "PATCH") or idempotency_key is not None
        attempt = 0
        while True:
            cause: Optional[httpx.TransportError] = None
            try:
                reply = await self._http.request(method, path, params=given(params), headers=headers, content=content())
                if reply.is_success:
                    return reply
                error = problem_of(reply)
            except httpx.TransportError as transport:
                cause, error = transport, transport_problem(transport, self.server)
            pause = pause_before(attempt, error, cause, repeatable) if attempt < self._retries else None
            if pause is None:
                raise error from cause
            await asyncio.sleep(pause)
            attempt += 1

    async def _lines(self, path: str, params: Optional[Mapping[str, Any]] = None, silence_s: Optional[float] = None) -> AsyncIterator[str]:
        """A reply line by line while it comes; not tried again, the caller knows where to go on."""
        timeout = self._http.timeout if silence_s is None else httpx.Timeout(silence_s)
        try:
            async with self._http.stream("GET", path, params=given(params), timeout=timeout) as reply:
                if not reply.is_success:
                    await reply.aread()
                    raise problem_of(reply)
                # Not `iter_lines`, which also breaks lines where a question has one of Unicode's own line separators.
                rest = b""
                async for piece in reply.aiter_bytes():
                    *lines, rest = (rest + piece).split(b"\n")
                    for line in lines:
                        yield line.decode()
        except httpx.TransportError as error:
            raise transport_problem(error, self.server) from error

    async def _pages(self, path: str, kind: type[T], field: str, params: Optional[Mapping[str, Any]] = None) -> AsyncIterator[T]:
        cursor = None
        while True:
            page = await self.call("GET", path, params={**(params or {}), "cursor": cursor})
            for one in page[field]:
                yield decode(kind, one)
            cursor = page.get("next_cursor")
            if cursor is None:
                return


class AsyncScene:
    """A scan on the server."""

    def __init__(self, client: AsyncClient, info: models.Scene) -> None:
        self._client = client
        self.info = info
        """All that the server tells of it, as it was when last asked; `refresh` asks again."""

    @property
    def id(self) -> str:
        return self.info.id

    @property
    def name(self) -> str:
        return self.info.name

    @property
    def status(self) -> models.SceneStatus:
        """`uploaded`, `parsing`, `ready` or `failed`, as it was when last asked."""
        return self.info.status

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {self.id}, {self.status})"

    def _repr_html_(self) -> str:
        return _notebook.scene(self.info)

    async def refresh(self) -> AsyncScene:
        """Asks the server again how the scene stands."""
        self.info = decode(models.Scene, await self._client.call("GET", f"/v1/scenes/{self.id}"))
        return self

    async def wait(self, on_progress: Optional[OnJob] = None, timeout_s: Optional[float] = None, *, full: bool = False) -> AsyncScene:
        """Waits until the scene is parsed; an `UnigroundError` says why where it can not be.

        A server with neural networks makes a draft first. With `full`, also waits for the full parse after it; `timeout_s` applies to
        each of the two.
        """
        if self.info.job_id is None:
            raise UnigroundError("scene_not_ready", f"scene {self.id} was only stored: parse() it")
        job = await self._client.follow(self.info.job_id, on_progress, timeout_s)
        await self.refresh()
        if job.state == "succeeded":
            follows = full and self.info.job_id not in (None, job.id)
            return await self.wait(on_progress, timeout_s, full=full) if follows else self
        error = job.error or models.JobError(code="cancelled", detail=f"job {job.id} was cancelled")
        raise UnigroundError(error.code, error.detail, job_id=job.id)

    async def ask(self, query: str, *, idempotency_key: Optional[str] = None, **options: Unpack[models.GroundOptions]) -> models.Answer:
        """Answers a question. `options` are the fields of the API's request: see `uniground.models.GroundOptions`.

        Every call has a key, so that a question whose connection was lost is sent again and a model is still paid once. With an
        `idempotency_key` of yours the answer that it got before comes back, however often the program is run.
        """
        return self._client._answer(await self._post("ground", {"query": query, **options}, idempotency_key or str(uuid.uuid4())))

    async def ask_all(
        self, questions: Iterable[Union[str, Mapping[str, Any]]], **options: Unpack[models.GroundOptions]
    ) -> list[models.BatchResult]:
        """Answers many questions, as a batch: the results in the order of the questions. Run again, it pays for nothing twice."""
        batch = await self._client.batch(questions, scene=self, defaults=options)
        return [result async for result in batch.results()]

    async def shortlist(self, query: str, **options: Unpack[models.ShortlistOptions]) -> models.Shortlisted:
        """Candidates by looks, or by names and attributes, without regard to relations."""
        return decode(models.Shortlisted, await self._post("shortlist", {"query": query, **options}))

    async def approach(
        self, robot: models.Robot, *, start: Optional[Iterable[float]] = None, **options: Unpack[models.ApproachOptions]
    ) -> models.Approach:
        """Where a robot can stand for a thing, the best place first, or why nowhere. `options` are the other fields of the API's request,
        one of them `query`, `instance_id` or `unseen_region`. `start` is its `from`, where the robot is: x and y, and z where `frame`
        wants it."""
        begin = {} if start is None else {"from": dict(zip("xyz", start))}
        return decode(models.Approach, await self._post("approach", {"robot": robot, **begin, **options}))

    async def floor(self, height_m: float = 1.8) -> models.FloorMap:
        """How the pixels of `floor_picture` lie in the scene, as `map_server` of ROS reads it."""
        return decode(models.FloorMap, await self._client.call("GET", f"/v1/scenes/{self.id}/floor", params={"height_m": height_m}))

    async def floor_picture(self, height_m: float = 1.8) -> bytes:
        """The floor from above, PNG: 254 free, 0 occupied by something below `height_m`, 205 unknown; the greatest y is on top."""
        return await self._client.download(f"/v1/scenes/{self.id}/floor.png", {"height_m": height_m})

    async def graph(self, level: str = "things", around: Optional[int] = None) -> models.SceneGraph:
        """What is on, inside, above and next to what, and zones: of the whole scene, or `around` one instance."""
        params = {"level": level, "around": around}
        return decode(models.SceneGraph, await self._client.call("GET", f"/v1/scenes/{self.id}/graph", params=params))

    async def graph_text(self, level: str = "things", around: Optional[int] = None) -> str:
        """The same, a line for each thing: for the prompt of a language model."""
        return (await self._client.download(f"/v1/scenes/{self.id}/graph", {"format": "text", "level": level, "around": around})).decode()

    async def instances(self, level: str = "things") -> list[models.InstanceView]:
        """What the scene was cut into: `things`, `parts`, `wholes` or `all`."""
        pages = self._client._pages(f"/v1/scenes/{self.id}/instances", models.InstanceView, "instances", {"level": level})
        return [instance async for instance in pages]

    async def instance(self, instance_id: int) -> models.InstanceView:
        return decode(models.InstanceView, await self._client.call("GET", f"/v1/scenes/{self.id}/instances/{instance_id}"))

    async def correct(self, **change: Unpack[models.Change]) -> models.Correction:
        """Says what is wrong (`kind="rename", instance_id=3, name="red mug"`; `dismiss`, `merge`, `split`): answers know it from now on."""
        return decode(models.Correction, await self._post("corrections", change))

    async def corrections(self) -> list[models.Correction]:
        """What was said of the parse, newest first, what was taken back as well."""
        told = await self._client.call("GET", f"/v1/scenes/{self.id}/corrections")
        return decode(models.CorrectionList, told).corrections

    async def undo(self, correction_id: str) -> models.Correction:
        """Takes a correction back."""
        return decode(models.Correction, await self._client.call("DELETE", f"/v1/scenes/{self.id}/corrections/{correction_id}"))

    async def picture(self, answer: models.Answer) -> bytes:
        """The room with the answer's box, JPEG."""
        return await self._client.download(f"/v1/answers/{answer.id}/evidence/global.jpg")

    async def photograph(self, instance_id: int, view: int = 0, crop: bool = False) -> bytes:
        """A photograph that shows an instance well, outlined, JPEG; `crop` cuts it out. As many as it has `views`, best first."""
        path = f"/v1/scenes/{self.id}/instances/{instance_id}/views/{view}.jpg"
        return await self._client.download(path, {"picture": "crop" if crop else "frame"})

    async def cloud(self, instances: bool = False) -> Cloud:
        """Points and colours; with `instances`, coloured by thing and with its id for each point."""
        return read_ply(await self._client.download(f"/v1/scenes/{self.id}/{'instances' if instances else 'cloud'}.ply"))

    async def export(self, format: str, file: Union[str, os.PathLike[str], None] = None, *, points: Optional[int] = None) -> bytes:
        """The scene for other programs: `glb`, `ply`, `usdz` or `json`, with at most so many points. With a `file`, written there too."""
        content = await self._client.download(f"/v1/scenes/{self.id}/export", {"format": format, "points": points})
        return content if file is None else await asyncio.to_thread(written, content, file)

    async def report(self) -> models.SceneReport:
        """What the parse did, took and warns of."""
        return decode(models.SceneReport, await self._client.call("GET", f"/v1/scenes/{self.id}/report"))

    async def parse(self, **request: Unpack[models.ParseRequest]) -> AsyncScene:
        """Parses the scan anew: `preset`, and single `settings` that replace its own. Until `wait` is over the old parse is asked."""
        await self._post("parse", request)
        return await self.refresh()

    async def add_frames(
        self,
        scan: Source,
        *,
        world: models.FrameChoice = "source",
        idempotency_key: Optional[str] = None,
        on_progress: Optional[Progress] = None,
    ) -> AsyncScene:
        """Adds the frames of a scan, told in the coordinates of `world`; `wait` waits until they are known. What stays keeps its id."""
        path = f"/v1/scenes/{self.id}/frames"
        self.info = (await self._client._upload(path, scan, {"world": world}, idempotency_key, on_progress)).scene
        return self

    async def changes(self, *, since: Optional[int] = None, to: Optional[str] = None, align: Optional[bool] = None) -> models.SceneChanges:
        """What changed since a version of the scene (default: its first), or in another scan of the room, the scene `to`."""
        params = given({"since": since, "to": to, "align": align})
        return decode(models.SceneChanges, await self._client.call("GET", f"/v1/scenes/{self.id}/changes", params=params))

    async def rename(self, name: str) -> AsyncScene:
        return await self._change({"name": name})

    async def label(self, labels: Mapping[str, str]) -> AsyncScene:
        """Files the scene under these labels, and no others."""
        return await self._change({"labels": dict(labels)})

    async def place_in_map(
        self, rotation: Iterable[float], translation_m: Iterable[float], map_frame_id: Optional[str] = None
    ) -> AsyncScene:
        """Says where the scene lies in a map, for `frame="map"`: `map = rotation * scene + translation_m`, a unit quaternion x, y, z, w."""
        place = {"rotation": list(rotation), "translation_m": list(translation_m)}
        return await self._change(given({"scene_to_map": place, "map_frame_id": map_frame_id}))

    async def delete(self) -> None:
        """Deletes the scene, its answers and files."""
        await self._client.call("DELETE", f"/v1/scenes/{self.id}")

    async def _change(self, change: Mapping[str, Any]) -> AsyncScene:
        self.info = decode(models.Scene, await self._client.call("PATCH", f"/v1/scenes/{self.id}", body=change))
        return self

    async def _post(self, what: str, body: Mapping[str, Any], key: Optional[str] = None) -> Any:
        path, headers = f"/v1/scenes/{self.id}/{what}", {"content-type": "application/json"}
        return (await self._client._send("POST", path, headers=headers, content=lambda: to_json(body), idempotency_key=key)).json()


class AsyncBatch:
    """A list of questions that the server asks in the background."""

    def __init__(self, client: AsyncClient, info: models.Batch) -> None:
        self._client = client
        self.info = info
        """How far it is, as it was when last asked; `refresh` asks again."""

    @property
    def id(self) -> str:
        return self.info.id

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.id}, {self.info.state}, {self.info.done} of {self.info.items})"

    async def refresh(self) -> AsyncBatch:
        self.info = decode(models.Batch, await self._client.call("GET", f"/v1/batches/{self.id}"))
        return self

    async def pause(self) -> AsyncBatch:
        return await self._tell("pause")

    async def resume(self) -> AsyncBatch:
        return await self._tell("resume")

    async def cancel(self) -> AsyncBatch:
        return await self._tell("cancel")

    async def _tell(self, what: str) -> AsyncBatch:
        self.info = decode(models.Batch, await self._client.call("POST", f"/v1/batches/{self.id}/{what}"))
        return self

    async def results(self, start: int = 0, follow: bool = True) -> AsyncIterator[models.BatchResult]:
        """Results in the order of the questions, from a place on. `follow` waits for those that are still asked, and goes on where it was
        when the connection breaks; without it, only what is there already."""
        async for line in self._result_lines(start, follow):
            yield self._client._result(line)

    async def save(self, file: Union[str, os.PathLike[str]]) -> int:
        """Writes results to a file, a line of JSON each, behind those that it has: a program that was stopped goes on. Returns how many
        are there now."""
        with open(file, "a+b") as out:  # noqa: ASYNC230, a line at a time
            there = whole_lines(out)
            async for line in self._result_lines(there, follow=True):
                out.write(line.encode() + b"\n")
                out.flush()
                there += 1
        return there

    async def _result_lines(self, start: int, follow: bool) -> AsyncIterator[str]:
        while True:
            try:
                params = {"from": start, "follow": follow}
                async for line in self._client._lines(f"/v1/batches/{self.id}/results", params):
                    start = json.loads(line)["item"] + 1
                    yield line
            except UnigroundError as error:
                if not error.is_passing:
                    raise
            await self.refresh()
            if start >= self.info.items or not follow:
                return
            if start >= self.info.done and self.info.state != "running":
                why = self.info.reason or f"{self.info.state} after {start} of {self.info.items} questions"
                raise UnigroundError(f"batch_{self.info.state}", f"batch {self.id}: {why}", job_id=self.info.job_id)
            await asyncio.sleep(POLL_S)
