"""A user's day with the real server: upload, wait, ask, lists of questions, pictures, errors."""

from __future__ import annotations

import asyncio
import io
import json
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Optional

import numpy as np
import pytest
from PIL import Image
from served import KEY, SAMPLE, running

from uniground import AsyncClient, Client, Scene, UnigroundError, boxes, models, table

MUG, MUG_ID = "the mug on the coffee table", 80
ROBOT: models.Robot = {"radius_m": 0.2, "height_m": 1.3, "eye_height_m": 1.2, "reach_m": 0.8}
# With a line separator of Unicode's, which is none of JSON's lines.
QUESTIONS = ["the mug on the coffee table", "how many mugs are there", "the\u2028sofa", "the spaceship"]


def test_a_scan_is_uploaded_followed_and_asked_about(client: Client, few_frames: Path) -> None:
    sent: list[tuple[int, int]] = []
    stages: list[Optional[str]] = []
    scene = client.upload(few_frames, name="followed", on_progress=lambda *now: sent.append(now))
    assert sent[-1] == (few_frames.stat().st_size, few_frames.stat().st_size)
    scene.wait(lambda job: stages.append(job.stage), timeout_s=120)
    assert len(stages) > 1
    scene.parse(settings={"parsing": {"superpoints": {"voxel_m": 0.03}}}).wait(full=True)
    assert (scene.name, scene.status, scene.info.parse_version) == ("followed", "ready", 2)
    assert scene.info.settings is not None
    assert scene.info.settings["parsing"]["superpoints"]["voxel_m"] == pytest.approx(0.03)
    assert scene.ask("the sofa").parse_version == 2
    assert scene.rename("renamed").name == "renamed"
    scene.delete()
    with pytest.raises(UnigroundError) as gone:
        scene.refresh()
    assert gone.value.code == "scene_not_found"


def test_a_scene_grows_and_tells_what_changed(client: Client, few_frames: Path) -> None:
    scene = client.upload(few_frames, name="grows").wait(timeout_s=120)
    sofa = scene.ask("the sofa").answer.predicted_id
    scene.add_frames(few_frames, idempotency_key="look 2").wait(timeout_s=120)
    assert (scene.info.parse_version, scene.ask("the sofa").answer.predicted_id) == (2, sofa)
    told = scene.changes()
    assert (told.from_.version, told.to.version, told.alignment) == (1, 2, None)
    assert told.changes.unchanged > 0
    assert scene.changes(to=scene.id).alignment is not None
    with pytest.raises(UnigroundError) as refused:
        scene.add_frames(few_frames, world="map")
    assert refused.value.code == "no_map"
    scene.delete()


def test_something_is_found_in_one_of_many_scenes(client: Client, scene: Scene) -> None:
    try:
        assert scene.label({"building": "A", "floor": "2"}).info.labels == {"building": "A", "floor": "2"}
        assert [known.id for known in client.scenes(labels={"building": "A"})] == [scene.id]
        found = client.find(MUG, labels={"building": "A"}, top_k=1)
        assert (found.looked_into, found.not_asked) == (1, [])
        assert (found.answers[0].scene_name, found.answers[0].answer.scene_id) == (scene.name, scene.id)
        assert found.answers[0].answer.name == "orange mug"
        assert client.find(MUG, labels={"building": "B"}).answers == []
        with pytest.raises(UnigroundError) as refused:
            client.find(MUG, scenes=[])
        assert refused.value.code == "invalid_request"
    finally:
        scene.label({})


def test_an_answer_has_its_boxes_as_arrays(scene: Scene) -> None:
    answer = scene.ask("the mug on the coffee table", top_k=3)
    assert answer.status == "uncertain"
    assert answer.name == "orange mug"
    assert answer.box is not None
    assert answer.oriented_box is not None
    assert answer.box.array() == pytest.approx([-0.909, 0.525, 0.518, 0.108, 0.134, 0.098, 0], abs=2e-3)
    assert answer.oriented_box.array() == pytest.approx([-0.896, 0.526, 0.518, 0.104, 0.129, 0.098, -0.262], abs=2e-3)
    assert answer.candidates is not None
    assert boxes(answer.candidates).shape == (3, 7)
    assert str(answer).startswith("the mug on the coffee table: uncertain, orange mug (instance 80), confidence 0.34, centre (-0.91 ")

    cloud = scene.cloud(instances=True)
    assert cloud.instances is not None
    mug = cloud.points[cloud.instances == answer.answer.predicted_id]
    # Stray points are left out of boxes.
    assert answer.oriented_box.contains(mug).mean() > 0.8
    corners = answer.oriented_box.corners()
    assert corners.mean(axis=0) == pytest.approx(answer.oriented_box.center)
    assert np.linalg.norm(corners[1] - corners[0]) == pytest.approx(answer.oriented_box.size[0])
    assert scene.cloud().points.shape == cloud.points.shape


def test_every_field_of_a_question_is_taken(scene: Scene) -> None:
    every: models.GroundOptions = {
        "ablation": "full",
        "allow_builtin": False,
        "candidates": "fused",
        "context": {"instance": 1},
        "direction_convention": "viewer",
        "evidence": "full",
        "frame": "source",
        "if_version": 1,
        "include": ["candidates", "evidence", "trace"],
        "max_cost_usd": 0.0,
        "min_confidence": 0.1,
        "observer": {"position": [0.0, -2.0, 1.2], "yaw_rad": np.pi / 2},
        "parser": "builtin",
        "prompt": "revised",
        "query_text": "mean",
        "reasoner": "builtin",
        "timeout_s": 10.0,
        "top_k": 2,
        "wait": "full",
        "within": {"min_z": -100.0},
    }
    assert set(every) == set(models.GroundOptions.__annotations__), "the API has other fields by now: ask with them"
    answer = scene.ask("the chair to the left of the dining table", **every)
    assert answer.direction_convention == "observer"
    assert answer.candidates is not None
    assert len(answer.candidates) == 2
    assert answer.in_frame is not None
    assert (answer.in_frame.frame, len(answer.in_frame.boxes)) == ("source", len(answer.targets))
    assert answer.in_frame.stamp is not None
    assert answer.in_frame.stamp.sec == pytest.approx(time.time(), abs=60)
    assert scene.ask("the sofa", include=[]).candidates is None


def test_every_field_of_an_approach_is_taken(scene: Scene) -> None:
    every: models.ApproachOptions = {
        "from": {"x": -0.2, "y": -1.0, "z": 0.0},
        "frame": "source",
        "instance_id": None,
        "max_distance_m": 2.0,
        "max_poses": 2,
        "min_confidence": 0.0,
        "min_distance_m": 0.5,
        "query": MUG,
        "unseen_region": None,
    }
    assert set(every) == set(models.ApproachOptions.__annotations__), "the API has other fields by now: ask with them"
    assert set(ROBOT) == set(models.Robot.__annotations__), "the API has other fields by now: ask with them"
    found = scene.approach(ROBOT, **every)
    assert (found.status, found.answer_status, len(found.poses)) == ("found", "grounded", 2)
    assert found.in_frame is not None
    assert len(found.in_frame.poses) == 2


def test_a_robot_is_told_where_to_stand(client: Client, scene: Scene) -> None:
    found = scene.approach(ROBOT, query=MUG, min_confidence=0, start=np.array([-0.2, -1.0]))
    assert found.answer_id is not None
    assert client.answer(found.answer_id).answer.predicted_id == MUG_ID
    assert found.target is not None
    assert (found.target.id, found.target.support.on, found.target.support.id) == (MUG_ID, "instance", 26)
    best, picture = found.poses[0], floor(scene, ROBOT["height_m"])
    assert best.reach_m <= 0.8
    assert best.path_m is not None
    assert best.path_m > 0.3
    assert best.path[-1] == pytest.approx(best.position[:2])
    # White under every corner of the way, black where the table is.
    assert [picture(x, y) for x, y in best.path] == [254] * len(best.path)
    assert picture(*found.target.box.center[:2]) == 0

    assert scene.approach(ROBOT, instance_id=MUG_ID).poses[0].path == []
    short = scene.approach({**ROBOT, "reach_m": 0.01}, instance_id=MUG_ID)
    assert (short.status, short.failed, short.poses) == ("none_possible", "out_of_reach", [])
    assert scene.approach(ROBOT, query="the spaceship").status == "not_grounded"
    with pytest.raises(UnigroundError, match="one of instance_id, query and unseen_region is required"):
        scene.approach(ROBOT)


def floor(scene: Scene, height_m: float) -> Callable[[float, float], int]:
    """The shade of the floor's picture at a place of the scene."""
    known = scene.floor(height_m)
    picture = Image.open(io.BytesIO(scene.floor_picture(height_m)))
    assert (picture.size, picture.mode) == ((known.width, known.height), "L")
    shades = np.asarray(picture)
    left, lower, _ = known.origin
    return lambda x, y: int(shades[known.height - 1 - int((y - lower) / known.resolution), int((x - left) / known.resolution)])


def test_a_scene_is_placed_in_a_map(scene: Scene) -> None:
    """A quarter turn to the left: the scene's X is the map's Y."""
    with pytest.raises(UnigroundError) as nowhere:
        scene.ask(MUG, frame="map")
    assert nowhere.value.code == "no_map"
    half = np.sqrt(0.5)
    try:
        scene.place_in_map((0, 0, half, half), np.array([10, 5, 0.5]), "map")
        assert (scene.info.map_frame_id, scene.name) == ("map", "living room")
        answer = scene.ask(MUG, frame="map")
        assert answer.in_frame is not None
        assert answer.in_frame.frame_id == "map"
        x, y, z = answer.targets[0].oriented_box.center
        assert answer.in_frame.boxes[0].center == pytest.approx([10 - y, 5 + x, z + 0.5])
        here = scene.approach(ROBOT, instance_id=MUG_ID, start=(-0.2, -1.0))
        there = scene.approach(ROBOT, instance_id=MUG_ID, start=(11.0, 4.8), frame="map")
        assert there.poses == here.poses
        assert there.in_frame is not None
        assert there.in_frame.poses[0].path[0] == pytest.approx(
            [10 - here.poses[0].path[0][1], 5 + here.poses[0].path[0][0], 0.5], abs=1e-3
        )
        # Placed anew, the map is still called what it was.
        assert scene.place_in_map([0, 0, 0, 1], [0, 0, 0]).info.map_frame_id == "map"
    finally:
        scene._client.call("PATCH", f"/v1/scenes/{scene.id}", body={"scene_to_map": None, "map_frame_id": None})
        scene.refresh()
    assert scene.info.scene_to_map is None


def test_a_scene_is_a_graph(scene: Scene) -> None:
    graph = scene.graph()
    assert {node.kind for node in graph.nodes} >= {"thing", "structure"}
    assert (f"i{MUG_ID}", "on", "i26") in {(edge.from_, edge.relation, edge.to) for edge in graph.edges}
    around = scene.graph(around=MUG_ID)
    assert {f"i{MUG_ID}", "i26"} <= {node.id for node in around.nodes}
    assert len(around.nodes) < len(graph.nodes) <= len(scene.graph("all").nodes)
    text = scene.graph_text(around=MUG_ID)
    assert "on [i26] grey coffee table" in text
    assert len(text) < len(scene.graph_text())


def test_a_scene_is_a_file_for_other_programs(scene: Scene, tmp_path: Path) -> None:
    begins = {"glb": b"glTF", "usdz": b"PK", "ply": b"ply\n", "json": b"{"}
    for kind, magic in begins.items():
        file = tmp_path / f"room.{kind}"
        content = scene.export(kind, file, points=1000)
        assert content.startswith(magic)
        assert file.read_bytes() == content
    assert b"element vertex 1000\n" in scene.export("ply", points=1000)
    with pytest.raises(UnigroundError) as unknown:
        scene.export("fbx")
    assert unknown.value.code == "invalid_request"


def test_a_question_with_a_key_is_answered_once(client: Client, scene: Scene) -> None:
    first = scene.ask(MUG, idempotency_key="once")
    assert scene.ask(MUG, idempotency_key="once") == first
    assert scene.ask(MUG).id != scene.ask(MUG).id
    with pytest.raises(UnigroundError) as other:
        scene.ask("the sofa", idempotency_key="once")
    assert (other.value.status, other.value.code) == (422, "idempotency_key_reused")


def test_several_things_and_none(scene: Scene) -> None:
    mugs = scene.ask("how many mugs are there", min_confidence=0)
    assert mugs.count == len(mugs.targets) == len(mugs.boxes()) >= 3
    nothing = scene.ask("the spaceship")
    assert (nothing.status, nothing.no_match_reason, nothing.box, nothing.name) == ("no_match", "not_recognised", None, None)
    assert nothing.boxes().shape == (0, 7)
    assert str(nothing).startswith("the spaceship: no_match. ")


def test_pictures_are_pictures(scene: Scene) -> None:
    answer = scene.ask("the orange stool")
    assert answer.answer.predicted_id is not None
    assert len(scene.instance(answer.answer.predicted_id).views) > 0
    frame = scene.photograph(answer.answer.predicted_id)
    crop = scene.photograph(answer.answer.predicted_id, crop=True)
    for picture in (scene.picture(answer), frame, crop):
        assert picture.startswith(b"\xff\xd8")
    assert frame != crop


def test_what_a_scene_consists_of(client: Client, scene: Scene) -> None:
    things = scene.instances()
    assert len(things) > 50
    assert len(scene.instances("all")) >= len(things)
    rows = table(things)
    assert list(rows.columns[:3]) == ["id", "level", "name"]
    assert {"floor", "wall"} <= set(rows["structure"].dropna())
    assert scene.shortlist("the red chair", top_k=2).candidates[0].rank == 1
    assert scene.report().parse_version == scene.info.parse_version
    assert scene.info.import_ is not None
    assert scene.info.import_.frames == 30
    assert client.scene(scene.id).name == "living room"
    assert scene.id in [other.id for other in client.scenes()]


def test_people_correct_what_was_found(scene: Scene) -> None:
    mug = scene.ask("the mug on the coffee table").answer.predicted_id
    assert mug is not None
    said = scene.correct(kind="rename", instance_id=mug, name="samovar")
    try:
        assert scene.instance(mug).given_name == "samovar"
        assert scene.ask("the samovar").answer.predicted_id == mug
        assert scene.corrections()[0].id == said.id
    finally:
        assert scene.undo(said.id).undone_at is not None
    assert scene.instance(mug).given_name is None


def test_a_list_of_questions_is_asked_in_order_and_only_once(client: Client, scene: Scene) -> None:
    results = scene.ask_all(QUESTIONS, top_k=2, reasoner="builtin")
    assert [result.query for result in results] == QUESTIONS
    rows = table(results)
    assert list(rows["status"]) == [result.status for result in results]
    assert rows["predicted_id"][0] == 80
    again = scene.ask_all(QUESTIONS, top_k=2, reasoner="builtin")
    assert [result.answer_id for result in again] == [result.answer_id for result in results]

    batch = client.batch([{"query": "the sofa", "scene_id": scene.id}, {"query": "the desk", "scene_id": "no"}], label="mixed")
    [sofa, desk] = batch.results()
    assert sofa.answer is not None
    assert desk.error is not None
    assert (desk.status, desk.error.code) == ("failed", "scene_not_found")
    assert table([sofa, desk])["error_code"][1] == "scene_not_found"
    assert batch.refresh().info.state == "succeeded"
    assert batch.id in [other.id for other in client.batches()]
    kept = next(client.answers(batch_id=batch.id))
    assert kept == client.answer(kept.id) == sofa.answer


def test_a_list_that_was_paused_goes_on_when_it_is_asked_again(client: Client, scene: Scene) -> None:
    questions = [f"the {colour} chair" for colour in ("red", "blue", "green", "white")] * 500
    batch = client.batch(questions, scene=scene, label="paused", concurrency=1).pause()
    assert batch.info.state == "paused"
    with pytest.raises(UnigroundError, match="paused after") as paused:
        list(batch.results())
    assert paused.value.code == "batch_paused"
    again = client.batch(questions, scene=scene, label="paused", concurrency=1)
    assert (again.id, again.info.state) == (batch.id, "running")
    assert again.cancel().info.state == "cancelled"


def test_a_list_that_was_cut_off_goes_on(client: Client, scene: Scene, tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    batch = client.batch(QUESTIONS, scene=scene, label="cut off")
    assert batch.save(file) == len(QUESTIONS)
    whole = file.read_bytes()
    lines = whole.splitlines(keepends=True)
    file.write_bytes(b"".join(lines[:2]) + lines[2][:10])
    assert client.batch(batch.id).save(file) == len(QUESTIONS)
    assert file.read_bytes() == whole
    assert [json.loads(line)["item"] for line in lines] == [0, 1, 2, 3]
    assert [result.item for result in batch.results(start=3)] == [3]


def test_a_list_outlives_the_server(few_frames: Path, tmp_path: Path) -> None:
    """Stopped while results are read, and started again at another address: the same calls go on with the same batch."""
    questions = [f"the {colour} chair" for colour in ("red", "blue", "green", "white")] * 500
    with running(tmp_path / "data") as url:
        scene = Client(url, KEY).upload(few_frames, idempotency_key="once").wait()
        batch = Client(url, KEY).batch(questions, scene=scene, concurrency=1)
        first = next(batch.results())
    with running(tmp_path / "data") as url:
        client = Client(url, KEY)
        again = client.batch(questions, scene=client.upload(few_frames, idempotency_key="once"), concurrency=1)
        assert again.id == batch.id
        results = list(again.results())
    assert len(results) == len(questions)
    assert results[0] == first


def test_a_batch_is_known_by_its_id(client: Client, scene: Scene) -> None:
    batch = client.batch(["the sofa"], scene=scene.id[:-1], label="by id")
    assert next(batch.results()).scene_id == scene.id
    assert client.batch(batch.id).info.label == "by id"
    with pytest.deprecated_call():
        assert client.get_batch(batch.id).id == batch.id
    with pytest.raises(ValueError, match="the id of a batch or a list of questions, not 'the sofa'"):
        client.batch("the sofa", scene=scene)
    with pytest.raises(UnigroundError) as unknown:
        client.batch("01a204e5-ec2d-7755-9640-869af6cd5b99")
    assert unknown.value.code == "batch_not_found"


def test_a_scene_is_known_by_its_name(client: Client, scene: Scene, server: str) -> None:
    names = ["Attic", "attic", "attic upstairs", "cellar"]
    made = [client.upload(SAMPLE, name=name, parse=False) for name in names]
    try:
        for wanted, name in [("Attic", "Attic"), ("attic", "attic"), ("ATTIC U", "attic upstairs"), ("cel", "cellar")]:
            assert client.scene(wanted).name == name
        assert client.scene(made[3].id[:-1]).id == made[3].id
        assert client.scene(made[3].id.upper()).id == made[3].id
        with pytest.raises(UnigroundError) as several:
            client.scene("att")
        assert several.value.code == "scene_ambiguous"
        assert all(f"{one.id}  {one.name} (uploaded)" in several.value.detail for one in made[:3])
        assert made[3].id not in several.value.detail
        for missing in ("kitchen", "", "../stats"):
            with pytest.raises(UnigroundError, match=r"Scenes of this server:(.|\n)*cellar") as none:
                client.scene(missing)
            assert none.value.code == "scene_not_found"
        with pytest.raises(UnigroundError, match="scene_not_found"):
            client.scene("01a204e5-ec2d-7755-9640-869af6cd5b99")
    finally:
        for one in made:
            one.delete()


def test_a_misspelled_parameter_suggests_the_near_one(client: Client, scene: Scene) -> None:
    with pytest.raises(UnigroundError) as wrong:
        scene.ask("the mug", topk=3)  # type: ignore[call-arg]
    assert wrong.value.detail == "/topk: unknown field `topk`, did you mean `top_k`?"
    assert wrong.value.errors == [{"pointer": "/topk", "detail": "unknown field `topk`, did you mean `top_k`?"}]
    [failed] = client.batch([{"query": "the mug", "top_n": 3, "scene_id": scene.id}], label="misspelled").results()
    assert failed.error is not None
    assert "did you mean `top_k`?" in failed.error.detail


def test_an_upload_with_a_key_is_made_once(client: Client, scene: Scene, tmp_path: Path) -> None:
    assert client.upload(SAMPLE, name="living room", idempotency_key="sample").id == scene.id
    assert client.upload(SAMPLE, name="living room").id != scene.id


def test_an_error_says_what_is_wrong(client: Client, scene: Scene, server: str, tmp_path: Path) -> None:
    with pytest.raises(UnigroundError) as wrong:
        scene.ask("the mug", top_k=0)
    assert (wrong.value.code, wrong.value.status, wrong.value.title) == ("invalid_request", 422, "Unprocessable Entity")
    assert wrong.value.errors == [{"pointer": "/top_k", "detail": "must be 1 to 100"}]
    assert wrong.value.request_id
    assert str(wrong.value) == "/top_k: must be 1 to 100 (invalid_request)"

    with pytest.raises(UnigroundError) as unknown:
        Client(server, "ug_wrong").upload(SAMPLE)
    assert (unknown.value.code, unknown.value.status) == ("unauthorized", 401)

    stored = client.upload(SAMPLE, parse=False)
    with pytest.raises(UnigroundError, match="was only stored"):
        stored.wait()
    with pytest.raises(UnigroundError) as unparsed:
        stored.ask("the mug")
    assert unparsed.value.code == "scene_not_ready"

    with zipfile.ZipFile(tmp_path / "empty.zip", "w") as archive:
        archive.writestr("readme.txt", "nothing here")
    with pytest.raises(UnigroundError) as layout:
        client.upload(tmp_path / "empty.zip")
    assert layout.value.code == "unknown_layout"


def test_a_parse_that_fails_says_why(client: Client, tmp_path: Path) -> None:
    """A flat cloud alone: nobody can tell which of its sides is up."""
    points = "".join(f"{i % 20 * 0.05} {i // 20 * 0.05} {i % 7 * 0.001} 90 90 90\n" for i in range(400))
    properties = [*(f"property float {axis}\n" for axis in "xyz"), *(f"property uchar {colour}\n" for colour in ("red", "green", "blue"))]
    head = "ply\nformat ascii 1.0\nelement vertex 400\n" + "".join(properties) + "end_header\n"
    with zipfile.ZipFile(tmp_path / "wrong.zip", "w") as wrong:
        wrong.writestr("cloud.ply", head + points)
    scene = client.upload(tmp_path / "wrong.zip")
    with pytest.raises(UnigroundError) as failed:
        scene.wait(timeout_s=60)
    assert (failed.value.code, failed.value.status) == ("up_unknown", None)
    assert failed.value.job_id == scene.info.job_id


def test_settings_come_from_arguments_or_variables(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stats = Client().call("GET", "/v1/stats")
    assert "version" in stats
    assert KEY not in repr(Client())
    monkeypatch.delenv("UNIGROUND_API_KEY")
    with pytest.raises(UnigroundError) as unknown:
        Client(server).call("GET", "/v1/stats")
    assert unknown.value.code == "unauthorized"
    with pytest.raises(ValueError, match="is not the address of a server"):
        Client("127.0.0.1")


def test_the_asynchronous_client_does_the_same(scene: Scene, tmp_path: Path) -> None:
    async def ask() -> None:
        async with AsyncClient() as client:
            same = await client.upload(SAMPLE, name="living room", idempotency_key="sample")
            await same.wait()
            assert same.id == scene.id
            answers = await asyncio.gather(*(same.ask(question) for question in QUESTIONS))
            assert [answer.query for answer in answers] == QUESTIONS
            found = await same.approach(ROBOT, instance_id=MUG_ID, start=(-0.2, -1.0))
            assert found == scene.approach(ROBOT, instance_id=MUG_ID, start=(-0.2, -1.0))
            assert await same.export("ply", tmp_path / "room.ply", points=1000) == (tmp_path / "room.ply").read_bytes()
            assert await same.graph_text() == scene.graph_text()
            batch = await client.batch(QUESTIONS, scene=same, label="async")
            assert [result.item async for result in batch.results()] == [0, 1, 2, 3]
            assert [other.id async for other in client.scenes() if other.id == scene.id] == [scene.id]
            with pytest.raises(UnigroundError, match="scene_not_found"):
                await client.scene("01a204e5-ec2d-7755-9640-869af6cd5b99")

    asyncio.run(ask())
