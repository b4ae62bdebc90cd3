/**
 * How points are drawn: one draw call, everything decided in the shader.
 *
 * A small texture has a texel for each instance: its color, and in alpha whether it is plain, tinted or lit. So hovering
 * over a thing changes four bytes and not a million points.
 */

import {
  BufferAttribute, BufferGeometry, DataTexture, GLSL3, NearestFilter, Points, RGBAFormat, ShaderMaterial, UnsignedByteType, Vector2, Vector4,
} from "three";
import { type Cloud, POINT_WORDS } from "./cloud";

export type Coloring = "photograph" | "instance" | "height";

/** What alpha of the texture says. */
export const PLAIN = 128;
/** Under the pointer: tinted. */
export const TINTED = 192;
/** What it is all about: in its own colors, while the rest steps back. */
export const LIT = 255;

const MODES: Record<Coloring, number> = { photograph: 0, instance: 1, height: 2 };

const TABLE_WIDTH = 256;

/** Walls that may be cut at once. */
export const MAX_CUTS = 8;

const VERTEX = /* glsl */ `
  in uvec3 words;
  uniform vec3 origin;
  uniform float stride, pixelsPerMeter, smallest, cutHeight, fade;
  uniform int mode, cuts;
  uniform vec2 heights;
  uniform vec3 tint, ground;
  uniform sampler2D table;
  // Normal into the room (x, y), its offset, half the wall's length; and the wall's middle.
  uniform vec4 walls[${MAX_CUTS}];
  uniform vec2 middles[${MAX_CUTS}];
  #ifdef PICKING
    flat out uint number;
  #else
    flat out vec3 tone;
    flat out float width;
  #endif

  bool isCut(vec3 p) {
    if (p.z > cutHeight) return true;
    for (int i = 0; i < cuts; i++) {
      vec4 wall = walls[i];
      float inside = dot(wall.xy, p.xy) - wall.z;
      float along = dot(vec2(-wall.y, wall.x), p.xy - middles[i]);
      if (inside < 0.12 && inside > -1.0 && abs(along) < wall.w) return true;
    }
    return false;
  }

  vec3 byHeight(float h) {
    const vec3 a = vec3(0.23, 0.24, 0.55), b = vec3(0.13, 0.52, 0.58), c = vec3(0.42, 0.70, 0.40), d = vec3(0.95, 0.83, 0.35);
    float t = clamp(h, 0.0, 1.0) * 3.0;
    return t < 1.0 ? mix(a, b, t) : t < 2.0 ? mix(b, c, t - 1.0) : mix(c, d, t - 2.0);
  }

  void main() {
    vec3 place = origin + stride * vec3(words.x & 0xffffu, words.x >> 16, words.y & 0xffffu);
    vec3 color = vec3((words.y >> 16) & 0xffu, words.y >> 24, words.z & 0xffu) / 255.0;
    int id = int(words.z >> 8);
    vec4 entry = texelFetch(table, ivec2(id % ${TABLE_WIDTH}, id / ${TABLE_WIDTH}), 0);
    if (isCut(place)) {
      gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
      gl_PointSize = 0.0;
      return;
    }
    vec4 seen = modelViewMatrix * vec4(place, 1.0);
    gl_Position = projectionMatrix * seen;
    gl_PointSize = clamp(pixelsPerMeter / -seen.z, smallest, 24.0);
    #ifdef PICKING
      number = uint(gl_VertexID) + 1u;
    #else
      tone = mode == 0 ? color : mode == 1 ? entry.rgb : byHeight((place.z - heights.x) / (heights.y - heights.x));
      if (entry.a < 0.9) {
        float gray = dot(tone, vec3(0.3, 0.59, 0.11));
        tone = mix(tone, mix(mix(tone, vec3(gray), 0.5), ground, 0.3), fade);
      }
      if (entry.a > 0.6 && entry.a < 0.9) tone = mix(tone, tint, 0.4);
      width = gl_PointSize;
    #endif
  }
`;

const FRAGMENT = /* glsl */ `
  precision highp float;
  #ifdef PICKING
    flat in uint number;
    out vec4 result;
    void main() {
      result = vec4(number & 255u, (number >> 8) & 255u, (number >> 16) & 255u, number >> 24) / 255.0;
    }
  #else
    flat in vec3 tone;
    flat in float width;
    out vec4 result;
    void main() {
      // Close by, points are round; far away nobody sees it.
      if (width > 4.0 && length(gl_PointCoord - 0.5) > 0.5) discard;
      result = vec4(tone, 1.0);
    }
  #endif
`;

export class CloudPoints {
  readonly points: Points;
  readonly picking: ShaderMaterial;
  private readonly drawn: ShaderMaterial;
  private readonly geometry = new BufferGeometry();
  private readonly table: DataTexture;
  private readonly words: BufferAttribute;
  /** Points the graphics card has. */
  private sent = 0;

  constructor(private readonly cloud: Cloud, instances: number) {
    this.words = new BufferAttribute(cloud.words, POINT_WORDS);
    const rows = Math.ceil((instances + 1) / TABLE_WIDTH);
    this.table = new DataTexture(new Uint8Array(TABLE_WIDTH * rows * 4).fill(PLAIN), TABLE_WIDTH, rows, RGBAFormat, UnsignedByteType);
    this.table.minFilter = this.table.magFilter = NearestFilter;
    this.table.needsUpdate = true;
    const uniforms = {
      origin: { value: cloud.origin },
      stride: { value: cloud.step },
      pixelsPerMeter: { value: 1 },
      smallest: { value: 1 },
      cutHeight: { value: Infinity },
      mode: { value: 0 },
      cuts: { value: 0 },
      heights: { value: new Vector2(0, 1) },
      tint: { value: [1, 0.75, 0.2] },
      ground: { value: [1, 1, 1] },
      fade: { value: 0 },
      table: { value: this.table },
      walls: { value: Array.from({ length: MAX_CUTS }, () => new Vector4()) },
      middles: { value: Array.from({ length: MAX_CUTS }, () => new Vector2()) },
    };
    const material = (defines: Record<string, string>) =>
      new ShaderMaterial({ glslVersion: GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms, defines });
    this.drawn = material({});
    this.picking = material({ PICKING: "1" });
    this.geometry.setAttribute("words", this.words);
    this.points = new Points(this.geometry, this.drawn);
    this.points.frustumCulled = false;
  }

  /** More points have arrived: only they go to the graphics card. */
  arrived(): void {
    const { arrived } = this.cloud;
    this.words.addUpdateRange(this.sent * POINT_WORDS, (arrived - this.sent) * POINT_WORDS);
    this.words.needsUpdate = true;
    this.sent = arrived;
  }

  /** How many points are drawn at most: an even sample of them all. */
  drawAtMost(count: number): void {
    this.geometry.setDrawRange(0, Math.min(count, this.sent));
  }

  set(what: { mode?: Coloring; cutHeight?: number; heights?: [number, number]; pixelsPerMeter?: number; smallest?: number; fade?: number; ground?: number[] }): void {
    const { uniforms } = this.drawn;
    if (what.mode !== undefined) uniforms.mode!.value = MODES[what.mode];
    if (what.cutHeight !== undefined) uniforms.cutHeight!.value = what.cutHeight;
    if (what.heights) (uniforms.heights!.value as Vector2).set(...what.heights);
    if (what.pixelsPerMeter !== undefined) uniforms.pixelsPerMeter!.value = what.pixelsPerMeter;
    if (what.fade !== undefined) uniforms.fade!.value = what.fade;
    if (what.ground) uniforms.ground!.value = what.ground;
    if (what.smallest !== undefined) uniforms.smallest!.value = what.smallest;
  }

  /** Walls that are looked through from here. */
  cut(walls: { normal: [number, number]; offset: number; half: number; middle: [number, number] }[]): void {
    const { uniforms } = this.drawn;
    const cut = walls.slice(0, MAX_CUTS);
    uniforms.cuts!.value = cut.length;
    cut.forEach(({ normal, offset, half, middle }, i) => {
      (uniforms.walls!.value as Vector4[])[i]!.set(...normal, offset, half);
      (uniforms.middles!.value as Vector2[])[i]!.set(...middle);
    });
  }

  /** Color and state of one instance; 0 stands for points that belong to none. */
  paint(instance: number, rgb: [number, number, number], state: number): void {
    const data = this.table.image.data as Uint8Array;
    if ((instance + 1) * 4 > data.length) return;
    data.set([...rgb, state], instance * 4);
    this.table.needsUpdate = true;
  }

  dispose(): void {
    this.geometry.dispose();
    this.drawn.dispose();
    this.picking.dispose();
    this.table.dispose();
  }
}
