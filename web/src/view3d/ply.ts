/**
 * Reads a binary PLY while it arrives.
 *
 * Only what the service writes: little endian, one element `vertex`, scalar properties.
 */

export interface PlyHeader {
  count: number;
  stride: number;
  /** Where each property begins within a vertex, bytes. */
  at: Map<string, number>;
}

const SIZES: Record<string, number> = { char: 1, uchar: 1, short: 2, ushort: 2, int: 4, uint: 4, float: 4, double: 8 };

const LONGEST_HEADER = 4096;

export function plyHeader(text: string): PlyHeader {
  const header: PlyHeader = { count: 0, stride: 0, at: new Map() };
  if (!text.startsWith("ply\n") || !text.includes("format binary_little_endian")) throw new Error("not a binary PLY");
  for (const line of text.split("\n")) {
    const [word, first, second] = line.trim().split(/\s+/);
    if (word === "element" && first === "vertex") header.count = Number(second);
    if (word !== "property") continue;
    const size = SIZES[first!];
    if (!size) throw new Error(`a PLY property of type ${first} is not read here`);
    header.at.set(second!, header.stride);
    header.stride += size;
  }
  return header;
}

/** Gives the header once, then runs of whole vertices in the file's order. */
export async function readPly(
  body: ReadableStream<Uint8Array>,
  onHeader: (header: PlyHeader) => void,
  onVertices: (bytes: DataView, first: number, count: number) => void,
): Promise<void> {
  let header: PlyHeader | null = null;
  let rest = new Uint8Array(0);
  let read = 0;
  const reader = body.getReader();
  for (;;) {
    const { value, done } = await reader.read();
    if (done) break;
    let bytes = rest.length ? joined(rest, value) : value;
    if (!header) {
      const start = new TextDecoder("latin1").decode(bytes.subarray(0, LONGEST_HEADER));
      const end = start.indexOf("end_header\n");
      if (end < 0 && bytes.length > LONGEST_HEADER) throw new Error("no PLY header");
      rest = bytes.slice();
      if (end < 0) continue;
      header = plyHeader(start.slice(0, end));
      onHeader(header);
      bytes = bytes.subarray(end + "end_header\n".length);
    }
    const whole = Math.min(Math.floor(bytes.length / header.stride), header.count - read);
    if (whole > 0) onVertices(new DataView(bytes.buffer, bytes.byteOffset, whole * header.stride), read, whole);
    read += whole;
    rest = bytes.slice(whole * header.stride);
  }
  if (!header || read < header.count) throw new Error("the cloud broke off");
}

function joined(a: Uint8Array, b: Uint8Array): Uint8Array<ArrayBuffer> {
  const both = new Uint8Array(a.length + b.length);
  both.set(a);
  both.set(b, a.length);
  return both;
}
