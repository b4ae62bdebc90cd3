"""Reads ScanNet's .sens file: all frames of a scan with their poses and both cameras, one frame at a time."""
import array
import struct
import sys
import zlib

from scan_files import rows

COLOR_ENDINGS = {1: "png", 2: "jpg"}


def grey_png(width, height, little_endian):
    """Encodes a 16-bit gray PNG from little-endian numbers."""
    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    numbers = array.array("H", little_endian)
    if sys.byteorder == "little":
        numbers.byteswap()
    pixels, line = numbers.tobytes(), 2 * width
    filtered = b"".join(b"\0" + pixels[at:at + line] for at in range(0, line * height, line))
    return (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
            + chunk(b"IDAT", zlib.compress(filtered, 6)) + chunk(b"IEND", b""))


class Sens:
    def __init__(self, file, every):
        self.file, self.every = file, every
        with file.open("rb") as data:
            version, = self.read(data, "I")
            if version != 4:
                raise SystemExit(f"{file}: version {version}, expected 4: is it a .sens file, downloaded to its end?")
            data.seek(self.read(data, "Q")[0], 1)
            color, _, depth, _ = (rows(self.read(data, "16f")) for _ in range(4))
            self.color_codec, self.depth_codec, width, height, self.width, self.height, shift, self.count = self.read(data, "iiIIIIfQ")
            self.start = data.tell()
        if self.color_codec not in COLOR_ENDINGS or self.depth_codec not in (0, 1):
            raise SystemExit(f"{file}: pictures of the codecs {self.color_codec} and {self.depth_codec} are not read")
        if not shift > 0:
            raise SystemExit(f"{file}: a depth shift of {shift}")
        self.ending = COLOR_ENDINGS[self.color_codec]
        self.cameras = {"intrinsics": camera(color, width, height), "depth_intrinsics": camera(depth, self.width, self.height),
                        "depth_scale_m": 1 / shift}

    def read(self, data, kind):
        record = struct.Struct("<" + kind)
        block = data.read(record.size)
        if len(block) < record.size:
            raise SystemExit(f"{self.file}: cut off after {data.tell()} bytes; download it again")
        return record.unpack(block)

    def frames(self):
        """Yields number, bytes of the color image, bytes of the depth image, and camera-to-world pose."""
        with self.file.open("rb") as data:
            data.seek(self.start)
            for number in range(self.count):
                *pose, _, _, color_bytes, depth_bytes = self.read(data, "16f4Q")
                if number % self.every:
                    data.seek(color_bytes + depth_bytes, 1)
                    continue
                color, depth = self.read(data, f"{color_bytes}s")[0], self.read(data, f"{depth_bytes}s")[0]
                try:
                    depth = zlib.decompress(depth) if self.depth_codec else depth
                except zlib.error as error:
                    raise SystemExit(f"{self.file}: depth of frame {number}: {error}") from None
                if len(depth) != 2 * self.width * self.height:
                    raise SystemExit(f"{self.file}: depth of frame {number} has {len(depth)} bytes, not {2 * self.width * self.height}")
                yield number, color, grey_png(self.width, self.height, depth), rows(pose)


def camera(matrix, width, height):
    return {"width": width, "height": height, "fx": matrix[0][0], "fy": matrix[1][1], "cx": matrix[0][2], "cy": matrix[1][2]}
