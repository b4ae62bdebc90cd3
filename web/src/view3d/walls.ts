/**
 * Which walls stand between the camera and the room.
 *
 * A wall is looked through when the camera is on its far side. Its points, and what hangs flat on it, are then left out, as
 * in a doll's house. Scans without walls have the four sides of their extent instead.
 */

import type { Aabb, InstanceView } from "../api/types";

export interface Wall {
  /** Unit vector into the room, world X and Y. */
  normal: [number, number];
  /** `normal · p` of its inner face. */
  offset: number;
  middle: [number, number];
  /** Half its length, with a little more for the corners. */
  half: number;
}

const CORNER_M = 0.35;

export function wallsOf(instances: Iterable<InstanceView>, extent: Aabb): Wall[] {
  const all = [...instances];
  const things = all.filter((thing) => !thing.structure && thing.level === "thing");
  const walls = all.filter((thing) => thing.structure === "wall").map((wall) => wallOf(wall, things));
  return walls.length ? walls : sidesOf(extent);
}

function wallOf({ oriented_box: { center, size, yaw_rad } }: InstanceView, things: InstanceView[]): Wall {
  const [x, y] = center as [number, number];
  const [dx, dy] = size as [number, number];
  // The normal is the thin axis.
  const turn = dx < dy ? yaw_rad : yaw_rad + Math.PI / 2;
  let normal: [number, number] = [Math.cos(turn), Math.sin(turn)];
  // The room is where more things stand.
  const side = (thing: InstanceView) => Math.sign(normal[0] * (thing.box.center[0]! - x) + normal[1] * (thing.box.center[1]! - y));
  if (things.reduce((sum, thing) => sum + side(thing), 0) < 0) normal = [-normal[0], -normal[1]];
  const offset = normal[0] * x + normal[1] * y + Math.min(dx, dy) / 2;
  return { normal, offset, middle: [x, y], half: Math.max(dx, dy) / 2 + CORNER_M };
}

function sidesOf({ center, size }: Aabb): Wall[] {
  const [x, y] = center as [number, number];
  const [hx, hy] = [size[0]! / 2, size[1]! / 2];
  const side = (nx: number, ny: number, reach: number, half: number): Wall => {
    const middle: [number, number] = [x - nx * reach, y - ny * reach];
    return { normal: [nx, ny], offset: nx * middle[0] + ny * middle[1], middle, half: half + CORNER_M };
  };
  return [side(1, 0, hx, hy), side(-1, 0, hx, hy), side(0, 1, hy, hx), side(0, -1, hy, hx)];
}

export function lookedThrough(walls: Wall[], x: number, y: number): Wall[] {
  return walls.filter(({ normal, offset }) => normal[0] * x + normal[1] * y < offset);
}
