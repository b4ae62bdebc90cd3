#!/usr/bin/env bash
# Writes the data folder of one version of the service: a small scan, its parse, two answers, jobs. Stored in tests/fixtures/ so that later
# versions can be tested with it.
#   scripts/data-fixture.sh path/to/uniground tests/fixtures/NAME.tar.zst
set -euo pipefail
program=$(realpath "$1") out=$(realpath -m "$2")
work=$(mktemp -d)
trap 'kill "$server" 2>/dev/null || true; rm -rf "$work"' EXIT
cd "$work"

# A floor and a red block on it, seen from four sides: depth and color by one ray per pixel.
python3 - <<'PY'
import math, struct, zipfile, zlib
WIDTH, HEIGHT, F = 96, 72, 80.0
BLOCK = ((-0.4, -0.3, 0.0), (0.4, 0.3, 0.5))

def png(rows, bits, color):
    raw = b"".join(b"\0" + row for row in rows)
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    head = struct.pack(">IIBBBBB", WIDTH, HEIGHT, bits, 2 if color else 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(raw, 9)) + chunk(b"IEND", b"")

def hit(eye, ray):
    """Distance along the ray and what is there."""
    near, far = 0.0, 1e9
    for axis in range(3):
        if abs(ray[axis]) < 1e-9:
            if not BLOCK[0][axis] <= eye[axis] <= BLOCK[1][axis]:
                near = 1e9
            continue
        a, b = sorted(((BLOCK[0][axis] - eye[axis]) / ray[axis], (BLOCK[1][axis] - eye[axis]) / ray[axis]))
        near, far = max(near, a), min(far, b)
    floor = -eye[2] / ray[2] if ray[2] < -1e-9 else 1e9
    if near <= far and near < floor:
        return near, (200, 40, 40)
    return (floor, (190, 190, 185)) if floor < 6 else (0, (0, 0, 0))

with zipfile.ZipFile("scan.zip", "w", zipfile.ZIP_DEFLATED) as scan:
    scan.writestr("intrinsic.txt", f"{F} 0 {WIDTH / 2 - 0.5}\n0 {F} {HEIGHT / 2 - 0.5}\n0 0 1\n")
    for i in range(4):
        turn = math.pi / 2 * i
        eye = (1.8 * math.cos(turn), 1.8 * math.sin(turn), 1.3)
        forward = [-e for e in eye[:2]] + [0.2 - eye[2]]
        length = math.sqrt(sum(v * v for v in forward))
        forward = [v / length for v in forward]
        right = [math.sin(turn) * -1, math.cos(turn), 0.0]
        down = [forward[1] * right[2] - forward[2] * right[1], forward[2] * right[0] - forward[0] * right[2], forward[0] * right[1] - forward[1] * right[0]]
        colors, depths = [], []
        for v in range(HEIGHT):
            color, depth = bytearray(), bytearray()
            for u in range(WIDTH):
                x, y = (u - WIDTH / 2 + 0.5) / F, (v - HEIGHT / 2 + 0.5) / F
                ray = [forward[k] + x * right[k] + y * down[k] for k in range(3)]
                z, rgb = hit(eye, ray)
                color += bytes(rgb)
                depth += struct.pack(">H", round(z * 1000))
            colors.append(bytes(color)), depths.append(bytes(depth))
        scan.writestr(f"color/{i}.png", png(colors, 8, True))
        scan.writestr(f"depth/{i}.png", png(depths, 16, False))
        rows = [[right[k], down[k], forward[k], eye[k]] for k in range(3)] + [[0, 0, 0, 1]]
        scan.writestr(f"pose/{i}.txt", "\n".join(" ".join(f"{v:.6f}" for v in row) for row in rows) + "\n")
PY

UNIGROUND_DATA_DIR=$work/data "$program" serve --listen 127.0.0.1:0 >address 2>log &
server=$!
for _ in $(seq 100); do grep -q '^listening' address && break; sleep 0.1; done
url=$(sed -n 's/^listening on //p' address)
of() { python3 -c "import json, sys; print(json.load(sys.stdin)$1)"; }
created=$(curl -sf -X POST "$url/v1/scenes?name=A+block&up=z" -H 'content-type: application/zip' -H 'idempotency-key: block' --data-binary @scan.zip)
scene=$(of "['scene']['id']" <<<"$created")
curl -sfN "$url/v1/jobs/$(of "['job']['id']" <<<"$created")/events" >/dev/null
for query in "the red coffee table" "the green fridge"; do
    curl -sf -X POST "$url/v1/scenes/$scene/ground" -H 'content-type: application/json' -d "{\"query\": \"$query\"}" >>answers.jsonl
    echo >>answers.jsonl
done
# The responses to compare with: the scene, its instances, the answers.
curl -sf "$url/v1/scenes/$scene" >scene.json
curl -sf "$url/v1/scenes/$scene/instances" >instances.json
kill "$server" && wait "$server" || true
mkdir -p "$(dirname "$out")"
tar --sort=name --owner=0 --group=0 --numeric-owner -c data scan.zip scene.json instances.json answers.jsonl | zstd -19 -q -f -o "$out"
ls -l "$out"
