/** The colors of an object as chips: the strongest first. */

import type { InstanceView } from "../api/types";
import { t } from "../text";

/** Chips in a list. */
const MOST = 2;

export function Colors({ thing: { colours, mean_rgb }, inFull }: { thing: InstanceView; inFull?: boolean }) {
  const shares = Object.entries(colours).sort(([, a], [, b]) => b - a);
  const shown = inFull ? shares : shares.slice(0, MOST);
  if (inFull && shown.length === 0) return <>{t.none}</>;
  return (
    <span class="colors">
      {shown.map(([name, share]) => (
        <span key={name} class="color">
          <span class="swatch" style={{ background: paintOf(name, mean_rgb) }} aria-hidden="true" />
          {inFull ? `${name} ${Math.round(share * 100)} %` : name}
        </span>
      ))}
    </span>
  );
}

/** CSS has the service's color names, but its brown is a red. The object's mean color stands in for other names. */
function paintOf(name: string, mean: number[]): string {
  if (name === "brown") return "saddlebrown";
  return CSS.supports("color", name) ? name : `rgb(${mean.join(" ")})`;
}
