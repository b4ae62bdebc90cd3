/** The photographs of a scan: where they were taken, which of them are drawn, and the one that is looked at. */

import { computed, signal } from "@preact/signals";
import { asProblem } from "../api/client";
import { listFrames } from "../api/service";
import type { FrameView, Problem } from "../api/types";

/** More cameras than these are a thicket: of more, so many are chosen evenly. */
const MOST = 300;

export class Photographs {
  /** All of them, in the order they were taken; `null` until somebody wants them. */
  readonly frames = signal<FrameView[] | null>(null);
  readonly problem = signal<Problem | null>(null);
  readonly shown = signal(false);
  readonly hovered = signal<number | null>(null);
  /** Number of the frame that is looked at. */
  readonly open = signal<number | null>(null);
  /** Those that are listed and drawn. */
  readonly chosen = computed<FrameView[]>(() => {
    const all = this.frames.value ?? [];
    const every = Math.max(1, all.length / MOST);
    return Array.from({ length: Math.min(MOST, all.length) }, (_, i) => all[Math.floor(i * every)]!);
  });

  constructor(private readonly scene: string) {}

  async load(): Promise<void> {
    if (this.frames.peek()) return;
    this.problem.value = null;
    try {
      this.frames.value = (await listFrames(this.scene)).frames;
    } catch (thrown) {
      this.problem.value = asProblem(thrown);
    }
  }

  frame(index: number | null): FrameView | null {
    return this.frames.value?.find((frame) => frame.index === index) ?? null;
  }

  /** The one so many before or after that which is looked at, among all. */
  beside(step: number): FrameView | null {
    const all = this.frames.value ?? [];
    return all[all.findIndex(({ index }) => index === this.open.value) + step] ?? null;
  }
}
