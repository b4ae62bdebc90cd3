/** What people put into the room themselves: the two ends of a measurement, and somebody who stands there. */

import { ConeGeometry, DoubleSide, Group, Mesh, MeshBasicMaterial, RingGeometry, SphereGeometry, Vector3 } from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import type { Observer } from "../api/types";

export type Point = [number, number, number];

const MEASURE = "#c026d3";
const OBSERVER = "#0e7490";

/** Over everything: what somebody placed is never lost behind a wall. */
const OVER = { depthTest: false, transparent: true };

export class Marks {
  readonly group = new Group();
  private measured: Point[] = [];
  private observer: Observer | null = null;

  measure(ends: Point[]): void {
    this.measured = ends;
    this.redraw();
  }

  stand(observer: Observer | null): void {
    this.observer = observer;
    this.redraw();
  }

  private redraw(): void {
    this.dispose();
    for (const end of this.measured) this.group.add(ball(end, 0.035));
    if (this.measured.length === 2) this.group.add(line(this.measured as [Point, Point]));
    if (this.observer) this.group.add(standing(this.observer));
  }

  dispose(): void {
    this.group.traverse((object) => {
      if (!(object instanceof Mesh)) return;
      object.geometry.dispose();
      (object.material as MeshBasicMaterial).dispose();
    });
    this.group.clear();
  }
}

function ball(at: Point, radius: number): Mesh {
  const mesh = new Mesh(new SphereGeometry(radius, 12, 8), new MeshBasicMaterial({ color: MEASURE, ...OVER }));
  mesh.position.set(...at);
  mesh.renderOrder = 3;
  return mesh;
}

function line(ends: [Point, Point]): LineSegments2 {
  const geometry = new LineSegmentsGeometry();
  geometry.setPositions(ends.flat());
  const lines = new LineSegments2(geometry, new LineMaterial({ color: MEASURE, linewidth: 2.5, ...OVER }));
  lines.renderOrder = 3;
  return lines;
}

function standing({ position, yaw_rad }: Observer): Group {
  const group = new Group();
  const material = () => new MeshBasicMaterial({ color: OBSERVER, side: DoubleSide, ...OVER });
  const ring = new Mesh(new RingGeometry(0.16, 0.22, 32), material());
  const arrow = new Mesh(new ConeGeometry(0.1, 0.35, 20), material());
  // A cone points along its own Y: turn it to look along the yaw.
  arrow.quaternion.setFromUnitVectors(new Vector3(0, 1, 0), new Vector3(1, 0, 0));
  arrow.position.x = 0.4;
  group.add(ring, arrow);
  group.rotation.z = yaw_rad;
  group.position.set(position[0]!, position[1]!, position[2]!);
  group.traverse((object) => (object.renderOrder = 3));
  return group;
}
