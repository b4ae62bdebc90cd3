/**
 * The room on a canvas. World frame as everywhere in uniground: meters, right-handed, Z up; nothing is mirrored or swapped.
 *
 * Knows nothing of the page around it. Draws when something changed, and then once; while the camera moves it draws as many
 * points as keep the picture fluent, and all of them when it rests.
 */

import { Color, Object3D, PerspectiveCamera, Scene, Vector3, WebGLRenderer } from "three";
import type { Aabb, FrameView, InstanceView, Observer, OrientedBox } from "../api/types";
import { Boxes, type DrawnBox } from "./boxes";
import type { Cloud } from "./cloud";
import { Controls, type Pose } from "./controls";
import { cornersOf, wholeRoom } from "./framing";
import { Frusta } from "./frusta";
import { Marks, type Point } from "./marks";
import { Picker } from "./pick";
import { type Coloring, CloudPoints, LIT, PLAIN, TINTED } from "./points";
import { lookedThrough, wallsOf, type Wall } from "./walls";

Object3D.DEFAULT_UP.set(0, 0, 1);

export const EYE_HEIGHT_M = 1.6;

/** Points drawn while the camera moves: at first, and at least. */
const BUDGET = 1_000_000;
const LEAST_BUDGET = 100_000;
const FLUENT_MS = 40;

/** Fewer points are drawn wider, up to so many times: wide ones cost as much as many. */
const WIDEST = 2.5;

/** A picture at rest may take so many times as long: a second. */
const AT_REST = 25;

/** Marked in the browser's own measurements. */
const FIRST_PICTURE = "first picture";

/** From where the whole room is shown, radians. */
const HOME_AZIMUTH = -2.1;
const HOME_ELEVATION = 0.85;

/** Points that belong to nothing. */
const NO_TONE: [number, number, number] = [150, 150, 150];

export interface Picked { point: Point; instance: number }

export class Viewer {
  readonly controls: Controls;
  readonly camera = new PerspectiveCamera(50, 1, 0.05, 200);
  readonly boxes = new Boxes();
  readonly marks = new Marks();
  readonly frusta = new Frusta();
  /** Called after each picture, for labels that hang on things. */
  onDrawn: () => void = () => undefined;
  /** Milliseconds the last pictures took while the camera moved. */
  frame_ms = 0;
  /** Points in the last picture; 0 before any arrived. */
  shown = 0;
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly picker = new Picker();
  private readonly resizing: ResizeObserver;
  private cloud: Cloud | null = null;
  private points: CloudPoints | null = null;
  private walls: Wall[] = [];
  private cutWalls = true;
  private cutHeight = Infinity;
  private spacing_m = 0.02;
  private corners: Point[] = [];
  private lit: number[] = [];
  private tinted: number[] = [];
  private ground = [1, 1, 1];
  private tones = new Map<number, [number, number, number]>();
  private budget = BUDGET;
  private moved = false;
  private request = 0;
  private last = 0;

  constructor(private readonly canvas: HTMLCanvasElement) {
    const card = hasGraphicsCard();
    this.renderer = new WebGLRenderer({ canvas, antialias: card, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(card ? Math.min(devicePixelRatio, 2) : 1);
    this.scene.add(this.boxes.group, this.marks.group, this.frusta.group);
    this.controls = new Controls(this.camera, canvas, () => this.turned());
    this.resizing = new ResizeObserver(() => this.resize());
    this.resizing.observe(canvas.parentElement!);
    this.resize();
  }

  background(color: string): void {
    this.renderer.setClearColor(color, 1);
    // As the shader writes it: sRGB.
    this.ground = new Color(color).convertLinearToSRGB().toArray();
    this.points?.set({ ground: this.ground });
    this.draw();
  }

  /** Takes a cloud that is still empty; it stands where the extent says. What its points are of is to be told next. */
  load(cloud: Cloud, extent: Aabb, instances: Map<number, InstanceView>): void {
    this.points?.dispose();
    if (this.points) this.scene.remove(this.points.points);
    this.cloud = cloud;
    this.points = new CloudPoints(cloud, Math.max(0, ...instances.keys()));
    this.scene.add(this.points.points);
    const [dx, dy, dz] = extent.size as [number, number, number];
    const bottom = extent.center[2]! - dz / 2;
    // As far apart as points lie that are spread over the room's six sides.
    this.spacing_m = Math.min(0.06, 1.7 * Math.sqrt((2 * (dx * dy + dy * dz + dx * dz)) / Math.max(1, cloud.count)));
    this.points.set({ heights: [bottom, bottom + dz] });
    this.walls = wallsOf(instances.values(), extent);
    this.points.set({ ground: this.ground });
    this.corners = cornersOf(instances.values(), extent);
    this.resize();
  }

  /** Takes what the points are of: for each number that points have, the instance it means now, or `null`. */
  know(instances: Map<number, InstanceView>, standing: (cut: number) => number | null): void {
    this.tones = tonesOf(instances, standing);
    this.points?.paint(0, NO_TONE, PLAIN);
    for (const [id, tone] of this.tones) this.points?.paint(id, tone, PLAIN);
    this.light(this.lit, this.tinted);
  }

  /** More of the cloud has arrived: it is shown before more is waited for. */
  arrived(): void {
    this.points?.arrived();
    cancelAnimationFrame(this.request);
    this.picture(performance.now());
  }

  /** Points that have arrived, and all there are. */
  get loaded(): { points: number; all: number } {
    return { points: this.cloud?.arrived ?? 0, all: this.cloud?.count ?? 0 };
  }

  color(mode: Coloring): void {
    this.points?.set({ mode });
    this.draw();
  }

  cut(walls: boolean, height: number): void {
    [this.cutWalls, this.cutHeight] = [walls, height];
    this.draw();
  }

  /** Brings out some instances before all others, and tints some. */
  light(lit: number[], tinted: number[]): void {
    const paint = (ids: number[], state: number) => ids.forEach((id) => this.points?.paint(id, this.tones.get(id) ?? NO_TONE, state));
    paint([...this.lit, ...this.tinted], PLAIN);
    paint(tinted, TINTED);
    paint(lit, LIT);
    [this.lit, this.tinted] = [lit, tinted];
    this.points?.set({ fade: lit.length ? 1 : 0 });
    this.draw();
  }

  showBoxes(boxes: DrawnBox[]): void {
    this.boxes.show(boxes);
    this.draw();
  }

  measure(ends: Point[]): void {
    this.marks.measure(ends);
    this.draw();
  }

  stand(observer: Observer | null): void {
    this.marks.stand(observer);
    this.draw();
  }

  showFrames(frames: FrameView[]): void {
    this.frusta.show(frames);
    this.draw();
  }

  highlightFrame(frame: FrameView | null): void {
    this.frusta.highlight(frame);
    this.draw();
  }

  /** Brings a box into the middle, seen from the room's inside. */
  frame(box: OrientedBox): void {
    const [x, y, z] = box.center as Point;
    const { target } = this.controls.home;
    const size = Math.hypot(...(box.size as Point));
    const off = Math.hypot(target[0] - x, target[1] - y);
    const azimuth = off > 0.5 ? Math.atan2(target[1] - y, target[0] - x) : this.controls.pose.azimuth;
    if (this.controls.walking) this.controls.walk(false, 0);
    this.controls.flyTo({ target: [x, y, z], distance: Math.max(2.4, size * 2.2), azimuth, elevation: 0.6 });
  }

  goTo(pose: Pose): void {
    this.controls.pose = pose;
    this.draw();
  }

  /** The point of the cloud at a place of the window. */
  pick(clientX: number, clientY: number): Picked | null {
    if (!this.points || !this.cloud) return null;
    const { left, top } = this.canvas.getBoundingClientRect();
    const i = this.picker.at(this.renderer, this.camera, this.points, clientX - left, clientY - top);
    if (i === null) return null;
    return { point: this.cloud.position(i), instance: this.cloud.instance(i) };
  }

  /** Number of the frame that is drawn at a place of the window. */
  pickFrame(clientX: number, clientY: number): number | null {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    return this.frusta.at(this.camera, width, height, clientX - left, clientY - top);
  }

  /** Where a place of the world lies on the canvas, CSS pixels; `null` behind the camera. */
  project(point: Point): { x: number; y: number } | null {
    const seen = new Vector3(...point).project(this.camera);
    if (seen.z > 1) return null;
    return { x: ((seen.x + 1) / 2) * this.canvas.clientWidth, y: ((1 - seen.y) / 2) * this.canvas.clientHeight };
  }

  private turned(): void {
    this.moved = true;
    this.draw();
  }

  draw(): void {
    this.request ||= requestAnimationFrame((now) => this.picture(now));
  }

  private picture(now: number): void {
    this.request = 0;
    // A picture that took long comes when the hand already rests: it moved all the same.
    const moving = this.moved || this.controls.moving;
    this.moved = false;
    this.controls.apply(performance.now());
    this.adapt(now, moving);
    if (this.points && this.cloud) {
      const { position } = this.camera;
      const inside = this.controls.walking;
      this.points.cut(this.cutWalls && !inside ? lookedThrough(this.walls, position.x, position.y) : []);
      const { arrived, count } = this.cloud;
      const most = moving || arrived < count ? this.budget : this.budget * AT_REST;
      if (arrived && !this.shown) performance.mark(FIRST_PICTURE);
      this.shown = Math.min(arrived, Math.ceil(most));
      this.points.drawAtMost(this.shown);
      const perMeter = (this.canvas.clientHeight * this.renderer.getPixelRatio()) / (2 * Math.tan((this.camera.fov * Math.PI) / 360));
      const pixelsPerMeter = this.spacing_m * perMeter * Math.min(WIDEST, Math.sqrt(count / Math.max(1, this.shown)));
      this.points.set({ cutHeight: inside ? Infinity : this.cutHeight, pixelsPerMeter, smallest: this.renderer.getPixelRatio() });
    }
    this.renderer.render(this.scene, this.camera);
    this.onDrawn();
    // On it goes until the view rests, and then once more with all points.
    if (moving) this.draw();
  }

  /** Fewer points where pictures are slow, more where there is time. */
  private adapt(now: number, moving: boolean): void {
    if (moving && this.last) {
      const took = now - this.last;
      this.frame_ms = this.frame_ms ? 0.8 * this.frame_ms + 0.2 * took : took;
      if (took > FLUENT_MS) this.budget = Math.max(LEAST_BUDGET, this.budget * Math.max(0.4, FLUENT_MS / took));
      else if (took < FLUENT_MS / 2) this.budget = Math.min(20_000_000, this.budget * 1.1);
    }
    this.last = moving ? now : 0;
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement!;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    // A narrow window still shows the whole room.
    this.camera.fov = width < height ? 65 : 50;
    this.camera.updateProjectionMatrix();
    if (this.corners.length) this.controls.home = wholeRoom(this.camera, this.corners, HOME_AZIMUTH, HOME_ELEVATION);
    this.draw();
  }

  dispose(): void {
    cancelAnimationFrame(this.request);
    this.resizing.disconnect();
    this.points?.dispose();
    this.boxes.dispose();
    this.marks.dispose();
    this.frusta.dispose();
    this.picker.dispose();
    this.renderer.dispose();
  }
}

/** Where a processor draws in a graphics card's place, smooth edges and fine pixels cost more than they are worth. */
function hasGraphicsCard(): boolean {
  const context = document.createElement("canvas").getContext("webgl2");
  if (!context) throw new Error("no WebGL 2");
  const names = context.getExtension("WEBGL_debug_renderer_info");
  const renderer = String(names && context.getParameter(names.UNMASKED_RENDERER_WEBGL));
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|softpipe|software|basic render/i.test(renderer);
}

/** A tone for each number that points have: that of the instance it means. */
function tonesOf(instances: Map<number, InstanceView>, standing: (cut: number) => number | null): Map<number, [number, number, number]> {
  const tones = new Map<number, [number, number, number]>();
  for (const cut of instances.keys()) {
    const instance = instances.get(standing(cut) ?? 0);
    tones.set(cut, instance ? toneOf(instance) : NO_TONE);
  }
  return tones;
}

/** Far from that of its neighbors in number; parts of the building are gray. */
function toneOf({ id, structure }: InstanceView): [number, number, number] {
  if (!structure) return tone((id * 0.6180339887) % 1, 0.5 + 0.2 * ((id * 0.37) % 1), 0.5 + 0.15 * ((id * 0.73) % 1));
  const gray = structure === "floor" ? 120 : 165;
  return [gray, gray, gray];
}

function tone(hue: number, saturation: number, lightness: number): [number, number, number] {
  const chroma = saturation * Math.min(lightness, 1 - lightness);
  const part = (n: number) => {
    const k = (n + hue * 12) % 12;
    return Math.round(255 * (lightness - chroma * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  };
  return [part(0), part(8), part(4)];
}
