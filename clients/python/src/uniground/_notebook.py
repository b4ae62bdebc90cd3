"""What notebooks show of answers and scenes: `_repr_html_`. Names and questions are somebody else's words, so all text is escaped."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any, Optional

import httpx

# A notebook waits for this picture when it shows a cell.
PICTURE_TIMEOUT_S = 10.0
# Of an ambiguous question, or one about several things.
MOST_ROWS = 8


def picture(http: Optional[httpx.Client], evidence: Sequence[str]) -> Optional[bytes]:
    """The room with the box, JPEG; `None` where it has none, or where the server cannot be asked any more."""
    path = next((path for path in evidence if path.endswith("/global.jpg")), None)
    if http is None or path is None:
        return None
    try:
        reply = http.get(path, timeout=PICTURE_TIMEOUT_S)
    except (httpx.HTTPError, RuntimeError):
        # A client that was closed raises a RuntimeError.
        return None
    return reply.content if reply.is_success else None


def answer(of: Any, jpeg: Optional[bytes]) -> str:
    """An `Answer`."""
    rows = [("status", f"{of.status}, confidence {of.confidence:.2f}")]
    if of.name is not None:
        rows.append(("name", f"{of.name} (instance {of.answer.predicted_id})"))
    if of.count is not None:
        rows.append(("count", str(of.count)))
    if of.box is not None:
        rows += [("center", f"{_numbers(of.box.center)} m"), ("size", f"{_numbers(of.box.size)} m")]
    if of.status == "ambiguous":
        rows.append(("one of", _several(f"{one.name or 'unnamed'} ({one.id})" for one in of.alternatives)))
    elif len(of.targets) > 1:
        rows.append(("all", _several(f"{one.name} ({one.id})" for one in of.targets)))
    rows.append(("explanation", of.answer.explanation))
    image = ""
    if jpeg is not None:
        data = base64.b64encode(jpeg).decode()
        image = f'<img alt="the room with the box" style="max-width: 480px" src="data:image/jpeg;base64,{data}">'
    return f"<div><p><b>{escape(of.query)}</b></p>{image}{_table(rows)}</div>"


def scene(info: Any) -> str:
    """A scene, as the server describes it."""
    rows = [("id", info.id), ("status", info.status)]
    if info.error is not None:
        rows.append(("error", f"{info.error.detail} ({info.error.code})"))
    if info.counts is not None:
        rows.append(("objects", str(info.counts.instances)))
        rows.append(("points", f"{info.counts.points:,}"))
        rows.append(("frames", str(info.counts.frames_used)))
    if info.extent is not None:
        rows.append(("size", f"{_numbers(info.extent.size)} m"))
    if info.labels:
        rows.append(("labels", ", ".join(f"{name}={value}" for name, value in info.labels.items())))
    if info.map_frame_id:
        rows.append(("map", info.map_frame_id))
    return f"<div><p><b>{escape(info.name)}</b></p>{_table(rows)}</div>"


def _table(rows: Iterable[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><th>{escape(name)}</th><td style='text-align: left'>{escape(value)}</td></tr>" for name, value in rows)
    return f"<table>{cells}</table>"


def _several(names: Iterable[str]) -> str:
    known = list(names)
    more = f", and {len(known) - MOST_ROWS} more" if len(known) > MOST_ROWS else ""
    return ", ".join(known[:MOST_ROWS]) + more


def _numbers(of: Iterable[float]) -> str:
    return " ".join(f"{length:.2f}" for length in of)
