/** Boxes over the cloud: bright edges where they are seen, faint ones where something stands before them. */

import { BoxGeometry, Color, DoubleSide, Group, Mesh, MeshBasicMaterial } from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import type { OrientedBox } from "../api/types";

/** What a box is there for; the same colors as in the service's own pictures. */
export type Role = "answer" | "anchor" | "candidate" | "selected" | "hovered";

export interface DrawnBox {
  instance: number;
  role: Role;
  box: OrientedBox;
}

export const COLORS: Record<Role, string> = {
  answer: "#16a34a",
  anchor: "#dc2626",
  candidate: "#2f6fde",
  selected: "#e08a00",
  hovered: "#8a8f98",
};

const WIDTHS: Record<Role, number> = { answer: 3.5, anchor: 2.5, candidate: 1.5, selected: 2.5, hovered: 1.5 };

/** Corners of the unit cube, two for each edge. */
const EDGES = (() => {
  const ends: number[] = [];
  for (const [u, v, w] of [[0, 1, 2], [1, 0, 2], [2, 0, 1]] as const) {
    for (const a of [-0.5, 0.5]) for (const b of [-0.5, 0.5]) for (const c of [-0.5, 0.5]) {
      const corner = [0, 0, 0];
      [corner[u], corner[v], corner[w]] = [c, a, b];
      ends.push(...corner);
    }
  }
  return ends;
})();

export class Boxes {
  readonly group = new Group();
  drawn: DrawnBox[] = [];

  show(boxes: DrawnBox[]): void {
    this.clear();
    this.drawn = boxes;
    for (const box of boxes) this.group.add(objectOf(box));
  }

  private clear(): void {
    this.group.traverse((object) => {
      if (!(object instanceof Mesh)) return;
      object.geometry.dispose();
      (object.material as MeshBasicMaterial).dispose();
    });
    this.group.clear();
  }

  dispose(): void {
    this.clear();
  }
}

function objectOf({ instance, role, box: { center, size, yaw_rad } }: DrawnBox): Group {
  const group = new Group();
  group.name = `${role}-${instance}`;
  group.position.set(center[0]!, center[1]!, center[2]!);
  group.rotation.set(0, 0, yaw_rad);
  group.scale.set(...(size.map((length) => Math.max(length, 0.005)) as [number, number, number]));
  group.add(edges(role, true), edges(role, false));
  if (role === "answer") group.add(faces(role));
  return group;
}

function edges(role: Role, behind: boolean): LineSegments2 {
  const geometry = new LineSegmentsGeometry();
  geometry.setPositions(EDGES);
  const material = new LineMaterial({ color: new Color(COLORS[role]), linewidth: WIDTHS[role], depthTest: !behind });
  material.transparent = behind;
  material.opacity = behind ? 0.35 : 1;
  const lines = new LineSegments2(geometry, material);
  lines.renderOrder = behind ? 1 : 2;
  return lines;
}

function faces(role: Role): Mesh {
  const material = new MeshBasicMaterial({ color: COLORS[role], transparent: true, opacity: 0.06, side: DoubleSide, depthWrite: false });
  return new Mesh(new BoxGeometry(1, 1, 1), material);
}
