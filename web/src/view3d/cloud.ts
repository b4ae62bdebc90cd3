/**
 * The cloud in memory, in an order of which every beginning is an even sample: while the view turns, only as many points
 * are drawn as this machine manages, and the rest follow when it rests.
 */

import { readPly } from "./ply";

export interface Cloud {
  count: number;
  /** Metres, world frame (Z up). */
  positions: Float32Array;
  /** sRGB and 255, or 0 where the point has not arrived. */
  colours: Uint8Array;
  /** Id of the thing each point belongs to; 0: none, or not known yet. */
  instances: Uint16Array;
}

/** Fills a cloud from its file; `onPart` is called while points arrive and at the end. */
export async function readCloud(body: ReadableStream<Uint8Array>, onStart: (cloud: Cloud) => void, onPart: () => void): Promise<Cloud> {
  let cloud: Cloud | null = null;
  let place = (i: number) => i;
  let offsets = { x: 0, y: 4, z: 8, red: 12, green: 13, blue: 14, stride: 15 };
  await readPly(
    body,
    ({ count, stride, at }) => {
      const of = (name: string) => at.get(name) ?? missing(name);
      offsets = { x: of("x"), y: of("y"), z: of("z"), red: of("red"), green: of("green"), blue: of("blue"), stride };
      place = scattered(count);
      cloud = {
        count,
        positions: new Float32Array(count * 3),
        colours: new Uint8Array(count * 4),
        instances: new Uint16Array(count),
      };
      onStart(cloud);
    },
    (bytes, first, count) => {
      const { positions, colours } = cloud!;
      for (let i = 0; i < count; i++) {
        const from = i * offsets.stride;
        const to = place(first + i);
        positions[to * 3] = bytes.getFloat32(from + offsets.x, true);
        positions[to * 3 + 1] = bytes.getFloat32(from + offsets.y, true);
        positions[to * 3 + 2] = bytes.getFloat32(from + offsets.z, true);
        colours[to * 4] = bytes.getUint8(from + offsets.red);
        colours[to * 4 + 1] = bytes.getUint8(from + offsets.green);
        colours[to * 4 + 2] = bytes.getUint8(from + offsets.blue);
        colours[to * 4 + 3] = 255;
      }
      onPart();
    },
  );
  return cloud!;
}

/** Adds which thing every point belongs to. The file has the same points in the same order; another parse's may not. */
export async function readInstances(body: ReadableStream<Uint8Array>, cloud: Cloud): Promise<boolean> {
  const place = scattered(cloud.count);
  let fits = false;
  let at = 0;
  let stride = 0;
  await readPly(
    body,
    (header) => {
      fits = header.count === cloud.count;
      at = header.at.get("instance") ?? missing("instance");
      stride = header.stride;
    },
    (bytes, first, count) => {
      if (!fits) return;
      for (let i = 0; i < count; i++) cloud.instances[place(first + i)] = Math.max(0, bytes.getInt32(i * stride + at, true));
    },
  );
  return fits;
}

function missing(name: string): never {
  throw new Error(`the cloud has no ${name}`);
}

/** Steps through all places by a golden share of them: neighbours of the file come to lie far apart. */
function scattered(count: number): (i: number) => number {
  let step = Math.max(1, Math.round(count * 0.6180339887));
  while (greatestCommonDivisor(step, count) !== 1) step += 1;
  return (i) => (i * step) % count;
}

function greatestCommonDivisor(a: number, b: number): number {
  return b === 0 ? a : greatestCommonDivisor(b, a % b);
}
