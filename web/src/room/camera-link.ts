/** A view as it stands in a link: target, distance, two angles; `w` after it when somebody walks. */

import type { Pose } from "../view3d/controls";

export function writePose({ target, distance, azimuth, elevation }: Pose, walking: boolean): string {
  const figures = [...target, distance, azimuth, elevation].map((figure) => figure.toFixed(2).replace(/\.?0+$/, ""));
  return figures.join(",") + (walking ? "w" : "");
}

export function readPose(text: string | null): { pose: Pose; walking: boolean } | null {
  const figures = (text ?? "").replace(/w$/, "").split(",").map(Number);
  if (figures.length !== 6 || !figures.every(Number.isFinite)) return null;
  const [x, y, z, distance, azimuth, elevation] = figures as [number, number, number, number, number, number];
  return { pose: { target: [x, y, z], distance, azimuth, elevation }, walking: text!.endsWith("w") };
}
