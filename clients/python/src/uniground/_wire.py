"""What both clients do with requests and replies: settings, errors, when to try again, JSON into models."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import io
import json
import os
import re
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Optional, Protocol, TypeVar, Union, get_args, get_origin, get_type_hints

import httpx
import numpy as np

from uniground._values import Vector

T = TypeVar("T")
S = TypeVar("S", bound="Named")
Progress = Callable[[int, int], object]

CHUNK = 256 * 1024
SERVER = "http://127.0.0.1:8080"
# How the server names a field or a word that it does not know, and those it knows.
UNKNOWN = re.compile(r"unknown (field|variant) `([^`]*)`, expected (?:one of )?(`[^`]*`(?:(?:, | or )`[^`]*`)*)( at line \d+ column \d+)?")
# Scenes that an error lists.
LISTED = 12
# What a reply may tell us to wait before we rather give up and say so.
LONGEST_PAUSE_S = 60.0


class UnigroundError(Exception):
    """Something went wrong, at the server or on the way to it. Decide on `code`: it is stable.

    The codes are listed in the manual under "HTTP API". This side adds `unreachable`, `timed_out` (silence on the wire), `wait_timed_out`
    (a `timeout_s` of yours), `no_problem_document` (the reply of something else than uniground), `unreadable_reply`, `scene_ambiguous`
    (several scenes of that name), `program_not_found` and `server_not_started` (`uniground.serve`).
    """

    def __init__(
        self,
        code: str,
        detail: str,
        *,
        title: str = "",
        status: Optional[int] = None,
        retry_after: Optional[float] = None,
        errors: Optional[list[dict[str, str]]] = None,
        job_id: Optional[str] = None,
        request_id: Optional[str] = None,
    ) -> None:
        super().__init__(f"{detail} ({code})")
        self.code = code
        """Stable: what a program should look at."""
        self.detail = detail
        """For people: names the file, frame or field that is wrong."""
        self.title = title
        """The HTTP status in words."""
        self.status = status
        """The HTTP status; `None` where no reply came, or for a job that failed."""
        self.retry_after = retry_after
        """Seconds after which it may go better."""
        self.errors = errors or []
        """Fields of the request that are wrong: `pointer` and `detail`."""
        self.job_id = job_id
        """The job to wait for (`scene_not_ready`), or the one that failed."""
        self.request_id = request_id
        """Names the request in the server's log."""

    @property
    def is_passing(self) -> bool:
        """Whether the same request may succeed later."""
        return self.code in ("unreachable", "timed_out") or self.status in (429, 503)


def settings(server: Optional[str], api_key: Optional[str]) -> tuple[str, dict[str, str]]:
    """Address and headers, from arguments or from the variables that the command line reads."""
    server = server or os.environ.get("UNIGROUND_SERVER") or SERVER
    if not server.startswith(("http://", "https://")):
        raise ValueError(f"{server!r} is not the address of a server, which looks like {SERVER}")
    api_key = api_key or os.environ.get("UNIGROUND_API_KEY")
    return server.rstrip("/"), {"authorization": f"Bearer {api_key}"} if api_key else {}


def problem_of(response: httpx.Response) -> UnigroundError:
    """The error that a reply tells; its body must have been read."""
    try:
        problem = response.json()
        code, detail, title = problem["code"], problem["detail"], problem["title"]
    except (ValueError, KeyError, TypeError):
        problem, code, title = {}, "no_problem_document", response.reason_phrase
        detail = f"{response.request.url} answered {response.status_code}: {response.text[:200]}"
    errors = [{**error, "detail": suggest(error.get("detail", ""))} for error in problem.get("errors") or []]
    return UnigroundError(
        code,
        suggest(detail),
        title=title,
        status=response.status_code,
        retry_after=_seconds(response.headers.get("retry-after")),
        errors=errors,
        job_id=problem.get("job_id"),
        request_id=problem.get("request_id"),
    )


def suggest(detail: str) -> str:
    """A message with the nearest known name instead of all of them, where one is near: "unknown field `topk`, did you mean `top_k`?"."""

    def nearest(match: re.Match[str]) -> str:
        kind, word, known = match[1], match[2], re.findall(r"`([^`]*)`", match[3])
        near = difflib.get_close_matches(word.lower(), known, n=1)
        return f"unknown {'field' if kind == 'field' else 'value'} `{word}`, did you mean `{near[0]}`?" if near else match[0]

    return UNKNOWN.sub(nearest, detail)


def transport_problem(error: httpx.TransportError, server: str) -> UnigroundError:
    if isinstance(error, httpx.TimeoutException) and not isinstance(error, httpx.ConnectTimeout):
        return UnigroundError("timed_out", f"{server} said nothing for too long")
    return UnigroundError("unreachable", f"{server} could not be reached or closed the connection: {error or type(error).__name__}")


def pause_before(attempt: int, error: UnigroundError, cause: Optional[Exception], repeatable: bool) -> Optional[float]:
    """Seconds to wait before the request is sent again; `None` where that could do something twice, or would not help."""
    if error.status in (429, 503):
        # Refused before anything was done. Without `Retry-After` the refusal is not one that passes by itself.
        return error.retry_after if error.retry_after is not None and error.retry_after <= LONGEST_PAUSE_S else None
    if isinstance(cause, httpx.TransportError) and (repeatable or isinstance(cause, (httpx.ConnectError, httpx.ConnectTimeout))):
        return float(min(0.5 * 2**attempt, 8.0))
    return None


def _seconds(header: Optional[str]) -> Optional[float]:
    return float(header) if header and header.isdigit() else None


class Named(Protocol):
    """A scene, as far as its name matters: models stand on this module's neighbors and are not known here."""

    id: str
    name: str
    status: Any


def is_id(text: str) -> bool:
    """Whether this is a whole id, written out."""
    try:
        return len(text) == 36 and str(uuid.UUID(text)) == text.lower()
    except ValueError:
        return False


def matching(scenes: Sequence[S], wanted: str) -> list[S]:
    """Scenes that may be meant: by the id, else the name, else the name in other letters, else how an id or a name begins."""
    lower = wanted.lower()
    ways: list[Callable[[S], bool]] = [
        lambda scene: scene.id == lower,
        lambda scene: scene.name == wanted,
        lambda scene: scene.name.lower() == lower,
        lambda scene: scene.id.startswith(lower) or scene.name.lower().startswith(lower),
    ]
    found = ([scene for scene in scenes if is_meant(scene)] for is_meant in ways) if lower else iter(())
    return next((some for some in found if some), [])


def scene_problem(wanted: str, found: Sequence[Named], known: Sequence[Named]) -> UnigroundError:
    """Why a name is not one scene: there is none, or there are several."""
    listed = found or known
    lines = [f"  {scene.id}  {scene.name} ({scene.status})" for scene in listed[:LISTED]]
    if len(listed) > LISTED:
        lines.append(f"  and {len(listed) - LISTED} more")
    candidates = "\n".join(lines)
    if found:
        return UnigroundError("scene_ambiguous", f"{wanted!r} matches {len(found)} scenes. Use the id of one:\n{candidates}\n")
    if not known:
        return UnigroundError("scene_not_found", f"There is no scene {wanted!r}: this server has no scenes yet. upload() a scan.")
    return UnigroundError("scene_not_found", f"There is no scene {wanted!r}. Scenes of this server:\n{candidates}\n")


def to_json(body: Any) -> bytes:
    """JSON; numpy arrays and numbers are taken as lists and numbers."""

    def plain(value: Any) -> Any:
        if isinstance(value, (np.ndarray, np.generic)):
            return value.tolist()
        raise TypeError(f"{type(value).__name__} can not be sent as JSON")

    return json.dumps(body, default=plain).encode()


def decode(kind: type[T], value: Any) -> T:
    """JSON as a model of `uniground.models`."""
    try:
        decoded: T = _decoded(kind, value)
        return decoded
    except (AttributeError, KeyError, TypeError) as error:
        detail = f"the server's {kind.__name__} can not be read ({error}): is it another version than this client?"
        raise UnigroundError("unreadable_reply", detail) from error


def _decoded(kind: Any, value: Any) -> Any:
    if value is None:
        return None
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        fields = _fields(kind)
        return kind(**{fields[key][0]: _decoded(fields[key][1], part) for key, part in value.items() if key in fields})
    if kind is Vector:
        return Vector(value)
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Union:
        return _decoded(arguments[0], value)
    if origin is list:
        return [_decoded(arguments[0], part) for part in value]
    if origin is dict:
        return {name: _decoded(arguments[1], part) for name, part in value.items()}
    return value


@functools.cache
def _fields(kind: type) -> dict[str, tuple[str, Any]]:
    """Names in JSON: those of the class, less the underscore that sets `import_` apart from Python's word."""
    return {name.rstrip("_"): (name, hint) for name, hint in get_type_hints(kind).items()}


def chunks(file: io.BufferedIOBase, total: int, on_progress: Optional[Progress]) -> Iterator[bytes]:
    """A file piece by piece from its begin; `on_progress` hears how much of it is on its way."""
    file.seek(0)
    sent = 0
    while piece := file.read(CHUNK):
        yield piece
        sent += len(piece)
        if on_progress:
            on_progress(sent, total)


def given(params: Optional[Mapping[str, Any]]) -> dict[str, Any]:
    """Parameters without those that nobody gave."""
    return {name: value for name, value in (params or {}).items() if value is not None}


def written(content: bytes, file: Union[str, os.PathLike[str]]) -> bytes:
    """What was written to a file."""
    Path(file).write_bytes(content)
    return content


def whole_lines(file: BinaryIO) -> int:
    """How many lines a file has; what was only half written is cut off."""
    file.seek(0)
    lines = file.read()
    file.truncate(lines.rfind(b"\n") + 1)
    return lines.count(b"\n")
