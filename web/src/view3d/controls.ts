/**
 * Moves the camera: orbit, pan and zoom around a point, or walk at eye height.
 *
 * Angles are about the world's Z. Pointer, touch and keys do the same things; `onMove` is told when anything changed.
 */

import { type PerspectiveCamera, Vector3 } from "three";
import type { OrientedBox } from "../api/types";

export interface Pose {
  /** What is looked at, meters, world frame. */
  target: [number, number, number];
  distance: number;
  /** Where the camera stands, seen from the target: about +Z from +X. */
  azimuth: number;
  /** How far above the target's level, radians. */
  elevation: number;
}

const LOWEST = -1.2;
const HIGHEST = 1.55;
const NEAREST_M = 0.25;
const FARTHEST_M = 80;
const FLIGHT_MS = 450;
const WALK_STEP_M = 0.25;

/** After so long without a change the view rests. */
const REST_MS = 180;

export class Controls {
  pose: Pose = { target: [0, 0, 1], distance: 8, azimuth: -1, elevation: 0.7 };
  walking = false;
  home: Pose = this.pose;
  /** A pointer that went down and up without moving. */
  onClick: (event: PointerEvent) => void = () => undefined;
  private readonly pointers = new Map<number, { x: number; y: number }>();
  private travelled = 0;
  private changed = -Infinity;
  private flight: { from: Pose; to: Pose; start: number } | null = null;

  constructor(
    private readonly camera: PerspectiveCamera,
    private readonly element: HTMLElement,
    private readonly onMove: () => void,
  ) {
    const on = element.addEventListener.bind(element) as (type: string, listener: (event: never) => void, options?: object) => void;
    on("pointerdown", (event: PointerEvent) => this.down(event));
    on("pointermove", (event: PointerEvent) => this.moved(event));
    on("pointerup", (event: PointerEvent) => this.up(event));
    on("pointercancel", (event: PointerEvent) => this.pointers.delete(event.pointerId));
    on("wheel", (event: WheelEvent) => this.wheel(event), { passive: false });
    on("keydown", (event: KeyboardEvent) => this.key(event));
    on("contextmenu", (event: Event) => event.preventDefault());
  }

  /** Whether the view changes right now: by hand, by keys, by itself. */
  get moving(): boolean {
    return this.flight !== null || performance.now() - this.changed < REST_MS;
  }

  /** Puts the camera where the pose says; `now` moves a flight on. */
  apply(now: number): void {
    if (this.flight) {
      const { from, to, start } = this.flight;
      const t = Math.min(1, (now - start) / FLIGHT_MS);
      this.pose = between(from, to, 1 - (1 - t) ** 3);
      if (t === 1) this.flight = null;
    }
    const { target, distance, azimuth, elevation } = this.pose;
    const away = new Vector3(Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation));
    const at = new Vector3(...target);
    if (this.walking) {
      this.camera.position.copy(at);
      this.camera.lookAt(at.sub(away));
    } else {
      this.camera.position.copy(at).addScaledVector(away, distance);
      this.camera.lookAt(at);
    }
    this.camera.updateMatrixWorld();
  }

  flyTo(pose: Pose): void {
    const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    if (calm) this.pose = pose;
    else this.flight = { from: this.pose, to: pose, start: performance.now() };
    this.onMove();
  }

  /** Starts or ends walk mode. Walking starts in front of `box`, facing it; without one at the point that was looked at. */
  walk(walking: boolean, eyeHeight_m: number, box: OrientedBox | null = null): void {
    if (walking === this.walking) return;
    this.flight = null;
    this.walking = walking;
    const { target, distance, azimuth } = this.pose;
    this.pose = walking
      ? box
        ? this.inFrontOf(box, eyeHeight_m)
        : { target: [target[0], target[1], eyeHeight_m], distance, azimuth, elevation: 0 }
      : { target: [target[0], target[1], this.home.target[2]], distance: this.home.distance, azimuth, elevation: this.home.elevation };
    this.onMove();
  }

  /** The pose of a person who stands on the room's side of a box and looks at it. */
  private inFrontOf({ center, size }: OrientedBox, eyeHeight_m: number): Pose {
    const [x, y, z] = center as [number, number, number];
    const middle = this.home.target;
    const isCentral = Math.hypot(middle[0] - x, middle[1] - y) < 0.5;
    const azimuth = isCentral ? this.pose.azimuth : Math.atan2(middle[1] - y, middle[0] - x);
    const away_m = Math.min(3.5, Math.max(1.6, 0.8 + Math.max(size[0]!, size[1]!)));
    const target: Pose["target"] = [x + away_m * Math.cos(azimuth), y + away_m * Math.sin(azimuth), eyeHeight_m];
    return { target, distance: this.pose.distance, azimuth, elevation: Math.atan2(eyeHeight_m - z, away_m) };
  }

  private change(change: Partial<Pose>): void {
    this.flight = null;
    const pose = { ...this.pose, ...change };
    pose.elevation = Math.min(HIGHEST, Math.max(LOWEST, pose.elevation));
    pose.distance = Math.min(FARTHEST_M, Math.max(NEAREST_M, pose.distance));
    this.pose = pose;
    this.changed = performance.now();
    this.onMove();
  }

  private turn(right: number, down: number): void {
    const sign = this.walking ? -1 : 1;
    this.change({ azimuth: this.pose.azimuth - sign * right, elevation: this.pose.elevation + sign * down });
  }

  /** Moves the target along the picture's axes, meters. */
  private pan(right: number, up: number): void {
    const x = new Vector3().setFromMatrixColumn(this.camera.matrixWorld, 0);
    const y = new Vector3().setFromMatrixColumn(this.camera.matrixWorld, 1);
    const to = new Vector3(...this.pose.target).addScaledVector(x, right).addScaledVector(y, up);
    this.change({ target: [to.x, to.y, to.z] });
  }

  /** Level with the floor, meters. */
  private stride(forward: number, right: number, up = 0): void {
    const { target, azimuth } = this.pose;
    const [fx, fy] = [-Math.cos(azimuth), -Math.sin(azimuth)];
    this.change({ target: [target[0] + forward * fx + right * fy, target[1] + forward * fy - right * fx, target[2] + up] });
  }

  private zoom(factor: number): void {
    if (this.walking) this.stride(factor < 1 ? WALK_STEP_M : -WALK_STEP_M, 0);
    else this.change({ distance: this.pose.distance * factor });
  }

  private down(event: PointerEvent): void {
    this.element.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (this.pointers.size === 1) this.travelled = 0;
  }

  private moved(event: PointerEvent): void {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before.x, event.clientY - before.y];
    this.travelled += Math.hypot(dx, dy);
    const perPixel = (2 * this.pose.distance * Math.tan((this.camera.fov * Math.PI) / 360)) / this.element.clientHeight;
    if (this.pointers.size === 2) {
      const other = [...this.pointers.entries()].find(([id]) => id !== event.pointerId)![1];
      const spread = (x: number, y: number) => Math.hypot(x - other.x, y - other.y) || 1;
      this.zoom(spread(before.x, before.y) / spread(event.clientX, event.clientY));
      this.pan((-dx / 2) * perPixel, (dy / 2) * perPixel);
    } else if (!this.walking && (event.buttons & 6 || event.shiftKey)) {
      this.pan(-dx * perPixel, dy * perPixel);
    } else {
      this.turn(dx * 0.006, dy * 0.006);
    }
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  private up(event: PointerEvent): void {
    if (!this.pointers.delete(event.pointerId)) return;
    if (this.travelled < 5 && event.button === 0) this.onClick(event);
    this.onMove();
  }

  private wheel(event: WheelEvent): void {
    event.preventDefault();
    this.zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.0025));
  }

  private key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const action = this.walking ? this.walkKeys(event) : this.orbitKeys(event);
    if (!action) return;
    event.preventDefault();
    action();
  }

  private orbitKeys({ key, shiftKey }: KeyboardEvent): (() => void) | undefined {
    const step = this.pose.distance * 0.05;
    const keys: Record<string, () => void> = shiftKey
      ? {
          ArrowLeft: () => this.pan(-step, 0), ArrowRight: () => this.pan(step, 0),
          ArrowUp: () => this.pan(0, step), ArrowDown: () => this.pan(0, -step), "+": () => this.zoom(0.9),
        }
      : {
          ArrowLeft: () => this.turn(-0.1, 0), ArrowRight: () => this.turn(0.1, 0),
          ArrowUp: () => this.turn(0, -0.08), ArrowDown: () => this.turn(0, 0.08),
          "+": () => this.zoom(0.9), "=": () => this.zoom(0.9), "-": () => this.zoom(1.1), Home: () => this.flyTo(this.home),
        };
    return keys[key];
  }

  private walkKeys({ key }: KeyboardEvent): (() => void) | undefined {
    const keys: Record<string, () => void> = {
      w: () => this.stride(WALK_STEP_M, 0), ArrowUp: () => this.stride(WALK_STEP_M, 0),
      s: () => this.stride(-WALK_STEP_M, 0), ArrowDown: () => this.stride(-WALK_STEP_M, 0),
      a: () => this.stride(0, -WALK_STEP_M), d: () => this.stride(0, WALK_STEP_M),
      ArrowLeft: () => this.turn(0.1, 0), ArrowRight: () => this.turn(-0.1, 0),
      PageUp: () => this.stride(0, 0, WALK_STEP_M), PageDown: () => this.stride(0, 0, -WALK_STEP_M),
    };
    return keys[key.length === 1 ? key.toLowerCase() : key];
  }
}

function between(a: Pose, b: Pose, t: number): Pose {
  const mix = (x: number, y: number) => x + (y - x) * t;
  // The short way round.
  const turn = Math.atan2(Math.sin(b.azimuth - a.azimuth), Math.cos(b.azimuth - a.azimuth));
  return {
    target: [mix(a.target[0], b.target[0]), mix(a.target[1], b.target[1]), mix(a.target[2], b.target[2])],
    distance: mix(a.distance, b.distance),
    azimuth: a.azimuth + turn * t,
    elevation: mix(a.elevation, b.elevation),
  };
}
