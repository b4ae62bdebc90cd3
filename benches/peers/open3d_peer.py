"""Open3D's side of the comparison. `benches/peers.rs` starts it and uses the protocol of `protocol.py`."""

import platform

import numpy as np
import open3d as o3d
from protocol import serve, timed

K_NEAREST = 30


class Open3d:
    versions = f"Open3D {o3d.__version__}, numpy {np.__version__}, Python {platform.python_version()}"

    def read(self, path):
        """Reads the cloud that every later command uses."""
        ms, self.cloud = timed(lambda: o3d.io.read_point_cloud(path))
        return ms, f"{len(self.cloud.points)} points"

    def voxels(self, size_m):
        ms, means = timed(lambda: self.cloud.voxel_down_sample(float(size_m)))
        return ms, f"{len(means.points)} voxels"

    def normals(self):
        """Computes one normal per point."""
        return self._normals(o3d.geometry.PointCloud(self.cloud))

    def voxel_normals(self, size_m):
        """Computes one normal per voxel; the means are computed before the clock starts."""
        return self._normals(self.cloud.voxel_down_sample(float(size_m)))

    def _normals(self, cloud):
        ms, _ = timed(lambda: cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(K_NEAREST)))
        return ms, f"{len(cloud.normals)} normals"

    def camera(self, width, height, fx, fy, cx, cy, ceiling_m, *world_to_camera):
        """Sets the camera of the renders and removes points above the ceiling. Not timed."""
        self.size = int(width), int(height)
        self.intrinsic = np.array([[float(fx), 0, float(cx)], [0, float(fy), float(cy)], [0, 0, 1]])
        self.extrinsic = np.array(world_to_camera, dtype=float).reshape(4, 4)
        below = np.flatnonzero(np.asarray(self.cloud.points)[:, 2] <= float(ceiling_m))
        self.shown = o3d.t.geometry.PointCloud.from_legacy(self.cloud.select_by_index(below))
        return 0, f"{len(below)} points"

    def project(self):
        """Renders one pixel per point."""
        width, height = self.size
        farthest_m = 1000.0
        intrinsic, extrinsic = o3d.core.Tensor(self.intrinsic), o3d.core.Tensor(self.extrinsic)
        ms, image = timed(lambda: self.shown.project_to_rgbd_image(width, height, intrinsic, extrinsic, 1.0, farthest_m))
        return ms, f"{np.count_nonzero(image.depth.as_tensor().numpy())} pixels"

    def squares(self, side_m):
        """Builds the mesh to cast rays at: per point a square that faces the camera, as splats do. Returns the time for its tree."""
        points, half = self.shown.point.positions.numpy(), float(side_m) / 2
        right, down = self.extrinsic[0, :3] * half, self.extrinsic[1, :3] * half
        corners = np.stack([-right - down, right - down, right + down, down - right])
        vertices = (points[:, None] + corners[None]).reshape(-1, 3).astype(np.float32)
        first = np.arange(len(points), dtype=np.uint32)[:, None] * 4
        triangles = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]], axis=1).reshape(-1, 3).astype(np.uint32)
        self.scene = o3d.t.geometry.RaycastingScene()
        rays = self.scene.create_rays_pinhole(self.intrinsic, self.extrinsic, *self.size)
        # The first rays build the tree.
        ms, _ = timed(lambda: (self.scene.add_triangles(vertices, triangles), self.scene.cast_rays(rays[:1, :1])))
        self.rays, self.colours = rays, (self.shown.point.colors.numpy() * 255).astype(np.uint8)
        return ms, f"{len(triangles)} triangles"

    def cast(self):
        """Renders with one ray per pixel: the color of the square that is hit."""

        def picture():
            hit = self.scene.cast_rays(self.rays)["primitive_ids"].numpy()
            seen = hit != o3d.t.geometry.RaycastingScene.INVALID_ID
            image = np.full((*hit.shape, 3), 250, np.uint8)
            image[seen] = self.colours[hit[seen] // 2]
            return image, seen

        ms, (_, seen) = timed(picture)
        return ms, f"{np.count_nonzero(seen)} pixels"


o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
serve(Open3d())
