/**
 * The cloud in memory, as it comes from the service and as the shader reads it: three words a point.
 *
 *   word 0   x, y           16 bits each, steps from the origin
 *   word 1   z, red, green  16, 8 and 8 bits
 *   word 2   blue, thing    8 and 24 bits; thing 0: none
 *
 * Every beginning of it is an even sample: what has arrived is drawn as if it were all, and while the view turns only as
 * many points are drawn as this machine manages.
 */

import type { Point } from "./marks";

const HEADER_BYTES = 32;
const POINT_BYTES = 12;
export const POINT_WORDS = 3;

export class Cloud {
  readonly words: Uint32Array;
  private readonly bytes: Uint8Array;
  private filled = 0;

  constructor(
    readonly count: number,
    readonly origin: Point,
    /** Meters. */
    readonly step: number,
  ) {
    this.words = new Uint32Array(count * POINT_WORDS);
    this.bytes = new Uint8Array(this.words.buffer);
  }

  /** How many points are there, from the first. */
  get arrived(): number {
    return Math.floor(this.filled / POINT_BYTES);
  }

  append(bytes: Uint8Array): void {
    this.bytes.set(bytes, this.filled);
    this.filled += bytes.length;
  }

  /** Where point `i` is: meters, world frame (Z up). */
  position(i: number): Point {
    const [xy, z] = [this.words[i * POINT_WORDS]!, this.words[i * POINT_WORDS + 1]!];
    return [xy & 0xffff, xy >>> 16, z & 0xffff].map((steps, axis) => this.origin[axis]! + steps * this.step) as Point;
  }

  /** Number of the thing that point `i` belongs to. */
  instance(i: number): number {
    return this.words[i * POINT_WORDS + 2]! >>> 8;
  }
}

/** Fills a cloud while its file arrives. */
export async function readCloud(file: AsyncIterable<Uint8Array>, onStart: (cloud: Cloud) => void, onMore: (cloud: Cloud) => void): Promise<void> {
  const header = new Uint8Array(HEADER_BYTES);
  let held = 0;
  let cloud: Cloud | null = null;
  for await (const bytes of file) {
    const ofHeader = bytes.subarray(0, HEADER_BYTES - held);
    header.set(ofHeader, held);
    held += ofHeader.length;
    if (held < HEADER_BYTES) continue;
    if (!cloud) onStart((cloud = emptyCloud(header)));
    cloud.append(bytes.subarray(ofHeader.length));
    onMore(cloud);
  }
  if (!cloud || cloud.arrived < cloud.count) throw new Error("the cloud broke off");
}

function emptyCloud(header: Uint8Array): Cloud {
  const view = new DataView(header.buffer);
  const magic = new TextDecoder("latin1").decode(header.subarray(0, 4));
  if (magic !== "UGP1" || view.getUint32(8, true) !== POINT_BYTES) throw new Error("these points are not read here");
  const origin: Point = [view.getFloat32(16, true), view.getFloat32(20, true), view.getFloat32(24, true)];
  return new Cloud(view.getUint32(4, true), origin, view.getFloat32(28, true));
}
