"""Ask a uniground server where things are in a scanned room.

from uniground import Client

scene = Client().upload("living_room.zip").wait()
print(scene.ask("the mug on the coffee table"))
"""

from uniground import models
from uniground._async import AsyncBatch, AsyncClient, AsyncScene
from uniground._local import Server, serve
from uniground._scan import Cloud, Scan
from uniground._sync import Batch, Client, Scene
from uniground._values import Vector, boxes, row, table
from uniground._wire import UnigroundError

__all__ = [
    "AsyncBatch",
    "AsyncClient",
    "AsyncScene",
    "Batch",
    "Client",
    "Cloud",
    "Scan",
    "Scene",
    "Server",
    "UnigroundError",
    "Vector",
    "boxes",
    "models",
    "row",
    "serve",
    "table",
]
