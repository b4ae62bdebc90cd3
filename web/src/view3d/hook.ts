/**
 * What tests may ask of the page: `window.unigroundPage`. Documented in web/README.md; nothing in the page uses it.
 * It only tells what is drawn, so that a test need not guess from pixels alone.
 */

import type { DrawnBox } from "./boxes";
import type { Point } from "./marks";
import type { Picked, Viewer } from "./viewer";

export interface TestHook {
  /** Points that have arrived, and all there are; 0 before it is known. */
  loaded(): { points: number; all: number };
  /** Points in the last picture. */
  shown(): number;
  boxes(): DrawnBox[];
  /** Cameras that are drawn: number of the frame, and where it was taken. */
  frames(): { index: number; position: Point }[];
  /** Place of a point of the world in the window, CSS pixels. */
  project(point: Point): { x: number; y: number } | null;
  pick(clientX: number, clientY: number): Picked | null;
  camera(): { position: Point; moving: boolean; frame_ms: number };
}

declare global {
  interface Window { unigroundPage?: TestHook }
}

export function offerHook(viewer: Viewer, canvas: HTMLCanvasElement): void {
  window.unigroundPage = {
    loaded: () => viewer.loaded,
    shown: () => viewer.shown,
    boxes: () => viewer.boxes.drawn,
    frames: () => viewer.frusta.places(),
    project: (point) => {
      const at = viewer.project(point);
      const { left, top } = canvas.getBoundingClientRect();
      return at && { x: at.x + left, y: at.y + top };
    },
    pick: (x, y) => viewer.pick(x, y),
    camera: () => ({ position: viewer.camera.position.toArray(), moving: viewer.controls.moving, frame_ms: viewer.frame_ms }),
  };
}
