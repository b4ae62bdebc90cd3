/** From how far away everything is seen: as near as all corners stay in the picture, whatever its shape. */

import { type PerspectiveCamera, Vector3 } from "three";
import type { Aabb, InstanceView } from "../api/types";
import type { Pose } from "./controls";
import type { Point } from "./marks";

/** Share of the picture's width and height that corners may reach. */
const RIM = 0.94;

/** Corners of all that was found; stray points, which the extent has too, do not count. */
export function cornersOf(instances: Iterable<InstanceView>, extent: Aabb): Point[] {
  const boxes = [...instances].filter(({ level }) => level === "thing").map(({ oriented_box }) => oriented_box);
  return (boxes.length ? boxes : [{ ...extent, yaw_rad: 0 }]).flatMap(({ center, size, yaw_rad }) => {
    const [cos, sin] = [Math.cos(yaw_rad), Math.sin(yaw_rad)];
    const corners: Point[] = [];
    for (const a of [-0.5, 0.5]) for (const b of [-0.5, 0.5]) for (const c of [-0.5, 0.5]) {
      const [x, y, z] = [a * size[0]!, b * size[1]!, c * size[2]!];
      corners.push([center[0]! + cos * x - sin * y, center[1]! + sin * x + cos * y, center[2]! + z]);
    }
    return corners;
  });
}

/** The pose that shows all corners from this direction. */
export function wholeRoom(camera: PerspectiveCamera, corners: Point[], azimuth: number, elevation: number): Pose {
  const middle = [0, 1, 2].map((i) => {
    const values = corners.map((corner) => corner[i]!);
    return (Math.min(...values) + Math.max(...values)) / 2;
  }) as Point;
  const forward = new Vector3(-Math.cos(elevation) * Math.cos(azimuth), -Math.cos(elevation) * Math.sin(azimuth), -Math.sin(elevation));
  const right = new Vector3(-Math.sin(azimuth), Math.cos(azimuth), 0);
  const up = new Vector3().crossVectors(right, forward);
  const high = Math.tan((camera.fov * Math.PI) / 360) * RIM;
  const wide = high * camera.aspect;
  const seen = corners.map((corner) => {
    const from = new Vector3(...corner).sub(new Vector3(...middle));
    return { x: from.dot(right), y: from.dot(up), z: from.dot(forward) };
  });
  // The rims of the picture are lines over the depth: each corner says how far back the eye must be, above, below, left and right.
  const back = (values: { side: number; z: number }[], slope: number) => {
    const most = (sign: number) => Math.max(...values.map(({ side, z }) => (sign * side) / slope - z));
    const [plus, minus] = [most(1), most(-1)];
    return { distance: (plus + minus) / 2, shift: ((plus - minus) / 2) * slope };
  };
  const across = back(seen.map(({ x, z }) => ({ side: x, z })), wide);
  const upward = back(seen.map(({ y, z }) => ({ side: y, z })), high);
  const target = new Vector3(...middle).addScaledVector(right, across.shift).addScaledVector(up, upward.shift);
  return { target: target.toArray(), distance: Math.max(across.distance, upward.distance), azimuth, elevation };
}
