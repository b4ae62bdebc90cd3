/** Names that hang on things in the picture, and the length of a measurement. Moved after each drawing, without rendering anew. */

import { useLayoutEffect, useRef } from "preact/hooks";
import { t } from "../text";
import type { DrawnBox } from "../view3d/boxes";
import type { Point } from "../view3d/marks";
import type { Viewer } from "../view3d/viewer";
import type { Room } from "./state";

interface Label { key: string; role: string; text: string; at: Point; below?: boolean }

export function Labels({ viewer, room }: { viewer: Viewer; room: Room }) {
  const place = useRef<HTMLDivElement>(null);
  const labels = [...room.boxes.value.map((box) => labelOf(box, room)), ...measured(room.ends.value)];

  // Before anybody sees them: a label at no place yet would flash in the corner.
  useLayoutEffect(() => {
    const drawn = viewer.onDrawn;
    const move = () => {
      labels.forEach(({ at, below }, i) => {
        const element = place.current?.children[i] as HTMLElement | undefined;
        const pixel = viewer.project(at);
        if (!element) return;
        element.hidden = !pixel;
        const [hang, away] = below ? ["0", 6] : ["-100%", -6];
        if (pixel) element.style.transform = `translate(-50%, ${hang}) translate(${pixel.x.toFixed(1)}px, ${(pixel.y + away).toFixed(1)}px)`;
      });
    };
    viewer.onDrawn = () => {
      drawn();
      move();
    };
    move();
    return () => {
      viewer.onDrawn = drawn;
    };
  });

  // The panels say the same in order: a screen reader need not hear it twice.
  return (
    <div class="labels" ref={place} aria-hidden="true">
      {labels.map(({ key, role, text }) => (
        <span key={key} class={`label of-${role}`}>
          {text}
        </span>
      ))}
    </div>
  );
}

function labelOf({ instance, role, box: { center, size } }: DrawnBox, room: Room): Label {
  // What carries the answer would have its name where the answer's stands: it hangs below.
  const below = role === "anchor";
  const at: Point = [center[0]!, center[1]!, center[2]! + (below ? -0.5 : 0.5) * size[2]!];
  return { key: `${role}${instance}`, role, text: `${room.name(instance)} ${instance || ""}`.trim(), at, below };
}

function measured(ends: Point[]): Label[] {
  if (ends.length < 2) return [];
  const [a, b] = ends as [Point, Point];
  const middle: Point = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2];
  const length = Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
  return [{ key: "measure", role: "measure", text: t.meters(length), at: middle }];
}
