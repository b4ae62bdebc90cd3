"""Clouds and boxes in Open3D and Rerun: `pip install 'uniground[open3d]'`, `pip install 'uniground[rerun]'`.

Both take a cloud, as `scene.cloud()` gives it, and what is to be boxed: answers, targets, candidates or instances.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from uniground._scan import Cloud
from uniground._values import wanted

GREEN, BLUE = (0, 150, 60), (40, 90, 200)


def open3d_geometries(cloud: Cloud, *of: Any) -> list[Any]:
    """A point cloud and oriented boxes, for `open3d.visualization.draw_geometries` and for computing with."""
    open3d = wanted("open3d")
    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points.astype(float)))
    points.colors = open3d.utility.Vector3dVector(cloud.colors / 255)
    geometries = [points]
    for _, box, color in _boxes(of):
        frame = open3d.geometry.OrientedBoundingBox(np.array(box.center), box.rotation(), np.array(box.size))
        frame.color = np.array(color) / 255
        geometries.append(frame)
    return geometries


def log_rerun(cloud: Cloud, *of: Any, path: str = "scene") -> None:
    """Logs the cloud and the boxes, with their names, to Rerun's current recording, below `path`."""
    rerun = wanted("rerun")
    rerun.log(path, rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    rerun.log(f"{path}/cloud", rerun.Points3D(cloud.points, colors=cloud.colors), static=True)
    found = list(_boxes(of))
    boxes = rerun.Boxes3D(
        centers=[box.center for _, box, _ in found],
        half_sizes=[np.array(box.size) / 2 for _, box, _ in found],
        rotation_axis_angles=[rerun.RotationAxisAngle((0, 0, 1), radians=float(box.array()[6])) for _, box, _ in found],
        labels=[name for name, _, _ in found],
        colors=[color for _, _, color in found],
    )
    rerun.log(f"{path}/boxes", boxes)


def _boxes(of: tuple[Any, ...]) -> Iterator[tuple[str, Any, tuple[int, int, int]]]:
    """Name, box and colour of each thing; what an answer means is green, all else blue."""
    for one in of:
        if hasattr(one, "targets"):
            yield from ((target.name, target.oriented_box, GREEN) for target in one.targets)
        else:
            yield one.name or str(one.id), getattr(one, "oriented_box", None) or one.box, BLUE
