/** Which point is under the cursor: a few pixels drawn again with the number of each point as its color. */

import { type Camera, Color, NearestFilter, type PerspectiveCamera, Scene, WebGLRenderTarget, type WebGLRenderer } from "three";
import type { CloudPoints } from "./points";

/** How far around the cursor a point is looked for, pixels. */
const REACH = 6;
const SIDE = 2 * REACH + 1;

export class Picker {
  private readonly target = new WebGLRenderTarget(SIDE, SIDE, { minFilter: NearestFilter, magFilter: NearestFilter });
  private readonly scene = new Scene();
  private readonly pixels = new Uint8Array(SIDE * SIDE * 4);

  /** Number of the point nearest to pixel (x, y) of the canvas, from 0; `null` where there is none. */
  at(renderer: WebGLRenderer, camera: PerspectiveCamera, cloud: CloudPoints, x: number, y: number): number | null {
    const { clientWidth: width, clientHeight: height } = renderer.domElement;
    const drawn = cloud.points.material;
    const parent = cloud.points.parent;
    const background = renderer.getClearColor(new Color());
    camera.setViewOffset(width, height, Math.round(x) - REACH, Math.round(y) - REACH, SIDE, SIDE);
    cloud.points.material = cloud.picking;
    this.scene.add(cloud.points);
    renderer.setRenderTarget(this.target);
    renderer.setClearColor(0x000000, 0);
    renderer.clear();
    renderer.render(this.scene, camera as Camera);
    renderer.readRenderTargetPixels(this.target, 0, 0, SIDE, SIDE, this.pixels);
    renderer.setRenderTarget(null);
    renderer.setClearColor(background, 1);
    cloud.points.material = drawn;
    parent?.add(cloud.points);
    camera.clearViewOffset();
    return this.nearest();
  }

  private nearest(): number | null {
    let best: number | null = null;
    let least = Infinity;
    for (let row = 0; row < SIDE; row++) {
      for (let column = 0; column < SIDE; column++) {
        const at = (row * SIDE + column) * 4;
        const [a, b, c, d] = this.pixels.subarray(at, at + 4);
        const number = a! + b! * 256 + c! * 65536 + d! * 16777216;
        const away = (row - REACH) ** 2 + (column - REACH) ** 2;
        if (number > 0 && away < least) [best, least] = [number - 1, away];
      }
    }
    return best;
  }

  dispose(): void {
    this.target.dispose();
  }
}
