/** Where photographs were taken: a pyramid for each, its tip in the lens, its base what the camera looks at. */

import { BufferAttribute, BufferGeometry, Group, LineBasicMaterial, LineSegments, Matrix4, type PerspectiveCamera, Vector3 } from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import type { FrameView } from "../api/types";
import type { Point } from "./marks";

const COLOR = "#7c3aed";

/** From the tip to the base, meters. */
const DEPTH_M = 0.18;

/** How near a tip a pointer must be that is over no base, pixels. */
const REACH = 8;

interface Frustum { frame: FrameView; tip: Vector3; base: Vector3[] }

export class Frusta {
  readonly group = new Group();
  private drawn: Frustum[] = [];
  private highlighted: LineSegments2 | null = null;

  show(frames: FrameView[]): void {
    this.dispose();
    this.drawn = frames.map(frustumOf);
    if (!frames.length) return;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(this.drawn.flatMap(edgesOf)), 3));
    // Behind things they are there as well, but faint.
    for (const [depthTest, opacity] of [[true, 1], [false, 0.3]] as const) {
      const lines = new LineSegments(geometry, new LineBasicMaterial({ color: COLOR, transparent: true, opacity, depthTest }));
      lines.frustumCulled = false;
      this.group.add(lines);
    }
  }

  highlight(frame: FrameView | null): void {
    if (this.highlighted) {
      this.group.remove(this.highlighted);
      this.highlighted.geometry.dispose();
      this.highlighted.material.dispose();
    }
    this.highlighted = null;
    if (!frame) return;
    const geometry = new LineSegmentsGeometry();
    geometry.setPositions(edgesOf(frustumOf(frame)));
    this.highlighted = new LineSegments2(geometry, new LineMaterial({ color: COLOR, linewidth: 4, depthTest: false, transparent: true }));
    this.highlighted.renderOrder = 3;
    this.group.add(this.highlighted);
  }

  /** Those that are drawn, and where from they look. */
  places(): { index: number; position: Point }[] {
    return this.drawn.map(({ frame, tip }) => ({ index: frame.index, position: tip.toArray() }));
  }

  /** Number of the frame whose pyramid is under a place of the canvas (CSS pixels), the nearest one; `null` where there is none. */
  at(camera: PerspectiveCamera, width: number, height: number, x: number, y: number): number | null {
    let best: number | null = null;
    let nearest = Infinity;
    const pixel = (place: Vector3) => {
      const seen = place.clone().project(camera);
      return { x: ((seen.x + 1) / 2) * width, y: ((1 - seen.y) / 2) * height, behind: seen.z > 1 };
    };
    for (const { frame, tip, base } of this.drawn) {
      const [lens, corners] = [pixel(tip), base.map(pixel)];
      const away = tip.distanceTo(camera.position);
      if (away >= nearest || [lens, ...corners].some(({ behind }) => behind)) continue;
      const onSide = corners.some((corner, i) => inside([lens, corner, corners[(i + 1) % corners.length]!], x, y));
      if (onSide || inside(corners, x, y) || Math.hypot(lens.x - x, lens.y - y) < REACH) [best, nearest] = [frame.index, away];
    }
    return best;
  }

  dispose(): void {
    this.highlight(null);
    for (const lines of this.group.children as LineSegments[]) {
      lines.geometry.dispose();
      (lines.material as LineBasicMaterial).dispose();
    }
    this.group.clear();
    this.drawn = [];
  }
}

function frustumOf(frame: FrameView): Frustum {
  const { fx, fy, cx, cy, width, height } = frame;
  const toWorld = new Matrix4().fromArray(frame.camera_to_world.flat()).transpose();
  // Pixel (0, 0) is the middle of the first one.
  const corners = [[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]] as const;
  const base = corners.map(([u, v]) => new Vector3((u - cx) / fx, (v - cy) / fy, 1).multiplyScalar(DEPTH_M).applyMatrix4(toWorld));
  return { frame, tip: new Vector3().applyMatrix4(toWorld), base };
}

function edgesOf({ tip, base }: Frustum): number[] {
  return base.flatMap((corner, i) => [tip, corner, corner, base[(i + 1) % base.length]!].flatMap((end) => end.toArray()));
}

interface Pixel { x: number; y: number }

/** Whether a place lies in a convex outline: on the same side of all its edges. */
function inside(outline: Pixel[], x: number, y: number): boolean {
  const sides = outline.map((a, i) => {
    const b = outline[(i + 1) % outline.length]!;
    return Math.sign((b.x - a.x) * (y - a.y) - (b.y - a.y) * (x - a.x));
  });
  return !(sides.includes(1) && sides.includes(-1));
}
