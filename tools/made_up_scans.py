"""A synthetic room, ray-cast and written as folders in the layouts of the data sets, for tests of the converters.

The room is 4 x 3 x 2.5 m. Its objects are parallel to the walls in the room's own world. Each data set has another world, rotated and shifted, so
that a box or pose in the wrong world is noticed.
"""
import array
import json
import math
import struct
import zlib

from scan_files import moved, product
from sens import grey_png

WALLS = ([0.0, 0.0, 0.0], [4.0, 3.0, 2.5])
# Name, corners, color.
THINGS = [("couch", [0.3, 0.2, 0.0], [2.3, 1.1, 0.8], (180, 30, 30)), ("cabinet", [3.3, 1.0, 0.0], [3.9, 2.0, 1.5], (30, 30, 180)),
          ("stool", [1.0, 2.0, 0.0], [1.5, 2.4, 0.5], (40, 160, 60))]
WIDTH, HEIGHT, FOCAL = 128, 96, 70.0
CAMERAS = [((x, y, 1.7), (tx, ty, 0.4)) for x, y, tx, ty in (
    (3.0, 2.5, 1.3, 0.6), (2.0, 2.6, 1.2, 0.6), (0.5, 2.7, 1.4, 0.6), (3.0, 2.6, 1.2, 2.2), (2.6, 1.6, 1.2, 2.2), (0.4, 1.6, 1.3, 2.2),
    (1.2, 1.4, 3.6, 1.5), (2.4, 2.7, 3.6, 1.5), (2.5, 0.4, 3.6, 1.5), (1.9, 1.6, 0.6, 0.5), (2.6, 1.9, 1.8, 0.6), (0.4, 2.6, 3.5, 1.4))]


def rigid(yaw_deg, shift):
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    return [[c, -s, 0, shift[0]], [s, c, 0, shift[1]], [0, 0, 1, shift[2]], [0, 0, 0, 1]]


def inverse(m):
    back = [[m[j][i] for j in range(3)] for i in range(3)]
    return [row + [-sum(a * m[k][3] for k, a in enumerate(row))] for row in back] + [[0, 0, 0, 1]]


def unit(v):
    length = math.sqrt(sum(a * a for a in v))
    return [a / length for a in v]


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def camera_at(eye, target, roll_deg=0.0):
    """Returns the camera-to-room pose in OpenCV's axes: x right, y down, z forward."""
    forward = unit([t - e for t, e in zip(target, eye)])
    right = unit(cross(forward, [0, 0, 1]))
    down = cross(forward, right)
    columns = list(zip(right, down, forward, eye))
    return product([list(row) for row in columns] + [[0, 0, 0, 1]], rigid(roll_deg, [0, 0, 0]))


def hit(eye, ray):
    """Returns the distance along the ray to the first surface, and its color."""
    best, color = math.inf, (200, 200, 190)
    for low, high, own in [(*WALLS, None)] + [thing[1:] for thing in THINGS]:
        near, far = -math.inf, math.inf
        for e, r, a, b in zip(eye, ray, low, high):
            if abs(r) < 1e-12:
                near, far = (near, far) if a <= e <= b else (math.inf, -math.inf)
                continue
            t = sorted(((a - e) / r, (b - e) / r))
            near, far = max(near, t[0]), min(far, t[1])
        reached = far if own is None else near
        if near <= far and 0 < reached < best:
            best, color = reached, own or (200, 200, 190)
    return best, color


def png(width, height, kind, rows):
    """Encodes an 8-bit PNG: kind 2 is color, 0 is gray."""
    def chunk(name, body):
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
    return (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0))
            + chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row for row in rows))) + chunk(b"IEND", b""))


def shots(roll_deg=0.0):
    """Yields for each camera its pose in the room, its image as PNG, and its depth in millimeters as little-endian bytes."""
    for eye, target in CAMERAS:
        pose = camera_at(eye, target, roll_deg)
        depth, rows = array.array("H"), []
        for v in range(HEIGHT):
            row = bytearray()
            for u in range(WIDTH):
                own = [(u - (WIDTH - 1) / 2) / FOCAL, (v - (HEIGHT - 1) / 2) / FOCAL, 1.0]
                far, color = hit(eye, [sum(pose[i][k] * own[k] for k in range(3)) for i in range(3)])
                depth.append(round(1000 * far))
                row += bytes(color)
            rows.append(bytes(row))
        yield pose, png(WIDTH, HEIGHT, 2, rows), depth.tobytes()


def surface(low, high, step, inside_out=False):
    """Returns points on the faces of a box; of a room all but its ceiling."""
    axes = [[a + (b - a) * i / max(1, round((b - a) / step)) for i in range(max(1, round((b - a) / step)) + 1)] for a, b in zip(low, high)]
    for k in range(3):
        for end in (axes[k][0],) if inside_out and k == 2 else (axes[k][0], axes[k][-1]):
            others = [axes[i] for i in range(3) if i != k]
            for a in others[0]:
                for b in others[1]:
                    yield [[end, a, b], [a, end, b], [a, b, end]][k]


def mesh(world, ascii_text=False):
    """Returns the room's points in a world, as PLY, and the index in THINGS of each (-1 for the walls)."""
    points = [(p, (200, 200, 190), -1) for p in surface(*WALLS, 0.04, True)]
    for place, (_, low, high, color) in enumerate(THINGS):
        points += [(p, color, place) for p in surface(low, high, 0.03)]
    head = (f"ply\nformat {'ascii' if ascii_text else 'binary_little_endian'} 1.0\ncomment made up\nelement vertex {len(points)}\n"
            + "".join(f"property float {c}\n" for c in "xyz") + "".join(f"property uchar {c}\n" for c in ("red", "green", "blue", "alpha"))
            + "element face 0\nproperty list uchar int vertex_indices\nend_header\n").encode()
    placed = [(moved(world, p), color) for p, color, _ in points]
    if ascii_text:
        body = "".join(" ".join(f"{v:.5f}" for v in p) + f" {c[0]} {c[1]} {c[2]} 255\n" for p, c in placed).encode()
    else:
        body = b"".join(struct.pack("<3f4B", *p, *c, 255) for p, c in placed)
    return head + body, [place for _, _, place in points]


def text_of(matrix):
    return "\n".join(" ".join(repr(v) for v in row) for row in matrix) + "\n"


def rotation_vector(m):
    """Returns axis times angle of a rotation matrix."""
    angle = math.acos(max(-1.0, min(1.0, (m[0][0] + m[1][1] + m[2][2] - 1) / 2)))
    if angle < 1e-9:
        return [0.0, 0.0, 0.0]
    return [angle / (2 * math.sin(angle)) * v for v in (m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1])]


def arkitscenes(folder, video, world, frames, raw):
    """Writes a scan of 3dod (10 images per second in VIDEO_frames/) or of raw (60 per second, poses for a sixth of them)."""
    scan = folder / video
    inner = scan if raw else scan / f"{video}_frames"
    for sub in ("lowres_wide", "lowres_depth", "confidence", "lowres_wide_intrinsics"):
        (inner / sub).mkdir(parents=True)
    lines, sure = [], png(WIDTH, HEIGHT, 0, [b"\2" * WIDTH] * HEIGHT)
    for i, (pose, color, depth) in enumerate(frames):
        second = 6845.106 + 0.1 * i
        to_camera = inverse(product(world, pose))
        turn = rotation_vector(to_camera)
        lines.append(" ".join(f"{v:.9f}" for v in [second + 0.0004] + turn + [row[3] for row in to_camera[:3]]))
        for late in (0.0, 0.017) if raw else (0.0,):
            name = f"{video}_{second + late:.3f}"
            (inner / f"lowres_wide/{name}.png").write_bytes(color)
            (inner / f"lowres_depth/{name}.png").write_bytes(grey_png(WIDTH, HEIGHT, depth))
            (inner / f"confidence/{name}.png").write_bytes(sure)
            camera = f"{WIDTH} {HEIGHT} {FOCAL} {FOCAL} {(WIDTH - 1) / 2} {(HEIGHT - 1) / 2}"
            # Some cameras' timestamps differ by a millisecond.
            (inner / f"lowres_wide_intrinsics/{video}_{second + late + 0.001 * (i % 2):.3f}.pincam").write_text(camera)
    (inner / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    (scan / f"{video}_3dod_mesh.ply").write_bytes(mesh(world, ascii_text=not raw)[0])
    records = []
    for i, (name, low, high, _) in enumerate(THINGS):
        center = moved(world, [(a + b) / 2 for a, b in zip(low, high)])
        rows = [[world[k][axis] for k in range(3)] for axis in range(3)]
        # The order and direction of the axes differ from box to box.
        order = [(0, 1, 2), (1, 0, 2), (2, 0, 1)][i]
        axes = [value * (-1 if j == 1 else 1) for j, axis in enumerate(order) for value in rows[axis]]
        box = {"centroid": center, "axesLengths": [high[axis] - low[axis] for axis in order], "normalizedAxes": axes}
        records.append({"uid": f"made-up-{i}", "label": "tv_monitor" if name == "stool" else name, "objectId": 1,
                        "segments": {"obb": {"centroid": [0, 0, 0], "axesLengths": [1, 1, 1], "normalizedAxes": axes}, "obbAligned": box}})
    (scan / f"{video}_3dod_annotation.json").write_text(json.dumps({"data": records, "skipped": False}))
    return scan


def scannet(folder, scene, world, frames):
    """Writes a ScanNet scene with its .sens file and without the exported files; the last frame has a lost pose."""
    scan = folder / scene
    scan.mkdir(parents=True)
    data, places = mesh(world)
    (scan / f"{scene}_vh_clean_2.ply").write_bytes(data)
    segments = [11 * (place + 1) for place in places]
    (scan / f"{scene}_vh_clean_2.0.010000.segs.json").write_text(json.dumps({"segIndices": segments}))
    groups = [{"id": i, "objectId": i, "segments": [11 * (i + 1)], "label": name} for i, (name, *_) in enumerate(THINGS)]
    (scan / f"{scene}.aggregation.json").write_text(json.dumps({"segGroups": groups}))
    back = inverse(world)
    (scan / f"{scene}.txt").write_text("numColorFrames = 12\naxisAlignment = " + " ".join(repr(v) for row in back for v in row) + "\n")
    camera = [FOCAL, 0, (WIDTH - 1) / 2, 0, 0, FOCAL, (HEIGHT - 1) / 2, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    one = [float(i == j) for i in range(4) for j in range(4)]
    sens = struct.pack("<IQ", 4, 7) + b"made up" + struct.pack("<64f", *camera, *one, *camera, *one)
    sens += struct.pack("<iiIIIIfQ", 1, 1, WIDTH, HEIGHT, WIDTH, HEIGHT, 1000.0, len(frames) + 1)
    for pose, color, depth in frames + [(None, *frames[0][1:])]:
        numbers = [-math.inf] * 16 if pose is None else [v for row in product(world, pose) for v in row]
        packed = zlib.compress(depth)
        sens += struct.pack("<16f4Q", *numbers, 0, 0, len(color), len(packed)) + color + packed
    (scan / f"{scene}.sens").write_bytes(sens)
    return scan


def three_r_scan(folder, scan_id, world, frames):
    """Writes an unpacked 3RScan scan. The phone is held upright, so its images are rotated."""
    scan = folder / scan_id
    (scan / "sequence").mkdir(parents=True)
    matrix = " ".join(map(str, [FOCAL, 0, (WIDTH - 1) / 2, 0, 0, FOCAL, (HEIGHT - 1) / 2, 0, 0, 0, 1, 0, 0, 0, 0, 1]))
    info = f"m_versionNumber = 4\nm_colorWidth = {WIDTH}\nm_colorHeight = {HEIGHT}\nm_depthWidth = {WIDTH}\nm_depthHeight = {HEIGHT}\n"
    info += f"m_depthShift = 1000\nm_calibrationColorIntrinsic = {matrix}\nm_calibrationDepthIntrinsic = {matrix}\n"
    (scan / "sequence/_info.txt").write_text(info)
    for i, (pose, color, depth) in enumerate(frames):
        (scan / f"sequence/frame-{i:06}.color.png").write_bytes(color)
        values = array.array("H", depth)
        values.byteswap()
        (scan / f"sequence/frame-{i:06}.depth.pgm").write_bytes(f"P5\n{WIDTH} {HEIGHT}\n65535\n".encode() + values.tobytes())
        (scan / f"sequence/frame-{i:06}.pose.txt").write_text(text_of(product(world, pose)))
    return scan
