"""Shared parts of the data set converters: matrices, PLY vertices, and archives that are written completely or not at all."""
import json
import struct
import zipfile
from contextlib import contextmanager

PLY_TYPES = {"char": "b", "int8": "b", "uchar": "B", "uint8": "B", "short": "h", "int16": "h", "ushort": "H", "uint16": "H", "int": "i",
             "int32": "i", "uint": "I", "uint32": "I", "float": "f", "float32": "f", "double": "d", "float64": "d"}
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def need(path, what):
    """Returns the path if it exists; otherwise exits and says what to do."""
    if not path.exists():
        raise SystemExit(f"{path}: missing; {what}")
    return path


def read_json(file):
    try:
        return json.loads(file.read_text())
    except ValueError as error:
        raise SystemExit(f"{file}: not JSON, or cut off: {error}") from None


def numbers_of(file, count):
    try:
        numbers = [float(word) for word in file.read_text().split()]
    except ValueError as error:
        raise SystemExit(f"{file}: {error}") from None
    if len(numbers) != count:
        raise SystemExit(f"{file}: expected {count} numbers, found {len(numbers)}")
    return numbers


def rows(numbers):
    """Returns the 4x4 matrix of 16 numbers, by rows."""
    return [list(numbers[i:i + 4]) for i in range(0, 16, 4)]


def product(a, b):
    return [[sum(a[i][k] * b[k][j] for k in range(len(b))) for j in range(len(b[0]))] for i in range(len(a))]


def moved(m, p):
    return [m[i][0] * p[0] + m[i][1] * p[1] + m[i][2] * p[2] + m[i][3] for i in range(3)]


def read_ply(file):
    """Returns the number of vertices of a PLY and a generator of them: position, and color or None."""
    with file.open("rb") as data:
        kind, count, properties, elements = None, 0, [], []
        for line in iter(data.readline, b"end_header\n"):
            words = line.decode("ascii", "replace").split()
            if not line or len(elements) > 99 or (kind is None and words[:1] not in (["ply"], ["format"], ["comment"])):
                raise SystemExit(f"{file}: not a PLY file, or its header is cut off")
            if words[:1] == ["format"]:
                kind = words[1]
            elif words[:1] == ["element"]:
                elements.append(words[1])
                count = int(words[2]) if words[1] == "vertex" else count
            elif words[:1] == ["property"] and elements == ["vertex"]:
                properties.append((words[-1], PLY_TYPES.get(words[1])))
        start = data.tell()
    names = [name for name, _ in properties]
    if elements[:1] != ["vertex"] or not {"x", "y", "z"} <= set(names) or any(code is None for _, code in properties):
        raise SystemExit(f"{file}: expected vertices with x, y and z as its first element")
    at = [names.index(name) for name in "xyz"]
    color_at = [names.index(name) for name in ("red", "green", "blue")] if "red" in names else None
    def split(values):
        return [values[i] for i in at], [values[i] for i in color_at] if color_at else None
    return count, (split(values) for values in vertex_rows(file, start, kind, count, [code for _, code in properties]))


def vertex_rows(file, start, kind, count, codes):
    with file.open("rb") as data:
        data.seek(start)
        if kind == "ascii":
            for _ in range(count):
                words = data.readline().split()
                if len(words) < len(codes):
                    raise SystemExit(f"{file}: cut off, {count} vertices are announced")
                yield [float(word) for word in words]
            return
        if kind not in BYTE_ORDERS:
            raise SystemExit(f"{file}: PLY of the format {kind!r} is not read")
        row = struct.Struct(BYTE_ORDERS[kind] + "".join(codes))
        for first in range(0, count, 4096):
            block = data.read(row.size * min(4096, count - first))
            if len(block) < row.size * min(4096, count - first):
                raise SystemExit(f"{file}: cut off, {count} vertices are announced")
            yield from row.iter_unpack(block)


class Tally:
    """The points of an object: number, bounds and mean color."""

    def __init__(self):
        self.count, self.low, self.high, self.color = 0, [float("inf")] * 3, [float("-inf")] * 3, [0.0] * 3

    def add(self, point, color):
        self.count += 1
        self.low = [min(a, b) for a, b in zip(self.low, point)]
        self.high = [max(a, b) for a, b in zip(self.high, point)]
        self.color = [a + b for a, b in zip(self.color, color)] if color and self.color else None

    def facts(self):
        facts = {"cloud_points": self.count}
        if self.count and self.color:
            facts["mean_rgb"] = [round(c / self.count, 1) for c in self.color]
        return facts


@contextmanager
def archive(file):
    """A zip file that appears only once it is complete."""
    part = file.with_name(file.name + ".part")
    try:
        with zipfile.ZipFile(part, "w", zipfile.ZIP_STORED, strict_timestamps=False) as out:
            yield out
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)


def write_objects(file, name, objects):
    lines = ",\n".join("  " + json.dumps(o) for o in objects)
    file.write_text(f'{{\n "name": {json.dumps(name)},\n "objects": [\n{lines}\n ]\n}}\n')
