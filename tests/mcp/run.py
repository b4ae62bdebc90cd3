"""Two existing MCP clients against a real server: the Python SDK, over HTTP with the current revision and with the handshake of older ones, and
over stdio; and the official inspector's command line if npx is installed. The SDK checks every answer against the tool's output schema.

    python tests/mcp/run.py --program target/release/uniground
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import json
import shutil
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcp import Client, StdioServerParameters

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "examples/living_room.zip"
INSPECTOR = "@modelcontextprotocol/inspector@2.12.0"
PARTS = ["--masks", "builtin", "--encoder", "builtin"]
ROBOT = {"radius_m": 0.2, "height_m": 1.3, "eye_height_m": 1.2, "reach_m": 0.8}


@contextmanager
def serving(program: str, data: Path) -> Iterator[str]:
    """Serves a folder until the block ends, and yields the address."""
    command = [program, "serve", "--listen", "127.0.0.1:0", "--data-dir", str(data), *PARTS]
    with (data.parent / "log").open("a") as log, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True) as server:
        assert server.stdout is not None
        line = server.stdout.readline()
        assert line.startswith("listening on "), (data.parent / "log").read_text()
        try:
            yield line.split()[-1]
        finally:
            server.terminate()


def get(url: str, body: bytes | None = None) -> dict[str, Any]:
    kind = {"content-type": "application/zip"} if body else {}
    with urllib.request.urlopen(urllib.request.Request(url, body, kind)) as reply:
        return json.load(reply)


async def parsed(url: str) -> str:
    """Returns the sample's scene once it is parsed."""
    scene = get(f"{url}/v1/scenes?name=sample", SAMPLE.read_bytes())["scene"]["id"]
    for _ in range(600):
        if get(f"{url}/v1/scenes/{scene}")["status"] == "ready":
            return scene
        await asyncio.sleep(0.1)
    raise TimeoutError("the sample is not parsed within a minute")


async def asks(client: Client, scene: str) -> None:
    """Calls every tool once, as an agent would."""
    tools = {tool.name: tool for tool in (await client.list_tools()).tools}
    here = {"ground", "list_objects", "get_object", "relations", "approach", "render_view"}
    assert set(tools) == {"list_scenes", "find_in_scenes", *here}, tools

    async def call(name: str, **arguments: object) -> Any:
        result = await client.call_tool(name, arguments)
        assert not result.is_error, result
        assert name == "render_view" or result.structured_content is not None, name
        return result

    scenes = await call("list_scenes")
    assert [one["scene_id"] for one in scenes.structured_content["scenes"]] == [scene]
    answer = await call("ground", scene_id=scene, query="the mug on the coffee table")
    assert answer.structured_content["status"] == "uncertain", answer
    mug = answer.structured_content["targets"][0]["id"]
    anywhere = await call("find_in_scenes", query="the mug on the coffee table")
    assert anywhere.structured_content["found"][0]["scene_id"] == scene, anywhere
    everything = await call("list_objects", scene_id=scene)
    assert any(one["instance_id"] == mug for one in everything.structured_content["objects"])
    shown = await call("get_object", scene_id=scene, instance_id=mug)
    assert base64.b64decode(shown.content[1].data)[:2] == b"\xff\xd8"
    around = await call("relations", scene_id=scene, instance_id=mug)
    assert "on [i" in around.content[0].text, around
    await call("relations", scene_id=scene)
    stand = await call("approach", scene_id=scene, instance_id=mug, robot=ROBOT, **{"from": {"x": 1.95, "y": 0.0}})
    assert stand.structured_content["status"] == "found" and stand.structured_content["poses"][0]["path"], stand
    view = await call("render_view", scene_id=scene, instance_ids=[mug])
    assert base64.b64decode(view.content[0].data)[:2] == b"\xff\xd8"
    wrong = await client.call_tool("ground", {"scene_id": scene, "query": ""})
    assert wrong.is_error and "/query" in wrong.content[0].text, wrong

    resources = (await client.list_resources()).resources
    assert len(resources) == 2 and len((await client.list_resource_templates()).resource_templates) == 2
    for resource in resources:
        json.loads((await client.read_resource(resource.uri)).contents[0].text)


async def sdk(program: str, data: Path) -> None:
    with serving(program, data) as url:
        scene = await parsed(url)
        for mode in ("auto", "legacy"):
            async with Client(f"{url}/mcp", mode=mode) as client:
                await asks(client, scene)
                print(f"Python SDK, HTTP, {mode}: revision {client.protocol_version}")
        inspect(url, scene)
    over_stdio = StdioServerParameters(command=program, args=["mcp", "--data-dir", str(data), *PARTS])
    async with Client(over_stdio) as client:
        await asks(client, scene)
        print(f"Python SDK, stdio: revision {client.protocol_version}")


def inspect(url: str, scene: str) -> None:
    npx = shutil.which("npx")
    if npx is None:
        print("skipped: the inspector, there is no npx")
        return

    def ask(*method: str) -> dict[str, Any]:
        command = [npx, "--yes", INSPECTOR, "--cli", f"{url}/mcp", "--transport", "http", "--method", *method]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr or done.stdout
        return json.loads(done.stdout)

    tools = ask("tools/list")["tools"]
    assert len(tools) == 8, tools
    query = ["--tool-arg", f"scene_id={scene}", "--tool-arg", "query=the mug on the coffee table"]
    answer = ask("tools/call", "--tool-name", "ground", *query)
    assert answer["structuredContent"]["status"] == "uncertain", answer
    print(f"inspector: {len(tools)} tools, and the mug is found")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default=str(ROOT / "target/release/uniground"))
    program = parser.parse_args().program
    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(sdk(str(Path(program).resolve()), Path(folder) / "data"))


if __name__ == "__main__":
    sys.exit(main())
