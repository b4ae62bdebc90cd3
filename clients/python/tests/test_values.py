"""Boxes as arrays, short texts, and what notebooks show: nothing here asks a server, except where a picture is fetched."""

from __future__ import annotations

import copy
import dataclasses
import json
import pickle
from html.parser import HTMLParser
from typing import Any, cast

import numpy as np
import pytest

from uniground import Client, Scene, Vector, models, row
from uniground._wire import decode, suggest

MUG = "the mug on the coffee table"


def box(yaw_rad: float = 0.5) -> models.OrientedBox:
    return decode(models.OrientedBox, {"center": [1.0, 2.0, 3.0], "size": [0.5, 1.0, 2.0], "yaw_rad": yaw_rad})


def test_a_center_computes_like_an_array() -> None:
    center, size, robot = box().center, box().size, np.array([1.0, 0.0, 0.0])
    assert isinstance(center, Vector)
    for result, expected in [
        (center - robot, [0, 2, 3]),
        (robot - center, [0, -2, -3]),
        (center - [1, 1, 1], [0, 1, 2]),
        (center + size / 2, [1.25, 2.5, 4]),
        (2 * center, [2, 4, 6]),
        (center > 1, [False, True, True]),
        (center[:2] - robot[:2], [0, 2]),
        (center[[0, 2]], [1, 3]),
        (np.maximum(center, 2), [2, 2, 3]),
        (np.stack([center, size])[1], [0.5, 1, 2]),
    ]:
        assert isinstance(result, np.ndarray)
        assert result.tolist() == expected
    assert (center.shape, center.mean(), center @ size) == ((3,), 2.0, 8.5)
    assert np.linalg.norm(size) == pytest.approx(np.sqrt(5.25))
    center += 1
    assert (type(center), center) == (Vector, [2.0, 3.0, 4.0])
    with pytest.raises(AttributeError):
        _ = center.no_such_thing


def test_a_center_is_still_a_list() -> None:
    center = box().center
    x, *_ = center
    assert (x, center[-1], len(center), center == [1.0, 2.0, 3.0]) == (1.0, 3.0, 3, True)
    assert json.dumps(dataclasses.asdict(box())) == '{"center": [1.0, 2.0, 3.0], "size": [0.5, 1.0, 2.0], "yaw_rad": 0.5}'
    assert box() == copy.deepcopy(box()) == pickle.loads(pickle.dumps(box()))
    assert box() != box(0.6)
    # Boxes of a program's own, of lists, compute as well.
    own = models.Aabb(cast(Any, [0.0, 0.0, 0.0]), cast(Any, [1.0, 1.0, 1.0]))
    assert (own.center - own.size / 2).tolist() == [-0.5, -0.5, -0.5]
    assert own.array() == pytest.approx([0, 0, 0, 1, 1, 1, 0])


def test_texts_are_short(scene: Scene) -> None:
    answer = scene.ask(MUG)
    assert repr(answer) == "Answer('the mug on the coffee table', uncertain, 'orange mug' (80), confidence 0.34)"
    assert repr(scene.ask("the spaceship")).startswith("Answer('the spaceship', no_match, confidence 0.")
    assert repr(answer.box).startswith("Aabb(center=[-0.909, 0.525, 0.518], size=[")
    assert repr(answer.oriented_box).endswith("yaw_rad=-0.262)")
    for some in (answer, *answer.targets, *(answer.candidates or []), *scene.instances(), scene.info, scene.report()):
        assert len(repr(some)) < 250
        assert "\n" not in repr(some)


def test_a_thing_has_a_name_wherever_it_is_met(scene: Scene) -> None:
    mug = scene.instance(80)
    assert (mug.name, row(mug)["name"], mug.label) == ("mug", "mug", "mug")
    named = dataclasses.replace(mug, model_name="espresso cup")
    assert (named.name, dataclasses.replace(named, given_name="Anna's cup").name) == ("espresso cup", "Anna's cup")
    changed = models.ChangedThing(id=3, label="chair", box=mug.box)
    assert (changed.name, changed.label) == ("chair", "chair")
    answer = scene.ask(MUG)
    assert {answer.name, answer.targets[0].name, (answer.candidates or [])[0].name} == {"orange mug"}


class Shown(HTMLParser):
    """Text and pictures of what a notebook shows; an element that is not closed fails."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text, self.images = "", list[str]()
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, Any]]) -> None:
        if tag == "img":
            self.images.append(dict(attrs)["src"])
        else:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += f" {data}"


def test_a_notebook_shows_the_picture_and_what_matters(scene: Scene) -> None:
    answer = scene.ask(MUG)
    shown = Shown(answer._repr_html_())
    [image] = shown.images
    assert image.startswith("data:image/jpeg;base64,/9j/")
    for text in (MUG, "uncertain", "orange mug (instance 80)", "-0.91 0.52 0.52 m", answer.answer.explanation):
        assert text in shown.text
    assert len(shown.text) < 500
    stools = Shown(scene.ask("the stool")._repr_html_())
    assert "one of" in stools.text
    assert "stool (" in stools.text
    assert "4" in Shown(scene.ask("how many mugs are there")._repr_html_()).text
    assert "no_match" in Shown(scene.ask("the spaceship")._repr_html_()).text


def test_a_notebook_without_a_server_shows_the_rest(scene: Scene, server: str) -> None:
    with Client() as client:
        answer = client.scene(scene.id).ask(MUG)
    # Its client is closed; a copy never had one.
    for left in (answer, pickle.loads(pickle.dumps(answer)), copy.deepcopy(answer)):
        assert left == answer
        shown = Shown(left._repr_html_())
        assert shown.images == []
        assert "orange mug" in shown.text
    away = Client("http://127.0.0.1:9")
    answer._http = away._http
    assert Shown(answer._repr_html_()).images == []


def test_a_notebook_shows_a_scene(scene: Scene) -> None:
    shown = Shown(scene._repr_html_())
    for text in ("living room", scene.id, "ready", "304,437", "6.51 5.01 2.28 m"):
        assert text in shown.text


def test_words_of_others_are_shown_as_text(scene: Scene) -> None:
    answer = scene.ask("the <script>alert(1)</script> mug")
    answer = dataclasses.replace(answer, answer=dataclasses.replace(answer.answer, explanation="<img src=x onerror=alert(1)>"))
    html = answer._repr_html_()
    assert "<script" not in html
    assert "<img src=x" not in html
    assert "&lt;script&gt;" in html


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (
            "/topk: unknown field `topk`, expected one of `query`, `top_k`, `parser` at line 1 column 26",
            "/topk: unknown field `topk`, did you mean `top_k`?",
        ),
        (
            "unknown field `positon`, expected `position` or `yaw_rad` at line 1 column 41",
            "unknown field `positon`, did you mean `position`?",
        ),
        ("heigth_m: unknown field `heigth_m`, expected `height_m`", "heigth_m: unknown field `heigth_m`, did you mean `height_m`?"),
        ("unknown variant `Buildin`, expected one of `auto`, `vlm`, `builtin`", "unknown value `Buildin`, did you mean `builtin`?"),
        ("unknown field `zzz`, expected one of `query`, `top_k`", "unknown field `zzz`, expected one of `query`, `top_k`"),
        ("must be 1 to 100", "must be 1 to 100"),
    ],
)
def test_a_misspelled_word_suggests_the_near_one(said: str, expected: str) -> None:
    assert suggest(said) == expected
